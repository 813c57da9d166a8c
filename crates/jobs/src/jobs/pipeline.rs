//! The work of jobs, below the data directory: collections and imports write `datasets/NAME`; a training works in `runs/JOB` and
//! publishes the next version of its model; an evaluation writes `reports/JOB`.

mod import;
mod training_report;

use std::error::Error;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use futures_util::future::BoxFuture;
use serde_json::json;
use tokio::runtime::Handle;

use self::training_report::TrainingReporter;
use super::checkpoints::{self, CheckpointSync};
use super::executor::{JobExecutor, JobFailure, JobResult};
use super::memory::JobMemory;
use super::report::JobReporter;
use super::retry_policy::{RetryPolicy, retry_while_busy};
use super::spec::AvailableInputs;
use super::{CollectSpec, EvaluateSpec, JobError, JobSpec, TrainSpec, datasets};
use crate::store::{JobId, ModelMetrics, Store, StoreError};
use crate::versions::{VersionError, Versions};
use foreframe_core::error_text;
use foreframe_core::files::remove_dir;
use foreframe_core::registry::Model;
use foreframe_core::types::{DatasetName, ModelName, Seed};
use foreframe_data::dataset::import::DEFAULT_DISK_MIB;
use foreframe_data::dataset::{self, Dataset, DatasetError};
use foreframe_train::evaluation::{self, EvaluateConfig, EvaluationError};
use foreframe_train::training::{self, CHECKPOINT_FILE, TrainError, Training, TrainingEvent};

/// The file of an evaluation's report that is written last.
const REPORT_FILE: &str = "report.json";

/// Runs jobs in this process.
pub struct Pipeline {
    store: Store,
    versions: Versions,
    threads: usize,
    memory: JobMemory,
    import_dir: Option<PathBuf>,
    import_disk_mib: u64,
    runtime: Handle,
}

impl Pipeline {
    /// A pipeline that collects on `threads` threads. Needs a tokio runtime.
    #[must_use]
    pub fn new(store: Store, versions: Versions, threads: usize) -> Self {
        Self {
            store,
            versions,
            threads,
            memory: JobMemory::default(),
            import_dir: None,
            import_disk_mib: DEFAULT_DISK_MIB,
            runtime: Handle::current(),
        }
    }

    /// Refuses trainings that need more memory, and holds no more of a data set's frames.
    #[must_use]
    pub fn with_memory(self, memory: JobMemory) -> Self {
        Self { memory, ..self }
    }

    /// Lets imports read recordings below this directory.
    #[must_use]
    pub fn with_import_dir(self, import_dir: Option<PathBuf>) -> Self {
        Self { import_dir, ..self }
    }

    /// Refuses imports that decompress more frames than this, in MiB.
    #[must_use]
    pub fn with_import_disk(self, import_disk_mib: u64) -> Self {
        Self {
            import_disk_mib,
            ..self
        }
    }
}

impl JobExecutor for Pipeline {
    fn check<'a>(&'a self, spec: &'a JobSpec) -> BoxFuture<'a, Result<(), JobError>> {
        Box::pin(self.check_spec(spec.clone()))
    }

