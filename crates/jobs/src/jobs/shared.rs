//! What the handle to the jobs and their runner share.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Notify, RwLock, watch};
use tracing::warn;

use super::executor::JobExecutor;
use crate::store::Store;

/// The limits of jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct JobLimits {
    /// How many jobs can wait.
    pub queued: usize,
    /// How many ended jobs are kept; the oldest are deleted first.
    pub ended: usize,
    /// How many lines of a job's log are kept.
    pub log_lines: usize,
    /// How many threads a job uses.
    pub threads: usize,
    /// After this many attempts in a row that ended abnormally without progress, a job fails.
    pub max_attempts: u32,
    /// How long one attempt can run.
    pub time_limit: Option<Duration>,
    /// How long a running job may report no progress.
    pub stall_limit: Option<Duration>,
    /// After this time without a sign of life from the runner, another runner can claim its job.
    pub lease: Duration,
}

pub(super) struct SharedJobs {
    pub(super) store: Store,
    pub(super) limits: JobLimits,
    pub(super) execute: Arc<dyn JobExecutor>,
    /// Locked for reading while a job is checked and queued, for writing while a data set or a version is deleted that a job could use.
    pub(super) submissions: RwLock<()>,
    /// A job may be waiting.
    pub(super) wake: Notify,
    /// A job has ended in this process.
    pub(super) ended: Notify,
    pub(super) stop: watch::Sender<bool>,
}

impl SharedJobs {
    /// Whether this process is stopping.
    pub(super) fn is_stopping(&self) -> bool {
        *self.stop.borrow()
    }

    /// Completes when this process is stopping.
    pub(super) async fn stop_requested(&self) {
        // The sender lives as long as this does.
        let _ = self.stop.subscribe().wait_for(|stop| *stop).await;
    }

    /// Deletes the oldest ended jobs with their files.
    pub(super) async fn forget_oldest(&self) {
        let forgotten = match self.store.forget_ended(self.limits.ended as i64).await {
            Ok(forgotten) => forgotten,
            Err(error) => return warn!(%error, "could not delete old jobs"),
        };
        for id in forgotten {
            for dir in ["runs", "reports"] {
                if let Err(error) = self.store.objects().delete(&format!("{dir}/{id}")).await {
                    warn!(job.id = %id, %error, "could not delete the files of an old job");
                }
            }
        }
    }
}
