//! The work of a training: works in `runs/JOB` and publishes the next version of its model.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use serde_json::{Value, json};

use super::super::checkpoints::{self, CheckpointSync};
use super::super::executor::{JobFailure, JobResult};
use super::super::report::JobReporter;
use super::super::retry_policy::RetryPolicy;
use super::super::{JobSpec, TrainSpec};
use super::base::Base;
use super::training_report::TrainingReporter;
use super::{Pipeline, failed, request_line, run_key};
use foreframe_core::error_text;
use foreframe_core::registry::Manifest;
use foreframe_core::types::ModelName;
use foreframe_data::dataset::Dataset;
use foreframe_data::inspection::small_channels;
use foreframe_train::evaluation;
use foreframe_train::training::{self, CHECKPOINT_FILE, TrainConfig, Training, TrainingEvent, TrainingOutcome};

/// What is trained, on what.
pub(super) struct TrainingWork<'a> {
    /// The job.
    pub(super) spec: &'a JobSpec,
    pub(super) config: &'a TrainConfig,
    pub(super) dataset: &'a Dataset,
    /// The model that it starts from; `None` for new weights.
    pub(super) start: Option<&'a Base>,
}

impl TrainingWork<'_> {
    /// Updates of both stages.
    fn steps(&self) -> [usize; 2] {
        [self.config.pretrain.steps, self.config.sequence.steps]
    }
}

impl Pipeline {
    pub(super) fn train(
        &self,
        spec: &TrainSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        report.progress(0, 0, "reading the data set");
        let retry = self.retry_policy(report, cancelled);
        self.prepare_run(&retry)?;
        let job = JobSpec::Train(spec.clone());
        let base = spec
            .from
            .as_ref()
            .map(|from| self.base(&job, from, &retry))
            .transpose()?;
        let manifest = base.as_ref().map(|base| &base.weights.manifest);
        let config = spec.config(manifest).map_err(|error| failed(&error))?;
        if manifest.is_some() {
            // When it was submitted, the version was perhaps not there yet.
            let memory = self.resources.memory;
            retry.run(async || memory.check(spec, manifest, self.store.objects()).await)?;
        }
        let held_mib = self.resources.memory.held_mib() / (1 + spec.mixture.len() as u64);
        let opened = spec
            .datasets()
            .map(|(name, weight)| Ok((self.dataset(name, held_mib, &retry)?, weight)));
        let opened = opened.collect::<Result<_, JobFailure>>()?;
        let dataset = Dataset::join(opened, config.lacking()).map_err(|error| failed(&error))?;
        for line in small_channels(&dataset) {
            report.line(line);
        }
        let work = TrainingWork {
            spec: base.as_ref().map_or(&job, |base| &base.spec),
            config: &config,
            dataset: &dataset,
            start: base.as_ref(),
        };
        let (model_dir, manifest) = self.trained(&work, &retry)?;
        let steps = work.steps().iter().sum::<usize>() as u64;
        report.progress(steps, steps, "publishing");
        self.published(&spec.name, &model_dir, &manifest.metrics, &retry)
    }

    /// Trains, or continues, and calibrates. Returns the model's directory and its description.
    pub(super) fn trained(
        &self,
        work: &TrainingWork<'_>,
        retry: &RetryPolicy<'_>,
    ) -> Result<(PathBuf, Box<Manifest>), JobFailure> {
        let (report, cancelled) = (retry.report, retry.cancelled);
        let run = run_key(report.id());
        let training = Training {
            config: work.config,
            dataset: work.dataset,
            run_dir: &self.store.objects().data_dir().join(&run),
            command: &request_line(work.spec),
            start: work.start.map(|base| &base.weights),
        };
        let mut reporter = TrainingReporter {
            report,
            steps: work.steps(),
            train_loss: None,
        };
        let mut sync = CheckpointSync::default();
        let mut observer = |event: TrainingEvent| {
            reporter.on_event(event);
            match (event, work.start) {
                // The run's directory is there from here on.
                (TrainingEvent::Started { .. }, Some(start)) => {
                    if let Err(error) = self.keep_start(start, retry) {
                        let reason = error_text::with_causes(&error);
                        report.line(format!(
                            "if the version that it starts from is deleted, it cannot be resumed: {reason}"
                        ));
                    }
                }
                (TrainingEvent::Checkpointed { .. }, _) => {
                    let pushed = self.runtime.block_on(self.store.objects().push(&run, CHECKPOINT_FILE));
                    sync.record(pushed).into_iter().for_each(|line| report.line(line));
                }
                _ => {}
            }
        };
        // After an error it continues from the last checkpoint.
        match retry.repeat_once_free(|| training::run(&training, &mut observer, cancelled))? {
            TrainingOutcome::Interrupted { .. } => Err(JobFailure::Cancelled),
            TrainingOutcome::Finished { model_dir, manifest } => {
                let steps = work.steps().iter().sum::<usize>() as u64;
                report.progress(steps, steps, "calibrating");
                retry.repeat(|| evaluation::calibrate_trained(&model_dir, work.dataset, cancelled))?;
                Ok((model_dir, manifest))
            }
        }
    }

    /// Prepares the run's directory: empty at the first attempt, else with the latest checkpoint.
    pub(super) fn prepare_run(&self, retry: &RetryPolicy<'_>) -> Result<(), JobFailure> {
        let (objects, run) = (self.store.objects(), run_key(retry.report.id()));
        let is_first = retry.report.lease().token == 1;
        retry.run(async || {
            if is_first {
                return objects.delete(&run).await;
            }
            checkpoints::fetch_latest(objects, &run).await
        })
    }

    /// Publishes a trained model as the next version of that name.
    pub(super) fn published(
        &self,
        name: &ModelName,
        model_dir: &Path,
        metrics: &Value,
        retry: &RetryPolicy<'_>,
    ) -> Result<JobResult, JobFailure> {
        let report = retry.report;
        let written = retry.run(async || self.versions.write(report.lease(), name, model_dir).await)?;
        let published = written.ok_or(JobFailure::Cancelled)?;
        let version = published.version;
        report.line(format!("published as version {version} of \"{name}\""));
        Ok(JobResult {
            published: Some(published),
            ..JobResult::of(json!({"model": name, "version": version, "metrics": metrics}))
        })
    }
}
