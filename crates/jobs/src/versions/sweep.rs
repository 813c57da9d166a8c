//! Deletes what is left of versions whose deletion or publication was interrupted, for example by `kill -9`.

use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::path::PathBuf;

use tracing::{info, warn};

use super::{Versions, key};
use crate::store::StoreError;
use foreframe_core::files::{open_lock, try_lock};
use foreframe_core::types::ModelName;

/// The lock file. Publications hold it together, the cleanup holds it alone.
const PUBLISH_LOCK: &str = "publish.lock";

impl Versions {
    /// Deletes what is left of interrupted deletions and publications. Failures to delete files are logged. Errors: `Query`.
    pub(super) async fn sweep(&self) -> Result<(), StoreError> {
        let mut deleted = BTreeMap::<ModelName, Vec<String>>::new();
        for (model, version) in self.store.deleted_versions().await? {
            deleted.entry(model).or_default().push(version.to_string());
        }
        for (model, versions) in deleted {
            if let Err(error) = self.store.objects().sweep(&format!("models/{model}"), &versions).await {
                warn!(%model, %error, "could not delete what is left of deleted versions");
            }
        }
        if let Err(error) = self.sweep_unpublished().await {
            warn!(%error, "could not delete what is left of a publication");
        }
        Ok(())
    }

    /// Deletes the versions in this data directory that no job made and that were not published, unless another process publishes one
    /// here now. Errors: `Query`, `Io`, `Object`.
    pub(super) async fn sweep_unpublished(&self) -> Result<(), StoreError> {
        let (lock, path) = self.publish_lock()?;
        match try_lock(&lock) {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Ok(()),
            Err(TryLockError::Error(error)) => return Err(StoreError::io("lock", &path)(error)),
        }
        let objects = self.store.objects();
        for (model, version) in self.store.unpublished_versions().await? {
            let key = key(&model, version);
            // Files of other machines may still be being written.
            if objects.data_dir().join(&key).is_dir() {
                objects.delete(&key).await?;
                info!(%model, version, "deleted a version whose publication did not finish");
            }
        }
        Ok(())
    }

    /// The lock of all who write versions in this data directory without a job; it ends with the file. Waits while another process cleans
    /// up. Errors: `Io`.
    pub(super) fn begin_publication(&self) -> Result<File, StoreError> {
        let (lock, path) = self.publish_lock()?;
        lock.lock_shared().map_err(StoreError::io("lock", &path))?;
        Ok(lock)
    }

    /// The lock, and its path.
    fn publish_lock(&self) -> Result<(File, PathBuf), StoreError> {
        let path = self.store.objects().data_dir().join(PUBLISH_LOCK);
        let lock = open_lock(&path).map_err(StoreError::io("open", &path))?;
        Ok((lock, path))
    }
}
