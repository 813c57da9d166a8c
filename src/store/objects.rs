//! Files that several machines may share: models, runs' checkpoints, data sets, reports. Work always happens in the data
//! directory; where objects are kept elsewhere, directories are pushed there and pulled from there, under the same names.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use futures_util::{StreamExt as _, TryStreamExt as _};
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{ObjectStore, ObjectStoreExt as _};

use super::StoreError;
use crate::files::write_atomically;

/// The data directory, and where it is mirrored.
#[derive(Clone)]
pub struct Objects {
    data_dir: PathBuf,
    shared: Option<Arc<dyn ObjectStore>>,
}

impl Objects {
    pub(super) fn open(data_dir: &Path, url: Option<&str>) -> Result<Self, StoreError> {
        let shared = match url {
            None => None,
            Some(url) if url.starts_with("s3://") => Some(bucket(url)?),
            Some(url) if url.contains("://") => {
                return Err(StoreError::Url {
                    flag: "objects",
                    scheme: url.split("://").next().unwrap_or_default().chars().take(16).collect(),
                    known: "a directory or s3://BUCKET/PREFIX",
                });
            }
            Some(dir) => Some(directory(Path::new(dir))?),
        };
        Ok(Self {
            data_dir: data_dir.to_owned(),
            shared,
        })
    }

    /// The data directory.
    #[must_use]
    pub fn data_dir(&self) -> &Path {
        &self.data_dir
    }

    /// Whether objects are kept elsewhere than in the data directory.
    #[must_use]
    pub fn are_shared(&self) -> bool {
        self.shared.is_some()
    }

    /// Copies the files of a directory below the data directory to where objects are kept, that of the name `last` last:
    /// it says that the others are there. Errors: `Io`, `Object`.
    pub async fn push(&self, dir: &str, last: &str) -> Result<(), StoreError> {
        let Some(shared) = &self.shared else { return Ok(()) };
        let root = self.data_dir.join(dir);
        let mut paths = files_below(&root).map_err(StoreError::io("list", &root))?;
        paths.sort_by_key(|path| path.file_name().is_some_and(|name| name == last));
        for path in paths {
            let bytes = tokio::fs::read(&path).await.map_err(StoreError::io("read", &path))?;
            let relative = path.strip_prefix(&self.data_dir).unwrap_or(&path);
            let key = Key::from(relative.to_string_lossy().replace('\\', "/"));
            shared.put(&key, bytes.into()).await.map_err(failed("write", &key))?;
        }
        Ok(())
    }

    /// Copies a directory from where objects are kept into the data directory, the file `last` last; says whether there
    /// was any. Errors: `Io`, `Object`.
    pub async fn pull(&self, dir: &str, last: &str) -> Result<bool, StoreError> {
        let Some(shared) = &self.shared else { return Ok(false) };
        let mut keys = self.keys(dir).await?;
        keys.sort_by_key(|key| key.filename() == Some(last));
        for key in &keys {
            let content = shared.get(key).await.map_err(failed("read", key))?;
            let bytes = content.bytes().await.map_err(failed("read", key))?;
            let path = self.data_dir.join(key.as_ref());
            let parent = path.parent().unwrap_or(&self.data_dir);
            std::fs::create_dir_all(parent).map_err(StoreError::io("make", parent))?;
            write_atomically(&path, &bytes).map_err(StoreError::io("write", &path))?;
        }
        Ok(!keys.is_empty())
    }

    /// The directories right below one, where objects are kept. Errors: `Object`.
    pub async fn directories(&self, dir: &str) -> Result<Vec<String>, StoreError> {
        let Some(shared) = &self.shared else {
            return Ok(Vec::new());
        };
        let key = Key::from(dir);
        let found = shared.list_with_delimiter(Some(&key)).await;
        let names = found.map_err(failed("list", &key))?.common_prefixes;
        Ok(names.iter().filter_map(Key::filename).map(str::to_owned).collect())
    }

    /// Deletes a directory, here and where objects are kept; one that is not there is deleted already.
    /// Errors: `Io`, `Object`.
    pub async fn delete(&self, dir: &str) -> Result<(), StoreError> {
        let path = self.data_dir.join(dir);
        match std::fs::remove_dir_all(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(StoreError::io("delete", &path)(error));
            }
            _ => {}
        }
        let Some(shared) = &self.shared else { return Ok(()) };
        for key in self.keys(dir).await? {
            shared.delete(&key).await.map_err(failed("delete", &key))?;
        }
        Ok(())
    }

    async fn keys(&self, dir: &str) -> Result<Vec<Key>, StoreError> {
        let Some(shared) = &self.shared else {
            return Ok(Vec::new());
        };
        let prefix = Key::from(dir);
        let listed = shared.list(Some(&prefix)).map(|found| found.map(|meta| meta.location));
        listed.try_collect().await.map_err(failed("list", &prefix))
    }
}

fn failed(action: &'static str, key: &Key) -> impl FnOnce(object_store::Error) -> StoreError {
    let key = key.to_string();
    move |source| StoreError::Object { action, key, source }
}

fn directory(dir: &Path) -> Result<Arc<dyn ObjectStore>, StoreError> {
    std::fs::create_dir_all(dir).map_err(StoreError::io("make", dir))?;
    let store = LocalFileSystem::new_with_prefix(dir).map_err(|source| StoreError::Object {
        action: "open",
        key: dir.display().to_string(),
        source,
    })?;
    Ok(Arc::new(store.with_fsync(true).with_automatic_cleanup(true)))
}

/// Credentials, region and endpoint come from the environment, as for every S3 client.
#[cfg(feature = "cloud")]
fn bucket(url: &str) -> Result<Arc<dyn ObjectStore>, StoreError> {
    let failed = |source| StoreError::Object {
        action: "open",
        key: url.to_owned(),
        source,
    };
    let bucket = object_store::aws::AmazonS3Builder::from_env().with_url(url).build();
    let prefix = url.splitn(4, '/').nth(3).unwrap_or_default();
    let prefixed = object_store::prefix::PrefixStore::new(bucket.map_err(failed)?, prefix);
    Ok(Arc::new(prefixed))
}

#[cfg(not(feature = "cloud"))]
fn bucket(_: &str) -> Result<Arc<dyn ObjectStore>, StoreError> {
    Err(StoreError::Url {
        flag: "objects",
        scheme: "s3".to_owned(),
        known: "a directory; this program was built without the feature cloud, which knows S3",
    })
}

/// Every file below a directory, but half-written ones.
fn files_below(root: &Path) -> std::io::Result<Vec<PathBuf>> {
    let (mut dirs, mut files) = (vec![root.to_owned()], Vec::new());
    while let Some(dir) = dirs.pop() {
        for entry in std::fs::read_dir(dir)? {
            let path = entry?.path();
            if path.is_dir() {
                dirs.push(path);
            } else if !path.extension().is_some_and(|end| end == "partial" || end == "tmp") {
                files.push(path);
            }
        }
    }
    files.sort();
    Ok(files)
}
