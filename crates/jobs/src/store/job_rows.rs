//! The row of a job, and what is written to it.

use serde::{Deserialize, Deserializer};

use super::job_id::JobId;
use super::models::{ModelMetrics, PublishedVersion};
use super::parts::PartCounts;

/// The row of a job. Structured values are JSON.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct JobRow {
    /// The job's id.
    #[serde(rename = "number", deserialize_with = "job_id")]
    pub id: JobId,
    /// `collect`, `train`, …
    pub kind: String,
    /// `queued`, `running`, `succeeded`, `failed` or `cancelled`.
    pub state: String,
    /// Its specification.
    pub spec: String,
    /// Its progress.
    pub progress: String,
    /// Its result.
    pub outcome: Option<String>,
    /// Why it failed.
    pub error: Option<String>,
    /// Whether it is running and was asked to stop.
    #[serde(deserialize_with = "flag")]
    pub cancelling: bool,
    /// When it was enqueued, in seconds since 1970.
    pub queued_s: f64,
    /// When its first attempt started, in seconds since 1970.
    pub started_s: Option<f64>,
    /// When it ended, in seconds since 1970.
    pub ended_s: Option<f64>,
    /// How often it was claimed.
    pub token: i64,
    /// How many units of work are saved.
    pub checkpoint: i64,
    /// How many attempts in a row ended abnormally without saving more.
    pub stalled_attempts: i64,
    /// The id of the API key that submitted it; empty without a key.
    pub submitter: String,
    /// The number of the job of which it is a part.
    pub parent: Option<i64>,
    /// Its parts.
    #[serde(flatten)]
    pub parts: PartCounts,
}

fn job_id<'de, D: Deserializer<'de>>(deserializer: D) -> Result<JobId, D::Error> {
    i64::deserialize(deserializer).map(JobId::new)
}

fn flag<'de, D: Deserializer<'de>>(deserializer: D) -> Result<bool, D::Error> {
    Ok(i64::deserialize(deserializer)? != 0)
}

/// A job to enqueue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewJob {
    /// `collect`, `train`, …
    pub kind: String,
    /// An output that only one queued or running job can have.
    pub exclusive_output: Option<String>,
    /// Its specification.
    pub spec: String,
    /// Its initial progress.
    pub progress: String,
    /// The caller's idempotency key: one key never makes two jobs.
    pub idempotency_key: Option<String>,
    /// The id of the caller's API key; empty without a key.
    pub submitter: String,
    /// The job that must end before this one starts.
    pub after: Option<JobId>,
    /// The specifications of its parts, which end before this one starts.
    pub parts: Vec<String>,
}

/// The result of enqueueing.
#[derive(Clone, Debug, PartialEq)]
pub enum EnqueueResult {
    /// The job was enqueued.
    New(JobRow),
    /// A job with this idempotency key exists.
    Same(JobRow),
    /// The queue is full.
    Full,
    /// The submitter's share of the queue is full: the number of waiting jobs that one API key may have.
    ShareFull(i64),
    /// A queued or running job has the same output.
    Taken,
    /// Parts of the job that were cancelled have not stopped yet.
    PartsStopping,
}

/// How an attempt of a job ended.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JobOutcome {
    /// The state that follows.
    pub state: &'static str,
    /// Why it failed.
    pub error: Option<String>,
    /// Its result.
    pub outcome: Option<String>,
    /// When, in seconds since 1970; `None` if the job goes back to the queue.
    pub ended_s: Option<f64>,
    /// The published version.
    pub published: Option<PublishedVersion>,
    /// What an evaluation measured.
    pub measured: Option<ModelMetrics>,
    /// Whether the attempt ended abnormally.
    pub crashed: bool,
}

/// How many jobs of a kind are in a state.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct JobCount {
    /// `collect`, `train`, …
    pub kind: String,
    /// `queued`, `running`, …
    pub state: String,
    /// The number of such jobs.
    pub jobs: i64,
}

/// Which jobs to list, the newest first.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct JobPage {
    /// Only of that kind.
    pub kind: Option<String>,
    /// Only in that state.
    pub state: Option<String>,
    /// Only those enqueued before that job.
    pub before: Option<JobId>,
    /// Only the parts of that job; `None` for jobs that are no parts.
    pub part_of: Option<JobId>,
    /// The maximum number of jobs.
    pub limit: i64,
}
