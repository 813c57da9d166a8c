//! The work itself, below the data directory: collections into `datasets/NAME`, trainings in `runs/JOB`, whose model
//! becomes the next version of its name, evaluations into `reports/JOB`.

use std::error::Error;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use futures_util::future::BoxFuture;
use serde_json::json;
use tokio::runtime::Handle;

use super::checkpoints::{self, CheckpointSync};
use super::runner::{JobExecutor, JobFailure, JobReporter, JobResult};
use super::spec::AvailableInputs;
use super::{CollectSpec, EvaluateSpec, JobError, JobSpec, Losses, TrainSpec, datasets};
use crate::dataset::{self, Dataset, DatasetError};
use crate::evaluation::{self, EvaluateConfig};
use crate::registry::LoadedModel;
use crate::store::{LossRow, Store};
use crate::training::{self, CHECKPOINT_FILE, TrainError, Training, TrainingEvent, TrainingStage};
use crate::types::Seed;
use crate::versions::{VersionError, Versions};
use crate::error_text;

/// The file of a report that is written last.
const REPORT_FILE: &str = "report.json";
/// Points of a stage's training loss, besides those of its validations.
const CURVE_POINTS: usize = 500;
/// How long a job waits for a process that was taken for dead to let go of the directory.
const BUSY_PATIENCE: Duration = Duration::from_mins(1);
/// How often it looks whether that has.
const BUSY_POLL: Duration = Duration::from_millis(200);

/// What works on jobs.
pub struct Pipeline {
    store: Store,
    versions: Versions,
    threads: usize,
    runtime: Handle,
}

impl Pipeline {
    /// One that collects on so many threads. To be called within a tokio runtime.
    #[must_use]
    pub fn new(store: Store, versions: Versions, threads: usize) -> Self {
        Self {
            store,
            versions,
            threads,
            runtime: Handle::current(),
        }
    }
}

impl JobExecutor for Pipeline {
    fn check<'a>(&'a self, spec: &'a JobSpec) -> BoxFuture<'a, Result<(), JobError>> {
        Box::pin(self.look_over(spec.clone()))
    }

    fn execute(&self, spec: &JobSpec, report: &JobReporter, cancelled: &AtomicBool) -> Result<JobResult, JobFailure> {
        let result = match spec {
            JobSpec::Collect(spec) => self.collect(spec, report, cancelled),
            JobSpec::Train(spec) => self.train(spec, report, cancelled),
            JobSpec::Evaluate(spec) => self.evaluate(spec, report, cancelled),
        };
        match result {
            Err(JobFailure::Failed(_)) if cancelled.load(Ordering::Acquire) => Err(JobFailure::Cancelled),
            other => other,
        }
    }
}

impl Pipeline {
    async fn look_over(&self, spec: JobSpec) -> Result<(), JobError> {
        let objects = self.store.objects();
        let (datasets, models) = (datasets::names(objects).await?, self.versions.all().await?);
        let data_dir = objects.data_dir().to_owned();
        // It looks at the disk, and must wait for nothing that needs a thread of the same kind: there are only so many.
        let checked = tokio::task::spawn_blocking(move || {
            spec.check(AvailableInputs {
                data_dir: &data_dir,
                datasets: &datasets,
                models: &models,
            })
        });
        checked.await.unwrap_or(Err(JobError::Stopping))
    }

    fn collect(
        &self,
        spec: &CollectSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        let parent = self.store.objects().data_dir().join("datasets");
        let mut config = spec.config(&parent).map_err(|error| failed(&error))?;
        config.threads = self.threads;
        let making_way = datasets::make_way(self.store.objects(), &spec.name, &config);
        self.runtime.block_on(making_way).map_err(|error| failed(&error))?;
        let on_progress =
            |progress: dataset::CollectProgress| report.progress(progress.done, progress.total, "simulating");
        let collect = || dataset::collect(&config, &on_progress, cancelled);
        let is_busy = |error: &DatasetError| matches!(error, DatasetError::Busy { .. });
        let info = once_free(collect, is_busy, cancelled).map_err(|error| failed(&error))?;
        self.push(&datasets::key(&spec.name), datasets::LAST_FILE)?;
        Ok(JobResult {
            result: json!({
                "dataset": spec.name, "episodes": info.episode_count, "frames": info.frame_count,
                "content_hash": info.content_hash,
            }),
            published: None,
        })
    }

