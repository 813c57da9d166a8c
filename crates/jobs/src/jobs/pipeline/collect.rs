//! Collections. A part of one works in `runs/JOB`, from where the whole takes its trials; no other job writes there, and the
//! trials depend only on their numbers, so it does not matter which worker simulated them, or how often.

use std::ops::Range;
use std::sync::atomic::AtomicBool;

use serde_json::json;

use super::super::executor::{JobFailure, JobResult};
use super::super::report::JobReporter;
use super::super::retry_policy::RetryPolicy;
use super::super::{CollectSpec, datasets};
use super::{Pipeline, failed, run_key};
use crate::store::JobRow;
use foreframe_data::dataset::{self, CollectConfig, CollectionStatus, DatasetError};

/// The file of a part that is copied last to the object store.
const LAST_FILE: &str = "meta/collect.json";

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
        let parts = self.ended_parts(report, &retry)?;
        self.take_parts(&config, &parts, report, &retry)?;
        // Whole shards are saved; a new attempt continues after them.
        if let Ok(CollectionStatus::Unfinished { trials }) = CollectionStatus::of(&config) {
            report.checkpoint(trials);
        }
        let on_progress = |now: dataset::CollectProgress| report.progress(now.done, now.total, "simulating");
        // After an error it continues with the shards that are finished.
        let info = retry.repeat_once_free(|| dataset::collect(&config, &on_progress, cancelled))?;
        let made = self.finish_dataset(&spec.name, &info, &retry)?;
        self.delete_parts(&parts, &retry)?;
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
        self.push_part(LAST_FILE, report, retry)?;
        Ok(JobResult::of(json!({"shards": [shards.start, shards.end]})))
    }

    /// Takes over the trials that the parts simulated. What is missing is simulated by this job.
    fn take_parts(
        &self,
        config: &CollectConfig,
        parts: &[JobRow],
        report: &JobReporter,
        retry: &RetryPolicy<'_>,
    ) -> Result<(), JobFailure> {
        if parts.is_empty() {
            return Ok(());
        }
        report.progress(0, config.trials, "joining the parts");
        let dirs = self.fetch_parts(parts, LAST_FILE, retry)?;
        retry.repeat_once_free(|| dataset::take_parts(config, &dirs))
    }
}
