//! Files that several machines can share: models, checkpoints, data sets, reports. Work always happens in the local data
//! directory. With a shared object store, directories are pushed to it and pulled from it under the same keys.

use std::collections::HashMap;
use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures_util::TryStreamExt as _;
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{ObjectMeta, ObjectStore, ObjectStoreExt as _};
use tokio::sync::OwnedMutexGuard;

use super::StoreError;
use foreframe_core::files::{
    files_below, is_hidden, is_partial, none_if_missing, remove_dir, remove_stale_partials, write_atomically,
};

/// How long the object store may take to say what it has. A request that asks must be answered before its own limit; a job
/// asks again.
const QUESTION_LIMIT: Duration = Duration::from_secs(10);

/// The data directory, and the shared object store if there is one.
#[derive(Clone)]
pub struct Objects {
    data_dir: PathBuf,
    shared: Option<Arc<dyn ObjectStore>>,
    /// A lock for each directory that is being pulled.
    pulls: Arc<Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>>,
}

impl Objects {
    pub(super) fn open(data_dir: &Path, url: Option<&str>) -> Result<Self, StoreError> {
        let shared = match url {
            None => None,
            Some(url) if url.starts_with("s3://") => Some(bucket(url)?),
            Some(url) if url.contains("://") => {
                return Err(StoreError::url("objects", url, "a directory or s3://BUCKET/PREFIX"));
            }
            Some(dir) => Some(directory(Path::new(dir))?),
        };
        Ok(Self {
            data_dir: data_dir.to_owned(),
            shared,
            pulls: Arc::default(),
        })
    }

    /// The data directory.
    #[must_use]
    pub fn data_dir(&self) -> &Path {
        &self.data_dir
    }

    /// Whether there is a shared object store besides the data directory.
    #[must_use]
    pub fn are_shared(&self) -> bool {
        self.shared.is_some()
    }

    /// Copies a directory to the object store. The file `last` is copied last: it marks the copy as complete.
    /// Errors: `Io`, `Object`.
    pub async fn push(&self, dir: &str, last: &str) -> Result<(), StoreError> {
        let Some(shared) = &self.shared else { return Ok(()) };
        let root = self.data_dir.join(dir);
        let mut paths = on_disk("list", &root, files_below).await?;
        paths.retain(|path| !is_partial(path) && path.extension().is_none_or(|extension| extension != "tmp"));
        // Hidden directories hold only copies.
        paths.retain(|path| path.strip_prefix(&root).is_ok_and(|path| !is_hidden(path)));
        paths.sort_by_key(|path| path.file_name().is_some_and(|name| name == last));
        for path in paths {
            let bytes = tokio::fs::read(&path).await.map_err(StoreError::io("read", &path))?;
            let relative = path.strip_prefix(&self.data_dir).unwrap_or(&path);
            let key = Key::from(relative.to_string_lossy().replace('\\', "/"));
            shared.put(&key, bytes.into()).await.map_err(failed("write", &key))?;
        }
        Ok(())
    }

    /// Copies a directory from the object store into the data directory, the file `last` last. Returns false, and copies
    /// nothing, if the object store has no `last`. The other files never change, so a local file of the same size is not
    /// copied again. Errors: `Io`, `Object`.
    pub async fn pull(&self, dir: &str, last: &str) -> Result<bool, StoreError> {
        let _lock = self.lock_pull(dir).await;
        self.copy(dir, last).await
    }

    /// As [`Self::pull`], for a directory that can be replaced by another one of the same name: if the local file
    /// `identity` differs from the one in the object store, the local directory is deleted first. Errors: `Io`, `Object`.
    pub async fn pull_same(&self, dir: &str, identity: &str, last: &str) -> Result<bool, StoreError> {
        let _lock = self.lock_pull(dir).await;
        let identity = format!("{dir}/{identity}");
        if self.shared.is_some() && !self.is_same(&identity).await? {
            let Some(remote) = self.read(&identity).await? else {
                return Ok(false);
            };
            on_disk("delete", &self.data_dir.join(dir), remove_dir).await?;
            // First, so that an interrupted copy is continued only if it is of the same directory.
            write(&self.data_dir.join(identity), remote).await?;
        }
        self.copy(dir, last).await
    }