    fn execute(&self, spec: &JobSpec, report: &JobReporter, cancelled: &AtomicBool) -> Result<JobResult, JobFailure> {
        let result = match spec {
            JobSpec::Collect(spec) => self.collect(spec, report, cancelled),
            JobSpec::Import(spec) => self.import(spec, report, cancelled),
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
    async fn check_spec(&self, spec: JobSpec) -> Result<(), JobError> {
        let objects = self.store.objects();
        let (datasets, models) = (datasets::names(objects).await?, self.versions.all().await?);
        let (data_dir, import_dir) = (objects.data_dir().to_owned(), self.import_dir.clone());
        let training = match &spec {
            JobSpec::Train(spec) => Some(spec.clone()),
            _ => None,
        };
        // Reads the disk, so it runs on a blocking thread. It must not wait for other blocking work: there are few threads.
        let checked = tokio::task::spawn_blocking(move || {
            spec.check(AvailableInputs {
                data_dir: &data_dir,
                import_dir: import_dir.as_deref(),
                datasets: &datasets,
                models: &models,
            })
        });
        checked.await.unwrap_or(Err(JobError::Stopping))?;
        match training {
            Some(spec) => self.check_memory(&spec).await,
            None => Ok(()),
        }
    }

    /// Refuses a training that certainly needs more memory than a job can use. Errors: `Invalid`, `Dataset`, `Store`.
    async fn check_memory(&self, spec: &TrainSpec) -> Result<(), JobError> {
        let config = spec.config()?;
        let dataset = datasets::describe(self.store.objects(), &spec.dataset).await?;
        self.memory.check(&config, &dataset)
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
        let retry = self.retry_policy(report, cancelled);
        retry.run(async || datasets::clear_stale(self.store.objects(), &spec.name, &config).await)?;
        let on_progress =
            |progress: dataset::CollectProgress| report.progress(progress.done, progress.total, "simulating");
        // Whole shards are saved; a new attempt continues after them.
        if let Ok(dataset::CollectionStatus::Unfinished { trials }) = dataset::CollectionStatus::of(&config) {
            report.checkpoint(trials);
        }
        let collect = || dataset::collect(&config, &on_progress, cancelled);
        let is_busy = |error: &DatasetError| matches!(error, DatasetError::Busy { .. });
        // After an error it continues with the shards that are finished.
        let info = retry.repeat(|| retry_while_busy(collect, is_busy, cancelled))?;
        self.push_dataset(&spec.name, &retry)?;
        Ok(JobResult {
            result: json!({
                "dataset": spec.name, "episodes": info.episode_count, "frames": info.frame_count,
                "content_hash": info.content_hash,
            }),
            published: None,
            measured: None,
        })
    }

    fn train(&self, spec: &TrainSpec, report: &JobReporter, cancelled: &AtomicBool) -> Result<JobResult, JobFailure> {
        let config = spec.config().map_err(|error| failed(&error))?;
        let run = format!("runs/{}", report.id());
        report.progress(0, 0, "reading the data set");
        let retry = self.retry_policy(report, cancelled);
        retry.run(async || self.prepare_run(&run, report).await)?;
        let dataset = self.dataset(&spec.dataset, &retry)?;
        let training = Training {
            config: &config,
            dataset: &dataset,
            run_dir: &self.store.objects().data_dir().join(&run),
            command: &command(spec),
            start: None,
        };
        let mut reporter = TrainingReporter {
            report,
            steps: [config.pretrain.steps, config.sequence.steps],
            train_loss: None,
        };
        let mut sync = CheckpointSync::default();
        let mut observer = |event: TrainingEvent| {
            reporter.on_event(event);
            if matches!(event, TrainingEvent::Checkpointed { .. }) {
                let pushed = self.runtime.block_on(self.store.objects().push(&run, CHECKPOINT_FILE));
                sync.record(pushed).into_iter().for_each(|line| report.line(line));
            }
        };
        let mut train = || training::run(&training, &mut observer, cancelled);
        let is_busy = |error: &TrainError| matches!(error, TrainError::Busy(_));
        // After an error it continues from the last checkpoint.
        match retry.repeat(|| retry_while_busy(&mut train, is_busy, cancelled))? {
            training::TrainingOutcome::Interrupted { .. } => Err(JobFailure::Cancelled),
            training::TrainingOutcome::Finished { model_dir, manifest } => {
                let steps = (config.pretrain.steps + config.sequence.steps) as u64;
                report.progress(steps, steps, "calibrating");
                retry.repeat(|| evaluation::calibrate_trained(&model_dir, &dataset, cancelled))?;
                report.progress(steps, steps, "publishing");
                let written = retry.run(async || self.versions.write(report.lease(), &spec.name, &model_dir).await)?;
                let published = written.ok_or(JobFailure::Cancelled)?;
                let version = published.version;
                report.line(format!("published as version {version} of \"{}\"", spec.name));
                Ok(JobResult {
                    result: json!({"model": spec.name, "version": version, "metrics": manifest.metrics}),
                    published: Some(published),
                    measured: None,
                })
            }
        }
    }

    /// Prepares the run's directory: empty at the first attempt, else with the latest checkpoint.
    async fn prepare_run(&self, run: &str, report: &JobReporter) -> Result<(), StoreError> {
        let objects = self.store.objects();
        if report.lease().token == 1 {
            return objects.delete(run).await;
        }
        checkpoints::fetch_latest(objects, run).await
    }

    fn evaluate(
        &self,
        spec: &EvaluateSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        let retry = self.retry_policy(report, cancelled);
        let model = |name: &ModelName, version| retry.run(async || self.model(name, version).await);
        let loaded = model(&spec.model, spec.version)?;
        let twin = spec.twin.as_ref().map(|twin| model(twin, None)).transpose()?;
        report.progress(0, 0, "reading the data set");
        let dataset = self.dataset(&spec.dataset, &retry)?;
        let config = EvaluateConfig {
            max_windows: spec.windows,
            bootstrap_samples: spec.resamples,
            seed: Seed(spec.seed),
            twins: twin.iter().collect(),
            command: request_line(&JobSpec::Evaluate(spec.clone())),
            cancelled: Some(cancelled),
            ..EvaluateConfig::default()
        };
        let found = evaluation::run(&loaded, &dataset, &config, &|now| {
            let stage = now.stage.name();
            report.progress(now.done as u64, now.total as u64, &format!("{} {stage}", now.split));
        });
        let mut found = found.map_err(|error| failed(&error))?;
        let figures = evaluation::draw_figures(&loaded, &dataset, &found).map_err(|error| failed(&error))?;
        let dir = report_key(report.id());
        // An earlier attempt may have left an incomplete report.
        retry.run(async || self.store.objects().delete(&dir).await)?;
        let out = self.store.objects().data_dir().join(&dir);
        retry.repeat(|| {
            // So may a write that failed.
            remove_dir(&out).map_err(|source| EvaluationError::Io {
                path: out.clone(),
                source,
            })?;
            evaluation::prepare(&out)?;
            evaluation::write(&out, &mut found, &figures)
        })?;
        retry.run(async || self.store.objects().push(&dir, REPORT_FILE).await)?;
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
            measured: Some(ModelMetrics {
                model: spec.model.clone(),
                version: loaded.manifest.version,
                weights_sha256: loaded.manifest.weights_sha256.clone(),
                metrics: found.headline().to_string(),
            }),
        })
    }