    fn train(&self, spec: &TrainSpec, report: &JobReporter, cancelled: &AtomicBool) -> Result<JobResult, JobFailure> {
        let config = spec.config().map_err(|error| failed(&error))?;
        let run = format!("runs/{}", report.id());
        report.progress(0, 0, "reading the data set");
        self.prepare_run(&run, report)?;
        let dataset = self.dataset(&spec.dataset)?;
        let run_dir = self.store.objects().data_dir().join(&run);
        let training = Training {
            config: &config,
            dataset: &dataset,
            run_dir: &run_dir,
            command: &command(spec),
        };
        let mut watch = TrainingReporter {
            report,
            steps: [config.pretrain.steps, config.fit.steps],
            train_loss: None,
        };
        let mut keeping = CheckpointSync::default();
        let mut observer = |event: TrainingEvent| {
            watch.on_event(event);
            if matches!(event, TrainingEvent::Checkpointed { .. }) {
                let pushing = self.store.objects().push(&run, CHECKPOINT_FILE);
                if let Some(line) = keeping.note(self.runtime.block_on(pushing)) {
                    report.line(line);
                }
            }
        };
        let train = || training::run(&training, &mut observer, cancelled);
        let is_busy = |error: &TrainError| matches!(error, TrainError::Busy(_));
        match once_free(train, is_busy, cancelled).map_err(|error| failed(&error))? {
            training::TrainingOutcome::Interrupted { .. } => Err(JobFailure::Cancelled),
            training::TrainingOutcome::Finished { model_dir, manifest } => {
                let steps = (config.pretrain.steps + config.fit.steps) as u64;
                report.progress(steps, steps, "publishing");
                let written = self.versions.write(report.lease(), &spec.name, &model_dir);
                let written = self.runtime.block_on(written).map_err(|error| failed(&error))?;
                let (version, activates) = written.ok_or(JobFailure::Cancelled)?;
                report.line(format!("published as version {version} of \"{}\"", spec.name));
                Ok(JobResult {
                    result: json!({"model": spec.name, "version": version, "metrics": manifest.metrics}),
                    published: Some((spec.name.clone(), version, activates)),
                })
            }
        }
    }

    /// Has the run's directory hold its last checkpoint, and at its first taking up nothing.
    fn prepare_run(&self, run: &str, report: &JobReporter) -> Result<(), JobFailure> {
        let objects = self.store.objects();
        let prepared = self.runtime.block_on(async {
            if report.lease().token == 1 {
                return objects.delete(run).await;
            }
            checkpoints::recall(objects, run).await
        });
        prepared.map_err(|error| failed(&error))
    }

    fn evaluate(
        &self,
        spec: &EvaluateSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        let loaded = self.model(&spec.model, spec.version)?;
        let twin = spec.twin.as_deref().map(|twin| self.model(twin, None)).transpose()?;
        report.progress(0, 0, "reading the data set");
        let dataset = self.dataset(&spec.dataset)?;
        let config = EvaluateConfig {
            max_windows: spec.windows,
            bootstrap_samples: spec.resamples,
            seed: Seed(spec.seed),
            twin: twin.as_ref(),
            command: posted(&JobSpec::Evaluate(spec.clone())),
            cancelled: Some(cancelled),
            ..EvaluateConfig::default()
        };
        let found = evaluation::run(&loaded, &dataset, &config, &|now| {
            let what = match now.stage {
                evaluation::EvaluationStage::Scores => "scores",
                evaluation::EvaluationStage::Actions => "actions",
            };
            report.progress(now.done as u64, now.total as u64, &format!("{} {what}", now.split));
        });
        let mut found = found.map_err(|error| failed(&error))?;
        let figures = evaluation::figure_inputs(&loaded, &dataset, &found).map_err(|error| failed(&error))?;
        let dir = report_key(&report.id());
        // What an attempt that broke off left is of no use.
        let cleared = self.runtime.block_on(self.store.objects().delete(&dir));
        cleared.map_err(|error| failed(&error))?;
        let out = self.store.objects().data_dir().join(&dir);
        evaluation::prepare(&out)
            .and_then(|()| evaluation::write(&out, &mut found, &figures))
            .map_err(|error| failed(&error))?;
        self.push(&dir, REPORT_FILE)?;
        let mut files: Vec<String> = std::fs::read_dir(&out)
            .map_err(|error| failed(&error))?
            .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
            .collect();
        files.sort();
        Ok(JobResult {
            result: json!({
                "model": spec.model, "version": loaded.manifest.version, "scores": found.headline(), "files": files,
            }),
            published: None,
        })
    }

    fn model(&self, name: &str, version: Option<u32>) -> Result<LoadedModel, JobFailure> {
        let loaded: Result<LoadedModel, VersionError> = self.runtime.block_on(async {
            match version {
                Some(version) => self.versions.load(name, version).await,
                None => self.versions.load_active(name).await,
            }
        });
        loaded.map_err(|error| failed(&error))
    }

    fn dataset(&self, name: &str) -> Result<Dataset, JobFailure> {
        let fetched = self.runtime.block_on(datasets::fetch(self.store.objects(), name));
        Dataset::open(&fetched.map_err(|error| failed(&error))?).map_err(|error| failed(&error))
    }

