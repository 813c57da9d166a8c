//! The parts of jobs. A part is a job with a parent: any worker claims it, as every job. The parent waits in the queue until
//! all its parts have ended; then its own work joins what they made.

use serde::Deserialize;

use super::StoreError;
use super::database::{Tx, values};
use super::job_id::JobId;

/// How many parts of a job are in which state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
pub struct PartCounts {
    /// All of them; 0 if the job has no parts.
    #[serde(default, rename = "parts")]
    pub total: i64,
    /// Those that succeeded.
    #[serde(default, rename = "parts_done")]
    pub done: i64,
    /// Those that run.
    #[serde(default, rename = "parts_running")]
    pub running: i64,
    /// Those that failed or were cancelled.
    #[serde(default, rename = "parts_failed")]
    pub failed: i64,
}

/// Enqueues the parts of a job that was just enqueued. Errors: `Query`.
pub(super) async fn enqueue(tx: &mut Tx, parent: JobId, specs: Vec<String>) -> Result<(), StoreError> {
    for spec in specs {
        let sql = "UPDATE counters SET value = value + 1 WHERE name = 'job'";
        tx.execute(sql, values![]).await?;
        let sql = "INSERT INTO jobs (number, kind, state, spec, progress, queued_s, submitter, after_job, parent) \
             SELECT counters.value, whole.kind, 'queued', $2, whole.progress, whole.queued_s, whole.submitter, \
             whole.after_job, whole.number FROM counters, jobs AS whole WHERE counters.name = 'job' AND whole.number = $1";
        tx.execute(sql, values![parent, spec]).await?;
    }
    Ok(())
}

/// Cancels the parts of a job that wait, and asks those that run to stop. Errors: `Query`.
pub(super) async fn cancel(tx: &mut Tx, parent: JobId, now_s: f64) -> Result<(), StoreError> {
    let sql = "UPDATE jobs SET ended_s = CASE WHEN state = 'queued' THEN $2 ELSE ended_s END, \
         cancelling = CASE WHEN state = 'running' THEN 1 ELSE 0 END, \
         state = CASE WHEN state = 'queued' THEN 'cancelled' ELSE state END \
         WHERE parent = $1 AND state IN ('queued', 'running')";
    tx.execute(sql, values![parent, now_s]).await.map(drop)
}

/// Whether parts of a job that was cancelled have not stopped yet. Errors: `Query`.
pub(super) async fn are_stopping(tx: &mut Tx, parent: JobId) -> Result<bool, StoreError> {
    let sql =
        "SELECT number FROM jobs WHERE parent = $1 AND (state = 'running' OR (state = 'queued' AND cancelling = 1))";
    Ok(tx.first(sql, values![parent]).await?.is_some())
}

/// Enqueues the failed and cancelled parts of a job again. Errors: `Query`.
pub(super) async fn requeue(tx: &mut Tx, parent: JobId) -> Result<(), StoreError> {
    let sql = "UPDATE jobs SET state = 'queued', error = NULL, ended_s = NULL, cancelling = 0, owner = NULL, \
         stalled_attempts = 0, lease_until_s = NULL WHERE parent = $1 AND state IN ('failed', 'cancelled')";
    tx.execute(sql, values![parent]).await.map(drop)
}
