//! What all parts have in common: a part saves its results in `runs/JOB`, where no other job writes, and the whole takes them
//! from there.

use std::fs;
use std::path::PathBuf;

use serde_json::json;
use tracing::warn;

use super::super::JobState;
use super::super::executor::{JobFailure, JobResult};
use super::super::report::JobReporter;
use super::super::retry_policy::RetryPolicy;
use super::{Pipeline, failed, run_key};
use crate::store::JobRow;

/// The file of a part that is written last. It says which attempt made the others.
pub(super) const LAST_FILE: &str = "part.json";

impl Pipeline {
    /// The parts of a job; none if it is done as a whole. Errors: `Failed` if one did not succeed.
    pub(super) fn ended_parts(&self, report: &JobReporter, retry: &RetryPolicy<'_>) -> Result<Vec<JobRow>, JobFailure> {
        let parts = retry.run(async || self.store.parts(report.id()).await)?;
        if let Some(part) = parts.iter().find(|part| part.state != JobState::Succeeded.name()) {
            let reason = part.error.as_deref().unwrap_or("resume this job");
            return Err(JobFailure::Failed(format!(
                "its part {} is {}: {reason}",
                part.id, part.state
            )));
        }
        Ok(parts)
    }

    /// Prepares the directory of a part: empty at the first attempt, else with what an earlier one on this machine saved.
    pub(super) fn prepare_part(&self, report: &JobReporter, retry: &RetryPolicy<'_>) -> Result<(), JobFailure> {
        let (run, objects) = (run_key(report.id()), self.store.objects());
        if report.lease().token == 1 {
            retry.run(async || objects.delete(&run).await)?;
        }
        fs::create_dir_all(objects.data_dir().join(&run)).map_err(|error| failed(&error))
    }

    /// Writes that an attempt of a part, by its index and their count, has saved everything, and copies all to the object store.
    pub(super) fn finish_part(
        &self,
        (index, count): (usize, usize),
        report: &JobReporter,
        retry: &RetryPolicy<'_>,
    ) -> Result<JobResult, JobFailure> {
        let path = self
            .store
            .objects()
            .data_dir()
            .join(run_key(report.id()))
            .join(LAST_FILE);
        let text = json!({"part": index, "parts": count, "attempt": report.lease().token}).to_string();
        fs::write(path, text).map_err(|error| failed(&error))?;
        self.push_part(LAST_FILE, report, retry)?;
        Ok(JobResult::of(json!({"part": index, "parts": count})))
    }

    /// Copies what a part saved to the object store, if there is a shared one. The file `last`, a path in the part's directory, marks
    /// it as complete.
    pub(super) fn push_part(
        &self,
        last: &str,
        report: &JobReporter,
        retry: &RetryPolicy<'_>,
    ) -> Result<(), JobFailure> {
        let (run, objects) = (run_key(report.id()), self.store.objects());
        retry.run(async || objects.push(&run, name(last)).await)?;
        if objects.are_shared()
            && let Err(error) = fs::remove_dir_all(objects.data_dir().join(&run))
        {
            warn!(job.id = %report.id(), %error, "could not delete this worker's copy of a part");
        }
        Ok(())
    }

    /// Copies what the parts saved from the object store; returns their directories. If `last` differs from the local copy of
    /// it, all local files are of another attempt, and deleted. `last` is a path in a part's directory.
    pub(super) fn fetch_parts(
        &self,
        parts: &[JobRow],
        last: &str,
        retry: &RetryPolicy<'_>,
    ) -> Result<Vec<PathBuf>, JobFailure> {
        let objects = self.store.objects();
        for part in parts {
            let is_there = retry.run(async || objects.pull_same(&run_key(part.id), last, name(last)).await)?;
            if objects.are_shared() && !is_there {
                let line = format!(
                    "nothing of its part {} is in the object store, so it is done again",
                    part.id
                );
                retry.report.line(line);
            }
        }
        let dir = |part: &JobRow| objects.data_dir().join(run_key(part.id));
        Ok(parts.iter().map(dir).collect())
    }

    /// Deletes what the parts saved, when it is not needed any more.
    pub(super) fn delete_parts(&self, parts: &[JobRow], retry: &RetryPolicy<'_>) -> Result<(), JobFailure> {
        for part in parts {
            retry.run(async || self.store.objects().delete(&run_key(part.id)).await)?;
        }
        Ok(())
    }
}

/// The last component of a path in the object store.
fn name(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}