    fn push(&self, dir: &str, last: &str) -> Result<(), JobFailure> {
        let pushed = self.runtime.block_on(self.store.objects().push(dir, last));
        pushed.map_err(|error| failed(&error))
    }
}

/// Tries until nobody else works in the directory, for so long at most, or until it is cancelled.
fn once_free<T, E>(
    mut work: impl FnMut() -> Result<T, E>,
    is_busy: impl Fn(&E) -> bool,
    cancelled: &AtomicBool,
) -> Result<T, E> {
    let began = Instant::now();
    loop {
        let done = work();
        let may_wait = began.elapsed() < BUSY_PATIENCE && !cancelled.load(Ordering::Acquire);
        match done {
            Err(error) if is_busy(&error) && may_wait => std::thread::sleep(BUSY_POLL),
            done => return done,
        }
    }
}

/// The directory of a job's report among the objects.
#[must_use]
pub fn report_key(id: &str) -> String {
    format!("reports/{id}")
}

/// Writes a training's events down.
struct TrainingReporter<'a> {
    report: &'a JobReporter,
    /// Of each stage.
    steps: [usize; 2],
    train_loss: Option<f64>,
}

impl TrainingReporter<'_> {
    fn on_event(&mut self, event: TrainingEvent) {
        match event {
            TrainingEvent::Started { stage, step, windows } => {
                self.progress(stage, step);
                self.report
                    .line(format!("{stage} from step {step}, on {windows} windows"));
            }
            // What was not written before the process died must be in the curves all the same.
            TrainingEvent::Restored {
                stage,
                step,
                train_loss,
                validation_loss,
            } => {
                self.train_loss = Some(train_loss);
                self.point(stage, step, Some(validation_loss));
            }
            TrainingEvent::Step {
                stage,
                step,
                steps,
                loss,
            } => {
                if step == 1 {
                    self.report.stage();
                }
                self.progress(stage, step);
                self.train_loss = Some(loss);
                self.report.losses(Losses {
                    train: Some(loss),
                    validation: None,
                });
                if step.is_multiple_of(steps.div_ceil(CURVE_POINTS)) {
                    self.point(stage, step, None);
                }
            }
            TrainingEvent::Validated {
                stage,
                step,
                loss,
                is_best,
            } => {
                self.report.losses(Losses {
                    train: None,
                    validation: Some(loss),
                });
                self.point(stage, step, Some(loss));
                let best = if is_best { ", the best so far" } else { "" };
                self.report
                    .line(format!("{stage} step {step}: validation MSE {loss:.6}{best}"));
            }
            TrainingEvent::Checkpointed { .. } => {}
        }
    }

    fn progress(&self, stage: TrainingStage, step: usize) {
        let [pretrain, fit] = self.steps;
        let done = match stage {
            TrainingStage::Pretrain => step,
            TrainingStage::Fit => pretrain + step,
        };
        self.report
            .progress(done as u64, (pretrain + fit) as u64, &stage.to_string());
    }

    fn point(&self, stage: TrainingStage, step: usize, validation: Option<f64>) {
        self.report.point(LossRow {
            stage: stage.to_string(),
            step: step as i64,
            train: self.train_loss,
            validation,
        });
    }
}

/// What the manifest tells of how the model was made.
fn command(spec: &TrainSpec) -> String {
    posted(&JobSpec::Train(spec.clone()))
}

fn posted(spec: &JobSpec) -> String {
    format!("POST /v1/jobs {}", serde_json::to_string(spec).unwrap_or_default())
}

fn failed(error: &dyn Error) -> JobFailure {
    JobFailure::Failed(error_text::with_causes(error))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tries work that is busy that often; says what came of it and how often it was tried.
    fn tried(busy: u32, cancelled: bool) -> (Result<(), bool>, u32) {
        let mut tries = 0;
        let work = || {
            tries += 1;
            if tries > busy { Ok(()) } else { Err(true) }
        };
        let done = once_free(work, |is_busy| *is_busy, &AtomicBool::new(cancelled));
        (done, tries)
    }

    #[test]
    fn work_begins_once_the_directory_is_free_or_never_if_it_is_cancelled() {
        assert_eq!(tried(2, false), (Ok(()), 3));
        assert_eq!(tried(2, true), (Err(true), 1));
    }

    #[test]
    fn other_errors_are_told_at_once() {
        let mut tries = 0;
        let work = || -> Result<(), bool> {
            tries += 1;
            Err(false)
        };
        assert_eq!(once_free(work, |is_busy| *is_busy, &AtomicBool::new(false)), Err(false));
        assert_eq!(tries, 1);
    }
}
