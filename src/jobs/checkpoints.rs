//! The checkpoints of a training's run: in the data directory, where it works, and where objects are kept.

use tracing::warn;

use crate::store::{Objects, StoreError};
use crate::training::{CHECKPOINT_FILE, CheckpointPosition};
use crate::error_text;

/// Fetches the run's last checkpoint, unless the data directory has it or a later one: pushing that may have failed.
/// Errors: `Io`, `Object`.
pub(super) async fn recall(objects: &Objects, run: &str) -> Result<(), StoreError> {
    if !objects.are_shared() {
        return Ok(());
    }
    let path = format!("{run}/{CHECKPOINT_FILE}");
    let kept = objects
        .read(&path)
        .await?
        .and_then(|bytes| CheckpointPosition::of(&bytes));
    let here = std::fs::read(objects.data_dir().join(path)).ok();
    if kept > here.and_then(|bytes| CheckpointPosition::of(&bytes)) {
        objects.pull(run, CHECKPOINT_FILE).await?;
    }
    Ok(())
}

/// Whether a run's checkpoints are kept where the other objects are.
#[derive(Default)]
pub(super) struct CheckpointSync {
    has_failed: bool,
}

impl CheckpointSync {
    /// Notes how keeping one went; gives a line for the job's log when that is not as it was.
    pub(super) fn note(&mut self, kept: Result<(), StoreError>) -> Option<String> {
        let reason = kept.err().map(|error| error_text::with_causes(&error));
        if let Some(reason) = &reason {
            warn!(reason, "could not keep a checkpoint where the other objects are");
        }
        let had_failed = std::mem::replace(&mut self.has_failed, reason.is_some());
        match reason {
            Some(reason) if !had_failed => Some(format!("the checkpoint is on this machine only: {reason}")),
            None if had_failed => Some("the checkpoint is where the other objects are again".to_owned()),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::store::{Store, StoreConfig};

    const RUN: &str = "runs/job-1";

    /// Writes a checkpoint of that stage and step into the run below a directory.
    fn write(root: &Path, stage: &str, step: usize) {
        let state = serde_json::json!({"stage": stage, "step": step}).to_string();
        let header = serde_json::json!({"__metadata__": {"foreframe.training": state}}).to_string();
        let bytes = [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat();
        std::fs::create_dir_all(root.join(RUN)).unwrap();
        std::fs::write(root.join(RUN).join(CHECKPOINT_FILE), bytes).unwrap();
    }

    #[tokio::test]
    async fn of_two_checkpoints_the_later_one_is_gone_on_from() {
        let (dir, shared) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let config = StoreConfig {
            data_dir: dir.path().to_owned(),
            database: None,
            objects: Some(shared.path().display().to_string()),
        };
        let store = Store::open(&config).await.unwrap();
        let recalled = async || {
            recall(store.objects(), RUN).await.unwrap();
            let bytes = std::fs::read(dir.path().join(RUN).join(CHECKPOINT_FILE)).ok()?;
            CheckpointPosition::of(&bytes).map(|reached| (reached.stage.to_string(), reached.step))
        };
        assert_eq!(recalled().await, None);
        write(shared.path(), "pretrain", 4);
        assert_eq!(recalled().await, Some(("pretrain".to_owned(), 4)));
        write(dir.path(), "fit", 2);
        assert_eq!(recalled().await, Some(("fit".to_owned(), 2)));
        write(shared.path(), "fit", 3);
        assert_eq!(recalled().await, Some(("fit".to_owned(), 3)));
        std::fs::write(shared.path().join(RUN).join(CHECKPOINT_FILE), "damaged").unwrap();
        assert_eq!(recalled().await, Some(("fit".to_owned(), 3)));
    }

    #[test]
    fn a_checkpoint_that_is_kept_here_only_is_told_of_once_until_it_is_kept_again() {
        let failed = || {
            Err(StoreError::Io {
                action: "write",
                path: "x".into(),
                source: std::io::Error::other("full"),
            })
        };
        let mut keeping = CheckpointSync::default();
        assert_eq!(keeping.note(Ok(())), None);
        let line = keeping.note(failed()).unwrap();
        assert!(line.contains("on this machine only") && line.contains("full"), "{line}");
        assert_eq!(keeping.note(failed()), None);
        assert!(keeping.note(Ok(())).unwrap().contains("again"));
        assert_eq!(keeping.note(Ok(())), None);
    }
}
