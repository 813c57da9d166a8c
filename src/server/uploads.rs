//! The files that clients upload for their imports: received piece by piece, bounded in size, number and time.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use axum::body::{Body, Bytes};
use futures_util::StreamExt as _;
use tokio::sync::Mutex;
use tracing::{info, warn};

use super::blocking::BlockingWork;
use super::config::ServerConfig;
use super::http::keys::Caller;
use super::http::problem::ApiError;
use foreframe_core::files::{none_if_missing, partial_path, remove_dir};
use foreframe_jobs::jobs::uploads::{UPLOADS_DIR, UploadedFile};
use foreframe_jobs::jobs::{Job, JobError, JobFilter, JobSpec, JobState, Jobs};
use foreframe_jobs::store::{Objects, StoreError};

/// Bytes that are written at once.
const PIECE_BYTES: usize = 1 << 20;
/// How long nothing may arrive of a file that is being received until it counts as left by a server that was killed.
const MAX_PAUSE: Duration = Duration::from_mins(5);
/// When a key whose share is used up may try again, in seconds: an import takes a while.
const SHARE_RETRY_AFTER_S: u64 = 10;
/// Import jobs in which an upload is looked for, the newest.
const MAX_IMPORTS: usize = 1000;

/// The uploads of this server, in its data directory.
pub(super) struct Uploads {
    dir: PathBuf,
    max_bytes: u64,
    max_count: usize,
    max_count_per_key: usize,
    keep: Duration,
    /// Who sent each upload since the server started; locked while places are counted and one is taken.
    senders: Mutex<HashMap<String, Caller>>,
}

impl Uploads {
    pub(super) fn new(config: &ServerConfig) -> Self {
        Self {
            dir: config.data_dir.join(UPLOADS_DIR),
            max_bytes: config.max_upload_mib << 20,
            max_count: config.max_uploads,
            max_count_per_key: config.max_uploads_per_key,
            keep: Duration::from_millis(config.upload_idle_ms),
            senders: Mutex::default(),
        }
    }

    /// Writes a body to a file. What was written is deleted if an error occurs or the client goes away. Returns how many bytes it
    /// has. Errors: `Unavailable` if there are too many uploads, `TooMany` of this key, `TooLarge`, `Unprocessable` if it is empty,
    /// `Malformed`.
    pub(super) async fn receive(
        &self,
        file: &UploadedFile,
        sender: Caller,
        body: Body,
        threads: &BlockingWork,
    ) -> Result<u64, ApiError> {
        let path = file.path(self.dir.parent().unwrap_or(&self.dir));
        let place = self.place(file, sender, threads).await?;
        let opened = threads.run(move || PartialFile::create(path)).await?;
        let PartialFile {
            partial,
            path,
            file: mut open,
        } = opened.map_err(|error| away(&self.dir, error))?;
        let (mut bytes, mut piece) = (0, Vec::new());
        let mut body = body.into_data_stream();
        loop {
            let next = body.next().await.transpose();
            let next = next.map_err(|error| ApiError::Malformed(format!("the body ended before its end: {error}")))?;
            let is_last = next.is_none();
            let next: Bytes = next.unwrap_or_default();
            bytes += next.len() as u64;
            if bytes > self.max_bytes {
                return Err(self.too_large());
            }
            piece.extend_from_slice(&next);
            if is_last || piece.len() >= PIECE_BYTES {
                let written = std::mem::take(&mut piece);
                let done = threads.run(move || open.write_all(&written).map(|()| open)).await?;
                open = done.map_err(|error| away(&self.dir, error))?;
            }
            if is_last {
                break;
            }
        }
        if bytes == 0 {
            return Err(ApiError::Unprocessable(
                "the body is empty; send the file in it".to_owned(),
            ));
        }
        let finish = move || open.sync_all().and_then(|()| fs::rename(partial, path));
        threads.run(finish).await?.map_err(|error| away(&self.dir, error))?;
        place.keep();
        Ok(bytes)
    }

    /// Errors: `TooLarge` if a body that states its length is too long.
    pub(super) fn check_length(&self, stated: Option<u64>) -> Result<(), ApiError> {
        match stated {
            Some(bytes) if bytes > self.max_bytes => Err(self.too_large()),
            _ => Ok(()),
        }
    }

    fn too_large(&self) -> ApiError {
        let limit_mib = self.max_bytes >> 20;
        ApiError::TooLarge(match limit_mib {
            0 => "this server takes no uploads (setting max_upload_mib)".to_owned(),
            _ => format!("the file has more than {limit_mib} MiB, which this server takes (setting max_upload_mib)"),
        })
    }

    /// Makes the directory of an upload. Errors: `Unavailable`, `TooMany`.
    async fn place(
        &self,
        file: &UploadedFile,
        sender: Caller,
        threads: &BlockingWork,
    ) -> Result<UploadPlace, ApiError> {
        let mut senders = self.senders.lock().await;
        let uploads = self.dir.clone();
        let listed = threads.run(move || names(&uploads)).await?;
        let present = listed.map_err(|error| away(&self.dir, error))?;
        senders.retain(|id, _| present.contains(id));
        self.check_places(present.len(), sender, &senders)?;
        let dir = self.dir.join(file.id());
        let made = threads.run(move || {
            let place = UploadPlace { dir: Some(dir.clone()) };
            fs::create_dir_all(dir).map(|()| place)
        });
        let place = made.await?.map_err(|error: io::Error| away(&self.dir, error))?;
        senders.insert(file.id().to_owned(), sender);
        Ok(place)
    }

