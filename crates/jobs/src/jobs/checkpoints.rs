//! The checkpoints of a training: in the data directory and in the shared object store.

use tracing::warn;

use crate::store::{Objects, StoreError};
use foreframe_core::error_text;
use foreframe_train::training::{CHECKPOINT_FILE, CheckpointPosition};

/// Fetches the run's checkpoint from the object store if it is later than the local one. The local one can be later,
/// because a push can fail. Errors: `Io`, `Object`.
pub(super) async fn fetch_latest(objects: &Objects, run: &str) -> Result<(), StoreError> {
    if !objects.are_shared() {
        return Ok(());
    }
    let path = format!("{run}/{CHECKPOINT_FILE}");
    let remote = objects
        .read(&path)
        .await?
        .and_then(|bytes| CheckpointPosition::of(&bytes));
    let local = std::fs::read(objects.data_dir().join(path)).ok();
    if remote > local.and_then(|bytes| CheckpointPosition::of(&bytes)) {
        objects.pull(run, CHECKPOINT_FILE).await?;
    }
    Ok(())
}

/// Whether the latest push of a checkpoint to the object store failed.
#[derive(Default)]
pub(super) struct CheckpointSync {
    has_failed: bool,
}

impl CheckpointSync {
    /// Records the result of a push. Returns a line for the job's log if the result differs from the one before.
    pub(super) fn record(&mut self, pushed: Result<(), StoreError>) -> Option<String> {
        let reason = pushed.err().map(|error| error_text::with_causes(&error));
        if let Some(reason) = &reason {
            warn!(reason, "could not copy a checkpoint to the object store");
        }
        let had_failed = std::mem::replace(&mut self.has_failed, reason.is_some());
        match reason {
            Some(reason) if !had_failed => Some(format!("the checkpoint is on this machine only: {reason}")),
            None if had_failed => Some("the checkpoint is in the object store again".to_owned()),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::store::{Store, StoreConfig};
    use foreframe_train::training::{seal, state_entry};

    const RUN: &str = "runs/job-1";

    /// Writes a checkpoint of that stage and step into the run below a directory.
    fn write(root: &Path, stage: &str, step: usize) {
        let state = serde_json::json!({"stage": stage, "step": step}).to_string();
        let (key, entry) = state_entry(&state);
        let header = serde_json::json!({"__metadata__": {key: entry}}).to_string();
        let bytes = [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat();
        std::fs::create_dir_all(root.join(RUN)).unwrap();
        std::fs::write(root.join(RUN).join(CHECKPOINT_FILE), seal(bytes)).unwrap();
    }

    #[tokio::test]
    async fn of_two_checkpoints_the_later_one_is_used() {
        let (dir, shared) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let config = StoreConfig {
            data_dir: dir.path().to_owned(),
            database: None,
            objects: Some(shared.path().display().to_string()),
        };
        let store = Store::open(&config).await.unwrap();
        let fetched = async || {
            fetch_latest(store.objects(), RUN).await.unwrap();
            let bytes = std::fs::read(dir.path().join(RUN).join(CHECKPOINT_FILE)).ok()?;
            CheckpointPosition::of(&bytes).map(|reached| (reached.stage.to_string(), reached.step))
        };
        assert_eq!(fetched().await, None);
        write(shared.path(), "pretrain", 4);
        assert_eq!(fetched().await, Some(("pretrain".to_owned(), 4)));
        write(dir.path(), "sequence", 2);
        assert_eq!(fetched().await, Some(("sequence".to_owned(), 2)));
        write(shared.path(), "sequence", 3);
        assert_eq!(fetched().await, Some(("sequence".to_owned(), 3)));
        std::fs::write(shared.path().join(RUN).join(CHECKPOINT_FILE), "damaged").unwrap();
        assert_eq!(fetched().await, Some(("sequence".to_owned(), 3)));
    }

    #[test]
    fn a_failed_push_of_checkpoints_is_logged_once() {
        let failed = || {
            Err(StoreError::Io {
                action: "write",
                path: "x".into(),
                source: std::io::Error::other("full"),
            })
        };
        let mut sync = CheckpointSync::default();
        assert_eq!(sync.record(Ok(())), None);
        let line = sync.record(failed()).unwrap();
        assert!(line.contains("on this machine only") && line.contains("full"), "{line}");
        assert_eq!(sync.record(failed()), None);
        assert!(sync.record(Ok(())).unwrap().contains("again"));
        assert_eq!(sync.record(Ok(())), None);
    }
}
