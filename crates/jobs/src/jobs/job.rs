//! A job as the API returns it, made from its row in the store.

use serde::Serialize;

use super::progress::StoredProgress;
use super::{JobError, JobProgress, JobSpec, JobState, Losses};
use crate::store::{JobId, JobIdError, JobPage, JobRow, PartCounts};
use foreframe_core::types::ModelName;

/// The parts of a job: how many are in which state. The others wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct JobParts {
    /// All of them.
    pub total: u64,
    /// Those that succeeded.
    pub done: u64,
    /// Those that a worker runs.
    pub running: u64,
    /// Those that failed or were cancelled.
    pub failed: u64,
}

/// One job as it is now.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Job {
    /// Its id.
    #[schema(value_type = String)]
    pub id: JobId,
    /// Its state.
    pub state: JobState,
    /// What it does.
    pub spec: JobSpec,
    /// How much of the work is done.
    pub progress: JobProgress,
    /// The latest losses of a training.
    pub losses: Losses,
    /// Its parts, which any worker runs; absent if it is done as a whole. The job is `queued` until all of them have ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parts: Option<JobParts>,
    /// The job of which it is a part.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub part_of: Option<JobId>,
    /// Why it failed.
    pub error: Option<String>,
    /// The result: the size of a data set, the version of a model, the scores and files of an evaluation, or
    /// the table of a sweep.
    #[schema(value_type = Option<Object>)]
    pub result: Option<serde_json::Value>,
    /// Whether it is running and was asked to stop.
    pub cancelling: bool,
    /// How often a worker claimed it: more than once after a server was killed, or after the job was resumed.
    pub attempts: i64,
    /// The id of the API key that submitted it; absent without a key.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub submitter: Option<String>,
    /// When it was submitted, in seconds since 1970.
    pub queued_unix_s: f64,
    /// When its first attempt started, in seconds since 1970.
    pub started_unix_s: Option<f64>,
    /// When it ended, in seconds since 1970.
    pub ended_unix_s: Option<f64>,
}

impl Job {
    /// Whether it fails if that version of a model is deleted before it ends. A training that has made a step has a copy.
    #[must_use]
    pub fn needs_version(&self, model: &ModelName, version: u32) -> bool {
        let has_copy = self.progress.done > 0 && matches!(self.spec, JobSpec::Train(_) | JobSpec::Adapt(_));
        !has_copy && self.spec.used_model() == Some(model) && self.spec.used_version() == Some(version)
    }

    /// Errors: `Record` if the row was written by an incompatible version of the program.
    pub(super) fn of(row: &JobRow) -> Result<Self, JobError> {
        let record = |reason: String| JobError::Record { id: row.id, reason };
        let state: JobState = row.state.parse().map_err(record)?;
        let stored: StoredProgress = serde_json::from_str(&row.progress).map_err(|error| record(error.to_string()))?;
        let mut progress = stored.progress;
        if state != JobState::Running {
            progress.remaining_s = None;
        }
        let parts = parts(row.parts);
        if let (JobState::Queued, Some(parts)) = (state, parts) {
            (progress.done, progress.total) = (parts.done + parts.failed, parts.total);
            "its parts".clone_into(&mut progress.message);
        }
        let outcome = row.outcome.as_deref().map(serde_json::from_str).transpose();
        Ok(Self {
            id: row.id,
            state,
            spec: serde_json::from_str(&row.spec).map_err(|error| record(error.to_string()))?,
            progress,
            losses: stored.losses,
            parts,
            part_of: row.parent.map(JobId::new),
            error: row.error.clone(),
            result: outcome.map_err(|error| record(error.to_string()))?,
            cancelling: row.cancelling,
            attempts: row.token,
            submitter: Some(row.submitter.clone()).filter(|submitter| !submitter.is_empty()),
            queued_unix_s: row.queued_s,
            started_unix_s: row.started_s,
            ended_unix_s: row.ended_s,
        })
    }
}

fn parts(counts: PartCounts) -> Option<JobParts> {
    // Counts are never negative.
    let [total, done, running, failed] = [counts.total, counts.done, counts.running, counts.failed]
        .map(|count| u64::try_from(count).unwrap_or_default());
    (total > 0).then_some(JobParts {
        total,
        done,
        running,
        failed,
    })
}

/// Which jobs to list, the newest first.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct JobFilter {
    /// Only of that kind.
    pub kind: Option<String>,
    /// Only in that state.
    pub state: Option<JobState>,
    /// Only those submitted before the job of that id.
    pub before: Option<String>,
    /// Only the parts of the job of that id; `None` for the jobs that are no parts.
    pub part_of: Option<String>,
    /// The maximum number of jobs.
    pub limit: usize,
}

impl JobFilter {
    /// Errors: `Invalid` if a field is not valid.
    pub(super) fn page(self) -> Result<JobPage, JobError> {
        let kinds = JobSpec::KINDS;
        if let Some(kind) = self.kind.as_deref().filter(|kind| !kinds.contains(kind)) {
            let (kind, kinds) = (kind.escape_default(), kinds.join(", "));
            let reason = format!("there is no kind \"{kind}\"; there are: {kinds}");
            return Err(JobError::invalid("kind", reason));
        }
        let id = |field, id: Option<String>| {
            let id = id.map(|id| id.parse()).transpose();
            id.map_err(|error: JobIdError| JobError::invalid(field, error.to_string()))
        };
        Ok(JobPage {
            kind: self.kind,
            state: self.state.map(|state| state.name().to_owned()),
            before: id("before", self.before)?,
            part_of: id("part_of", self.part_of)?,
            limit: self.limit as i64,
        })
    }
}