    /// Whether a file is the same in the data directory and in the object store. Errors: `Io`, `Object`.
    pub async fn is_same(&self, path: &str) -> Result<bool, StoreError> {
        let here = self.data_dir.join(path);
        let found = none_if_missing(tokio::fs::read(&here).await).map_err(StoreError::io("read", &here))?;
        Ok(found.is_some() && found == self.read(path).await?)
    }

    async fn copy(&self, dir: &str, last: &str) -> Result<bool, StoreError> {
        let Some(shared) = &self.shared else { return Ok(false) };
        let mut found = self.list(dir).await?;
        let is_last = |object: &ObjectMeta| object.location.filename() == Some(last);
        if !found.iter().any(is_last) {
            return Ok(false);
        }
        let clean = |dir: &Path| {
            remove_stale_partials(dir);
            Ok(())
        };
        on_disk("list", &self.data_dir.join(dir), clean).await?;
        found.sort_by_key(is_last);
        for object in found {
            let path = self.data_dir.join(object.location.as_ref());
            let here = tokio::fs::metadata(&path).await;
            if is_last(&object) || here.map(|here| here.len()).ok() != Some(object.size) {
                write(&path, read(shared, &object).await?).await?;
            }
        }
        Ok(true)
    }

    /// Locks a directory against other pulls in this process.
    async fn lock_pull(&self, dir: &str) -> OwnedMutexGuard<()> {
        let turn = {
            let mut pulls = self.pulls.lock().unwrap_or_else(PoisonError::into_inner);
            pulls.retain(|_, turn| Arc::strong_count(turn) > 1);
            Arc::clone(pulls.entry(dir.to_owned()).or_default())
        };
        turn.lock_owned().await
    }

    /// Reads a file from the object store; `None` if it does not exist. Errors: `Io`, `Object`.
    pub async fn read(&self, path: &str) -> Result<Option<Vec<u8>>, StoreError> {
        let Some(shared) = &self.shared else {
            let path = self.data_dir.join(path);
            return none_if_missing(tokio::fs::read(&path).await).map_err(StoreError::io("read", &path));
        };
        match head(shared, path, "read").await? {
            Some(object) => read(shared, &object).await.map(Some),
            None => Ok(None),
        }
    }

    /// Whether a file is in the object store. Errors: `Object`.
    pub async fn has(&self, path: &str) -> Result<bool, StoreError> {
        match &self.shared {
            Some(shared) => Ok(head(shared, path, "look for").await?.is_some()),
            None => Ok(self.data_dir.join(path).is_file()),
        }
    }

    /// The subdirectories of a directory in the shared object store. Errors: `Object`.
    pub async fn directories(&self, dir: &str) -> Result<Vec<String>, StoreError> {
        let Some(shared) = &self.shared else {
            return Ok(Vec::new());
        };
        let key = Key::from(dir);
        let found = in_time(shared.list_with_delimiter(Some(&key))).await;
        let names = found.map_err(failed("list", &key))?.common_prefixes;
        Ok(names.iter().filter_map(Key::filename).map(str::to_owned).collect())
    }

    /// Deletes a directory from the data directory and the object store, if it exists. Errors: `Io`, `Object`.
    pub async fn delete(&self, dir: &str) -> Result<(), StoreError> {
        on_disk("delete", &self.data_dir.join(dir), remove_dir).await?;
        let Some(shared) = &self.shared else { return Ok(()) };
        for object in self.list(dir).await? {
            let key = object.location;
            shared.delete(&key).await.map_err(failed("delete", &key))?;
        }
        Ok(())
    }

    /// Finishes the deletion of directories that were deleted before, if it was interrupted. Errors: `Io`, `Object`.
    pub async fn sweep(&self, parent: &str, names: &[String]) -> Result<(), StoreError> {
        let left = self.directories(parent).await?;
        for name in names {
            let dir = format!("{parent}/{name}");
            on_disk("delete", &self.data_dir.join(&dir), remove_dir).await?;
            if left.contains(name) {
                self.delete(&dir).await?;
            }
        }
        Ok(())
    }

    async fn list(&self, dir: &str) -> Result<Vec<ObjectMeta>, StoreError> {
        let Some(shared) = &self.shared else {
            return Ok(Vec::new());
        };
        let prefix = Key::from(dir);
        let (mut objects, mut found) = (shared.list(Some(&prefix)), Vec::new());
        // A long list comes in pages.
        while let Some(object) = in_time(objects.try_next()).await.map_err(failed("list", &prefix))? {
            found.push(object);
        }
        Ok(found)
    }
}

