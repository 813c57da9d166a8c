//! The work of jobs, below the data directory: collections and imports write `datasets/NAME`; a training or an adaptation works in
//! `runs/JOB` and publishes the next version of its model; an evaluation writes `reports/JOB`.

mod adapt;
mod base;
mod collect;
mod evaluate;
mod import;
mod parts;
mod sweep;
mod train;
mod training_report;

use std::error::Error;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use futures_util::future::BoxFuture;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use tokio::runtime::Handle;

use self::base::described;
pub use self::base::estimate_training;
use super::executor::{JobExecutor, JobFailure, JobResult};
use super::memory::JobMemory;
use super::report::JobReporter;
use super::retry_policy::RetryPolicy;
use super::spec::AvailableInputs;
use super::{EvaluateSpec, Job, JobError, JobSpec, JobState, datasets};
use crate::store::{JobId, Store};
use crate::versions::Versions;
use foreframe_core::error_text;
use foreframe_core::nn::device::DeviceName;
use foreframe_core::nn::precision::Precision;
use foreframe_core::types::{DatasetName, ModelName};
use foreframe_data::dataset::{Dataset, DatasetInfo};
use foreframe_train::evaluation;

/// What a job can use.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobResources {
    /// Where its networks compute.
    pub device: DeviceName,
    /// In which precision its evaluations predict.
    pub precision: Precision,
    /// How many threads it uses.
    pub threads: usize,
    /// Its memory: trainings that need more are refused, and no more of a data set's frames are held.
    pub memory: JobMemory,
    /// The directory that imports may read.
    pub import_dir: Option<PathBuf>,
    /// Disk space for what an import decompresses, in MiB.
    pub import_disk_mib: u64,
    /// Maximum number of files in an archive that is imported.
    pub max_import_files: u64,
}

/// Runs jobs in this process.
pub struct Pipeline {
    store: Store,
    versions: Versions,
    resources: JobResources,
    runtime: Handle,
}

impl Pipeline {
    /// A pipeline for the jobs of a store. Needs a tokio runtime.
    #[must_use]
    pub fn new(store: Store, versions: Versions, resources: JobResources) -> Self {
        Self {
            store,
            versions,
            resources,
            runtime: Handle::current(),
        }
    }
}

impl JobExecutor for Pipeline {
    fn check<'a>(&'a self, spec: &'a JobSpec) -> BoxFuture<'a, Result<JobSpec, JobError>> {
        Box::pin(self.check_spec(spec))
    }

    fn check_again<'a>(&'a self, spec: &'a JobSpec) -> BoxFuture<'a, Result<(), JobError>> {
        Box::pin(self.check_upload(spec))
    }

    fn execute(&self, spec: &JobSpec, report: &JobReporter, cancelled: &AtomicBool) -> Result<JobResult, JobFailure> {
        if let Some(after) = spec.after() {
            self.check_earlier(after, &self.retry_policy(report, cancelled))?;
        }
        let result = match spec {
            JobSpec::Collect(spec) => self.collect(spec, report, cancelled),
            JobSpec::Import(spec) => self.import(spec, report, cancelled),
            JobSpec::Train(spec) if !spec.sweep.is_empty() => {
                self.join_sweep(spec, report, &self.retry_policy(report, cancelled))
            }
            JobSpec::Train(spec) => self.train(spec, report, cancelled),
            JobSpec::Adapt(spec) => self.adapt(spec, report, cancelled),
            JobSpec::Evaluate(spec) => self.evaluate(spec, report, cancelled),
        };
        match result {
            Err(JobFailure::Failed(_)) if cancelled.load(Ordering::Acquire) => Err(JobFailure::Cancelled),
            other => other,
        }
    }
}

