//! Collections. A part of one works in `runs/JOB`, from where the whole takes its trials; no other job writes there, and the
//! trials depend only on their numbers, so it does not matter which worker simulated them, or how often.

use std::ops::Range;
use std::sync::atomic::AtomicBool;

use serde_json::json;
use tracing::warn;

use super::super::executor::{JobFailure, JobResult};
use super::super::report::JobReporter;
use super::super::retry_policy::RetryPolicy;
use super::super::{CollectSpec, JobState, datasets};
use super::{Pipeline, failed, run_key};
use crate::store::JobRow;
use foreframe_data::dataset::{self, CollectConfig, CollectionStatus, DatasetError};

/// The file of a part that is copied last to the object store.
const LAST_FILE: &str = "collect.json";

impl Pipeline {
    pub(super) fn collect(
        &self,
        spec: &CollectSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        let parent = self.store.objects().data_dir().join("datasets");
        let mut config = spec.config(&parent).map_err(|error| failed(&error))?;
        config.threads = self.resources.threads;
        let retry = self.retry_policy(report, cancelled);
        if let Some(part) = spec.part {
            return self.collect_part(config, spec.shards_of(part), report, &retry);
        }
        let is_stale = |was_deleted| match CollectionStatus::of(&config) {
            Err(DatasetError::OutExists { .. }) => was_deleted,
            Err(DatasetError::OtherArguments { .. }) => true,
            _ => false,
        };
        retry.run(async || datasets::clear_stale(self.store.objects(), &spec.name, is_stale).await)?;
        let parts = retry.run(async || self.store.parts(report.id()).await)?;
        self.take_parts(&config, &parts, report, &retry)?;
        // Whole shards are saved; a new attempt continues after them.
        if let Ok(CollectionStatus::Unfinished { trials }) = CollectionStatus::of(&config) {
            report.checkpoint(trials);
        }
        let on_progress = |now: dataset::CollectProgress| report.progress(now.done, now.total, "simulating");
        // After an error it continues with the shards that are finished.
        let info = retry.repeat_once_free(|| dataset::collect(&config, &on_progress, cancelled))?;
        let made = self.finish_dataset(&spec.name, &info, &retry)?;
        for part in &parts {
            retry.run(async || self.store.objects().delete(&run_key(part.id)).await)?;
        }
        Ok(JobResult::of(made))
    }

    /// Simulates the trials of a part.
    fn collect_part(
        &self,
        mut config: CollectConfig,
        shards: Range<usize>,
        report: &JobReporter,
        retry: &RetryPolicy<'_>,
    ) -> Result<JobResult, JobFailure> {
        let (run, objects) = (run_key(report.id()), self.store.objects());
        config.out = objects.data_dir().join(&run);
        // What another version of the program began does not fit.
        let is_stale = matches!(
            CollectionStatus::of(&config),
            Err(DatasetError::OutExists { .. } | DatasetError::OtherArguments { .. })
        );
        if report.lease().token == 1 || is_stale {
            retry.run(async || objects.delete(&run).await)?;
        }
        let on_progress = |now: dataset::CollectProgress| report.progress(now.done, now.total, "simulating");
        let on_saved = |trials| report.checkpoint(trials);
        retry.repeat_once_free(|| {
            dataset::collect_part(&config, shards.clone(), &on_progress, &on_saved, retry.cancelled)
        })?;
        retry.run(async || objects.push(&run, LAST_FILE).await)?;
        if objects.are_shared()
            && let Err(error) = std::fs::remove_dir_all(&config.out)
        {
            warn!(job.id = %report.id(), %error, "could not delete this worker's copy of a part");
        }
        Ok(JobResult::of(json!({"shards": [shards.start, shards.end]})))
    }

    /// Takes over the trials that the parts simulated. What is missing is simulated by this job.
    /// Errors: `Failed` if a part did not succeed.
    fn take_parts(
        &self,
        config: &CollectConfig,
        parts: &[JobRow],
        report: &JobReporter,
        retry: &RetryPolicy<'_>,
    ) -> Result<(), JobFailure> {
        if let Some(part) = parts.iter().find(|part| part.state != JobState::Succeeded.name()) {
            let reason = part.error.as_deref().unwrap_or("resume this job to collect it");
            return Err(JobFailure::Failed(format!(
                "its part {} is {}: {reason}",
                part.id, part.state
            )));
        }
        if parts.is_empty() {
            return Ok(());
        }
        report.progress(0, config.trials, "joining the parts");
        let objects = self.store.objects();
        for part in parts {
            retry.run(async || objects.pull(&run_key(part.id), LAST_FILE).await)?;
        }
        let dirs: Vec<_> = parts
            .iter()
            .map(|part| objects.data_dir().join(run_key(part.id)))
            .collect();
        retry.repeat_once_free(|| dataset::take_parts(config, &dirs))
    }
}