    /// Errors: `Unavailable` if all places are taken, `TooMany` if the sender's key has its share of them.
    fn check_places(&self, taken: usize, sender: Caller, senders: &HashMap<String, Caller>) -> Result<(), ApiError> {
        let (max_count, share) = (self.max_count, self.max_count_per_key);
        if taken >= max_count {
            return Err(ApiError::unavailable(format!(
                "{max_count} uploads wait for their imports already (setting max_uploads); import them, or try again later"
            )));
        }
        let own = senders.values().filter(|other| sender.has_key_of(**other)).count();
        if own >= share {
            return Err(ApiError::TooMany {
                detail: format!(
                    "{share} uploads of this API key wait for their imports already (setting max_uploads_per_key); import or \
                     delete them, or try again later"
                ),
                retry_after_s: SHARE_RETRY_AFTER_S,
            });
        }
        Ok(())
    }

    /// The ids of the uploads of this server.
    async fn ids(&self) -> Result<Vec<String>, StoreError> {
        let dir = self.dir.clone();
        let found = tokio::task::spawn_blocking(move || names(&dir)).await;
        let found = found.unwrap_or_else(|broken| Err(io::Error::other(broken)));
        found.map_err(|source| StoreError::Io {
            action: "list",
            path: self.dir.clone(),
            source,
        })
    }

    /// Deletes an upload. Errors: `NotFound`, `Conflict` while an import that has not ended uses it, those of the jobs.
    pub(super) async fn delete(&self, id: &str, jobs: &Jobs, objects: &Objects) -> Result<(), ApiError> {
        let shared = objects.directories(UPLOADS_DIR).await.map_err(JobError::Store)?;
        let here = self.ids().await.map_err(JobError::Store)?;
        if !here.iter().chain(&shared).any(|known| known == id) {
            return Err(ApiError::NotFound(format!("there is no upload {id:?}")));
        }
        let _held = jobs.hold_submissions().await;
        if let Some(job) = jobs.open().await?.iter().find(|job| imports(job, id)) {
            return Err(ApiError::Conflict(format!(
                "{} imports it; cancel the job first",
                job.id
            )));
        }
        objects
            .delete(&format!("{UPLOADS_DIR}/{id}"))
            .await
            .map_err(JobError::Store)?;
        Ok(())
    }

    /// Deletes the uploads whose import has succeeded, and those that no import has used for too long. Errors: those of the jobs.
    pub(super) async fn sweep(&self, jobs: &Jobs, objects: &Objects) -> Result<(), JobError> {
        let names = self.ids().await?;
        if names.is_empty() {
            return Ok(());
        }
        let imports = JobFilter {
            kind: Some("import".to_owned()),
            limit: MAX_IMPORTS,
            ..JobFilter::default()
        };
        let imports = jobs.list(imports).await?;
        for name in names {
            if self.is_over(&name, &imports) {
                objects.delete(&format!("{UPLOADS_DIR}/{name}")).await?;
                info!(upload = name, "deleted an upload: its import has ended, or none began");
            }
        }
        Ok(())
    }

    fn is_over(&self, name: &str, jobs: &[Job]) -> bool {
        let newest = jobs.iter().find(|job| imports(job, name)).map(|job| job.state);
        let dir = self.dir.join(name);
        let is_older = |limit| age(&dir).is_some_and(|age| age > limit);
        match newest {
            Some(JobState::Succeeded) => true,
            Some(JobState::Queued | JobState::Running) => false,
            // It may still be imported with other options, or resumed.
            None if is_unfinished(&dir) => is_older(self.keep.min(MAX_PAUSE)),
            Some(JobState::Failed | JobState::Cancelled) | None => is_older(self.keep),
        }
    }
}

/// Whether a job imports the upload with this id.
fn imports(job: &Job, id: &str) -> bool {
    matches!(&job.spec, JobSpec::Import(spec) if spec.source.contains(&format!(":{id}/")))
}

/// A file that is being written, and its name when it is whole.
struct PartialFile {
    partial: PathBuf,
    path: PathBuf,
    file: File,
}

impl PartialFile {
    fn create(path: PathBuf) -> io::Result<Self> {
        let partial = partial_path(&path)?;
        let file = File::create_new(&partial)?;
        Ok(Self { partial, path, file })
    }
}

/// The directory of an upload, deleted with this unless it is kept.
struct UploadPlace {
    dir: Option<PathBuf>,
}

impl UploadPlace {
    fn keep(mut self) {
        self.dir = None;
    }
}

impl Drop for UploadPlace {
    fn drop(&mut self) {
        if let Some(dir) = &self.dir
            && let Err(error) = remove_dir(dir)
        {
            warn!(%error, dir = %dir.display(), "could not delete an upload that was broken off; it is tried again later");
        }
    }
}

/// The names in the directory of the uploads.
fn names(dir: &Path) -> io::Result<Vec<String>> {
    let entries = none_if_missing(fs::read_dir(dir))?.into_iter().flatten();
    let names = entries.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()));
    names.collect()
}

/// Whether a directory holds only a file that is being received, or was when the server was killed.
fn is_unfinished(dir: &Path) -> bool {
    let is_partial = |entry: fs::DirEntry| entry.file_name().to_string_lossy().ends_with(".partial");
    fs::read_dir(dir).is_ok_and(|entries| entries.flatten().all(is_partial))
}

/// How long ago anything in a directory was written.
fn age(dir: &Path) -> Option<Duration> {
    let inner = fs::read_dir(dir).ok()?.flatten().map(|entry| entry.path());
    let ages = inner.chain([dir.to_owned()]).filter_map(|path| {
        let modified = fs::metadata(path).and_then(|found| found.modified()).ok()?;
        modified.elapsed().ok()
    });
    ages.min()
}

/// The answer when the data directory cannot be written.
fn away(path: &Path, source: io::Error) -> ApiError {
    let (action, path) = ("write", path.to_owned());
    ApiError::of_own_data(&StoreError::Io { action, path, source })
}