    async fn model(&self, name: &ModelName, version: Option<u32>) -> Result<Model, VersionError> {
        match version {
            Some(version) => self.versions.load(name, version).await,
            None => self.versions.load_active(name).await,
        }
    }

    fn dataset(&self, name: &DatasetName, retry: &RetryPolicy<'_>) -> Result<Dataset, JobFailure> {
        let fetched = retry.run(async || datasets::fetch(self.store.objects(), name).await)?;
        Dataset::open_within(&fetched, self.memory.held_mib()).map_err(|error| failed(&error))
    }

    /// Copies a finished data set to the object store, if there is a shared one.
    fn push_dataset(&self, name: &DatasetName, retry: &RetryPolicy<'_>) -> Result<(), JobFailure> {
        let objects = self.store.objects();
        retry.run(async || objects.push(&datasets::key(name), datasets::LAST_FILE).await)
    }

    fn retry_policy<'a>(&'a self, report: &'a JobReporter, cancelled: &'a AtomicBool) -> RetryPolicy<'a> {
        RetryPolicy {
            runtime: &self.runtime,
            report,
            cancelled,
        }
    }
}

/// The key of the directory of a job's report.
#[must_use]
pub fn report_key(id: JobId) -> String {
    format!("reports/{id}")
}

/// The command that the manifest records.
fn command(spec: &TrainSpec) -> String {
    request_line(&JobSpec::Train(spec.clone()))
}

fn request_line(spec: &JobSpec) -> String {
    format!("POST /v1/jobs {}", serde_json::to_string(spec).unwrap_or_default())
}

fn failed(error: &dyn Error) -> JobFailure {
    JobFailure::Failed(error_text::with_causes(error))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Retries work that is busy `busy` times. Returns its result and the number of tries.
    fn tried(busy: u32, cancelled: bool) -> (Result<(), bool>, u32) {
        let mut tries = 0;
        let work = || {
            tries += 1;
            if tries > busy { Ok(()) } else { Err(true) }
        };
        let done = retry_while_busy(work, |is_busy| *is_busy, &AtomicBool::new(cancelled));
        (done, tries)
    }

    #[test]
    fn work_starts_once_the_directory_is_free_unless_cancelled() {
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
        assert_eq!(
            retry_while_busy(work, |is_busy| *is_busy, &AtomicBool::new(false)),
            Err(false)
        );
        assert_eq!(tries, 1);
    }
}