/// Describes the object of a path; `None` if it does not exist.
async fn head(
    shared: &Arc<dyn ObjectStore>,
    path: &str,
    action: &'static str,
) -> Result<Option<ObjectMeta>, StoreError> {
    let key = Key::from(path);
    match in_time(shared.head(&key)).await {
        Ok(object) => Ok(Some(object)),
        Err(object_store::Error::NotFound { .. }) => Ok(None),
        Err(error) => Err(failed(action, &key)(error)),
    }
}

/// The whole object. Errors: `Object`, also if the answer is shorter than the object.
async fn read(shared: &Arc<dyn ObjectStore>, object: &ObjectMeta) -> Result<Vec<u8>, StoreError> {
    let key = &object.location;
    let content = shared.get(key).await.map_err(failed("read", key))?;
    let bytes = content.bytes().await.map_err(failed("read", key))?;
    if bytes.len() as u64 == object.size {
        return Ok(bytes.into());
    }
    // The fault is on the way to the object store, so it is worth trying again.
    let reason = format!("the answer has {} bytes; the object has {}", bytes.len(), object.size);
    Err(failed("read", key)(broken(reason)))
}

/// Errors: also without an answer within [`QUESTION_LIMIT`].
async fn in_time<T>(answer: impl Future<Output = object_store::Result<T>>) -> object_store::Result<T> {
    let late = |_| Err(broken(format!("no answer within {} s", QUESTION_LIMIT.as_secs())));
    tokio::time::timeout(QUESTION_LIMIT, answer).await.unwrap_or_else(late)
}

/// A transient error: the same call can succeed later.
fn broken(reason: String) -> object_store::Error {
    object_store::Error::Generic {
        store: "object store",
        source: reason.into(),
    }
}

/// Writes a file, with its directory.
pub(super) async fn write(path: &Path, bytes: Vec<u8>) -> Result<(), StoreError> {
    let written = on_disk("write", path, move |path| {
        std::fs::create_dir_all(path.parent().unwrap_or(path))?;
        write_atomically(path, &bytes)
    });
    written.await
}

/// Does file work on a blocking thread.
pub(super) async fn on_disk<T: Send + 'static>(
    action: &'static str,
    path: &Path,
    work: impl FnOnce(&Path) -> io::Result<T> + Send + 'static,
) -> Result<T, StoreError> {
    let worked_on = path.to_owned();
    let done = tokio::task::spawn_blocking(move || work(&worked_on)).await;
    done.unwrap_or_else(|broken| Err(io::Error::other(broken)))
        .map_err(StoreError::io(action, path))
}

fn failed(action: &'static str, key: &dyn Display) -> impl FnOnce(object_store::Error) -> StoreError + use<> {
    let key = key.to_string();
    move |source| StoreError::Object { action, key, source }
}

fn directory(dir: &Path) -> Result<Arc<dyn ObjectStore>, StoreError> {
    std::fs::create_dir_all(dir).map_err(StoreError::io("make", dir))?;
    let store = LocalFileSystem::new_with_prefix(dir).map_err(failed("open", &dir.display()))?;
    Ok(Arc::new(store.with_fsync(true).with_automatic_cleanup(true)))
}

/// Credentials, region and endpoint come from the environment, as for every S3 client.
#[cfg(feature = "cloud")]
fn bucket(url: &str) -> Result<Arc<dyn ObjectStore>, StoreError> {
    // A job waits for longer than that itself; a request gets 503.
    let retry = object_store::RetryConfig {
        max_retries: 5,
        retry_timeout: Duration::from_secs(10),
        ..object_store::RetryConfig::default()
    };
    let bucket = object_store::aws::AmazonS3Builder::from_env()
        .with_url(url)
        .with_retry(retry)
        .build();
    let prefix = url.splitn(4, '/').nth(3).unwrap_or_default();
    let prefixed = object_store::prefix::PrefixStore::new(bucket.map_err(failed("open", &url))?, prefix);
    Ok(Arc::new(prefixed))
}

#[cfg(not(feature = "cloud"))]
fn bucket(url: &str) -> Result<Arc<dyn ObjectStore>, StoreError> {
    let expected = "a directory; this program was built without S3, which needs --features cloud";
    Err(StoreError::url("objects", url, expected))
}