impl Pipeline {
    async fn check_spec(&self, spec: &JobSpec) -> Result<JobSpec, JobError> {
        let objects = self.store.objects();
        if let JobSpec::Import(spec) = spec
            && let Some(upload) = spec.upload()?
        {
            upload.fetch(objects).await?;
        }
        let (mut datasets, mut models) = (datasets::names(objects).await?, self.versions.all().await?);
        let is_there = spec.datasets().into_iter().all(|name| datasets.contains(name));
        // What the jobs before it will make; each has a smaller number than the next.
        let (mut after, mut made) = (spec.after(), None);
        while let Some(id) = after {
            let row = self.store.job(id).await?;
            if row.is_none() && spec.after() == Some(id) {
                return Err(JobError::invalid("after", format!("there is no job \"{id}\"")));
            }
            // Ended jobs are forgotten after a while; what they made is there.
            let Some(row) = row else { break };
            let earlier = Job::of(&row)?.spec;
            after = earlier.after();
            datasets.extend(earlier.made_dataset().cloned());
            if let Some(model) = earlier.made_model() {
                models.entry(model.clone()).or_default();
                // Of the others, the active version is used.
                if spec.after() == Some(id) {
                    made = Some(model.clone());
                }
            }
        }
        let (data_dir, import_dir) = (objects.data_dir().to_owned(), self.resources.import_dir.clone());
        let checked = spec.clone();
        // Reads the disk, so it runs on a blocking thread. It must not wait for other blocking work: there are few threads.
        let checked = tokio::task::spawn_blocking(move || {
            checked.check(AvailableInputs {
                data_dir: &data_dir,
                import_dir: import_dir.as_deref(),
                datasets: &datasets,
                models: &models,
            })
        });
        checked.await.unwrap_or(Err(JobError::Stopping))?;
        let spec = self.with_version_of_parts(spec, made.as_ref()).await?;
        match &spec {
            JobSpec::Train(spec) => self.check_training(spec, is_there).await?,
            // Which models fit is known when its data set is made.
            _ if !is_there => {}
            JobSpec::Adapt(spec) => self.check_adaptation(spec).await?,
            JobSpec::Evaluate(spec) => self.check_evaluation(spec).await?,
            JobSpec::Collect(_) | JobSpec::Import(_) => {}
        }
        Ok(spec)
    }

    /// Errors: `Invalid` if an import's uploaded file is gone.
    async fn check_upload(&self, spec: &JobSpec) -> Result<(), JobError> {
        let JobSpec::Import(spec) = spec else { return Ok(()) };
        let Some(upload) = spec.upload()? else { return Ok(()) };
        let objects = self.store.objects();
        upload.fetch(objects).await?;
        upload.existing(objects.data_dir()).map(drop)
    }

    /// Errors: `Invalid` if a model that is there cannot run on the data set.
    async fn check_evaluation(&self, spec: &EvaluateSpec) -> Result<(), JobError> {
        let info = described(self.store.objects(), &spec.dataset).await?;
        let fits = async |name: &ModelName, version: Option<u32>| {
            // What cannot be read says so when the job runs.
            let Ok(manifest) = self.versions.manifest(name, version).await else {
                return Ok(());
            };
            let fit = evaluation::check_fit(&manifest, &info);
            fit.map_err(|error| JobError::invalid("dataset", error.to_string()))
        };
        // Without a version, an earlier job may make the one that is meant.
        if spec.version.is_some() || spec.after.is_none() {
            fits(&spec.model, spec.version).await?;
        }
        match &spec.twin {
            Some(twin) if spec.after.is_none() => fits(twin, None).await,
            _ => Ok(()),
        }
    }

    /// Errors: `Failed` if the job that another waited for did not succeed.
    fn check_earlier(&self, after: JobId, retry: &RetryPolicy<'_>) -> Result<(), JobFailure> {
        match retry.run(async || self.store.job(after).await)? {
            Some(row) if row.state != JobState::Succeeded.name() => Err(JobFailure::Failed(format!(
                "{after}, for which it waited, is {}; resume that one, then this one",
                row.state
            ))),
            // It has succeeded. (If not, its row stays until this job has succeeded.)
            _ => Ok(()),
        }
    }

    /// Opens a data set with at most `held_mib` MiB of its frames in memory.
    fn dataset(&self, name: &DatasetName, held_mib: u64, retry: &RetryPolicy<'_>) -> Result<Dataset, JobFailure> {
        let fetched = retry.run(async || datasets::fetch(self.store.objects(), name).await)?;
        Dataset::open_within(&fetched, held_mib).map_err(|error| failed(&error))
    }

    /// Copies a finished data set to the object store, if there is a shared one, and returns the job's result.
    fn finish_dataset(
        &self,
        name: &DatasetName,
        info: &DatasetInfo,
        retry: &RetryPolicy<'_>,
    ) -> Result<Value, JobFailure> {
        let objects = self.store.objects();
        retry.run(async || objects.push(&datasets::key(name), datasets::LAST_FILE).await)?;
        Ok(json!({
            "dataset": name, "episodes": info.episode_count, "frames": info.frame_count, "content_hash": info.content_hash,
        }))
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

/// The key of the directory in which a job trains.
#[must_use]
pub fn run_key(id: JobId) -> String {
    format!("runs/{id}")
}

/// The request that made the job, as the command of manifests and reports.
fn request_line(spec: &JobSpec) -> String {
    format!("POST /v1/jobs {}", serde_json::to_string(spec).unwrap_or_default())
}

fn failed(error: &dyn Error) -> JobFailure {
    JobFailure::Failed(error_text::with_causes(error))
}
