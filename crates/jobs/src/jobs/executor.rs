//! What does the work of a job, and how the work ends.

use std::sync::atomic::AtomicBool;

use futures_util::future::BoxFuture;
use serde::{Deserialize, Serialize};

use super::report::JobReporter;
use super::{JobError, JobSpec};
use crate::store::{ModelMetrics, PublishedVersion};

/// Why a job's work ended without a result.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobFailure {
    /// It was asked to stop, or its lease was lost.
    Cancelled,
    /// The work failed. One sentence says why.
    Failed(String),
    /// The job's process ended abnormally, so another attempt can succeed. One sentence says how.
    Crashed(String),
}

/// The result of a job that succeeded.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct JobResult {
    /// The result in the API.
    pub result: serde_json::Value,
    /// The published version.
    pub published: Option<PublishedVersion>,
    /// What an evaluation measured.
    pub measured: Option<ModelMetrics>,
}

impl JobResult {
    /// A result without a version or metrics.
    pub(super) fn of(result: serde_json::Value) -> Self {
        Self {
            result,
            ..Self::default()
        }
    }
}

/// Does the work of jobs.
pub trait JobExecutor: Send + Sync + 'static {
    /// Checks a job before it is enqueued. Returns it as it is to be enqueued: with the version of the model that all its parts use.
    /// Errors: `Invalid`, `NotFound`, `Taken`, and the errors of reading data sets and models.
    fn check<'a>(&'a self, spec: &'a JobSpec) -> BoxFuture<'a, Result<JobSpec, JobError>>;

    /// Checks that what an ended job needs is still there, before it is enqueued again. Errors: `Invalid`, `Store`.
    fn check_again<'a>(&'a self, _spec: &'a JobSpec) -> BoxFuture<'a, Result<(), JobError>> {
        Box::pin(std::future::ready(Ok(())))
    }

    /// Does the work, or resumes it. Returns `Cancelled` soon after `cancelled` becomes true. Blocks.
    fn execute(&self, spec: &JobSpec, report: &JobReporter, cancelled: &AtomicBool) -> Result<JobResult, JobFailure>;
}
