//! The version of a model that a job uses, and the weights that a training or an adaptation starts from.

use std::path::{Path, PathBuf};

use serde_json::Value;

use super::super::executor::JobFailure;
use super::super::memory::{JobMemory, TrainingEstimate};
use super::super::retry_policy::RetryPolicy;
use super::super::spec::train::check_from;
use super::super::{Job, JobError, JobSpec, TrainSpec, datasets};
use super::{Pipeline, failed, run_key};
use crate::store::{JobId, Objects, StoreError};
use crate::versions::{VersionError, Versions};
use foreframe_core::error_kind::{ErrorKind, HasErrorKind as _};
use foreframe_core::error_text;
use foreframe_core::files::write_atomically;
use foreframe_core::registry::{self, MANIFEST_FILE, Manifest, StoredWeights, WEIGHTS_FILE};
use foreframe_core::types::{DatasetName, ModelName};
use foreframe_data::dataset::DatasetInfo;
use foreframe_train::training::{self, TrainConfig, TrainError};

/// The folder of a run with a copy of the model that it starts from.
const START_DIR: &str = "start";

/// The model that a job starts from.
pub(super) struct Base {
    pub(super) weights: StoredWeights,
    /// Its directory.
    pub(super) dir: PathBuf,
    /// The job, with the version that it starts from.
    pub(super) spec: JobSpec,
}

impl Pipeline {
    /// Loads the model `from`. If its version was deleted since the training began, it is the copy in the job's run. Errors:
    /// `Cancelled` if the lease is lost.
    pub(super) fn base(&self, spec: &JobSpec, from: &ModelName, retry: &RetryPolicy<'_>) -> Result<Base, JobFailure> {
        let version = self.used_version(spec, from, retry)?;
        let kept = self.kept_start(retry);
        let dir = retry.run(async || match self.versions.directory(from, version).await {
            Err(VersionError::Unknown { .. }) if kept.join(MANIFEST_FILE).is_file() => Ok(kept.clone()),
            found => found,
        })?;
        let weights = retry.repeat(|| load_base(&dir, from, version))?;
        let spec = self.with_version_written(spec, version, retry)?;
        Ok(Base { weights, dir, spec })
    }

    /// The version of a model that a job uses: the one that it names, else the one that the job before it made, else the active one.
    pub(super) fn used_version(
        &self,
        spec: &JobSpec,
        model: &ModelName,
        retry: &RetryPolicy<'_>,
    ) -> Result<u32, JobFailure> {
        let version = match (spec.used_version(), spec.after()) {
            (None, Some(after)) => retry.run(async || self.made_version(after, model).await)?,
            (version, _) => version,
        };
        match version {
            Some(version) => Ok(version),
            None => Ok(retry
                .run(async || self.versions.active(model).await)?
                .unwrap_or_default()),
        }
    }

    /// The version of a model that a job made, if it made one.
    async fn made_version(&self, job: JobId, model: &ModelName) -> Result<Option<u32>, JobError> {
        let Some(row) = self.store.job(job).await? else {
            return Ok(None);
        };
        let makes_it = Job::of(&row)?.spec.made_model() == Some(model);
        let outcome = row.outcome.filter(|_| makes_it);
        let made: Option<Value> = outcome.and_then(|outcome| serde_json::from_str(&outcome).ok());
        Ok(made.and_then(|made| u32::try_from(made["version"].as_u64()?).ok()))
    }

    /// Writes the version that a job uses to the job, so that a later attempt uses the same one. Errors: `Cancelled` if the lease is
    /// lost.
    pub(super) fn with_version_written(
        &self,
        spec: &JobSpec,
        version: u32,
        retry: &RetryPolicy<'_>,
    ) -> Result<JobSpec, JobFailure> {
        let with_version = spec.with_used_version(Some(version));
        if with_version != *spec {
            let text = serde_json::to_string(&with_version).map_err(|error| failed(&error))?;
            let is_written = retry.run(async || self.store.set_spec(retry.report.lease(), &text).await)?;
            if !is_written {
                return Err(JobFailure::Cancelled);
            }
        }
        Ok(with_version)
    }

    /// A job as it is to be enqueued: all its parts use the version that is active now. It stays as it is without parts, and if the
    /// job that it waits for makes the model (`made`).
    pub(super) async fn with_version_of_parts(
        &self,
        spec: &JobSpec,
        made: Option<&ModelName>,
    ) -> Result<JobSpec, JobError> {
        match (spec.used_model(), spec.used_version()) {
            (Some(model), None) if made != Some(model) && !spec.parts().is_empty() => {
                Ok(spec.with_used_version(self.versions.active(model).await?))
            }
            _ => Ok(spec.clone()),
        }
    }

    /// Keeps a copy of the model that a job starts from in the job's run, unless it was shipped and cannot be deleted.
    pub(super) fn keep_start(&self, base: &Base, retry: &RetryPolicy<'_>) -> Result<(), StoreError> {
        let (kept, manifest) = (self.kept_start(retry), &base.weights.manifest);
        let is_shipped = self.versions.shipped(&manifest.name) == Some(manifest.version);
        if is_shipped || kept.join(MANIFEST_FILE).is_file() {
            return Ok(());
        }
        std::fs::create_dir_all(&kept).map_err(StoreError::io("make", &kept))?;
        for file in [WEIGHTS_FILE, MANIFEST_FILE] {
            let [from, to] = [&base.dir, &kept].map(|dir| dir.join(file));
            let bytes = std::fs::read(&from).map_err(StoreError::io("read", &from))?;
            write_atomically(&to, &bytes).map_err(StoreError::io("write", &to))?;
        }
        Ok(())
    }

    fn kept_start(&self, retry: &RetryPolicy<'_>) -> PathBuf {
        let run = run_key(retry.report.id());
        self.store.objects().data_dir().join(run).join(START_DIR)
    }

    /// Errors: `Invalid` if settings of a training are wrong, or it certainly needs too much memory.
    pub(super) async fn check_training(&self, spec: &TrainSpec, is_dataset_there: bool) -> Result<(), JobError> {
        // The job before it may make the version that is meant.
        if spec.from.is_some() && spec.from_version.is_none() && spec.after.is_some() {
            return Ok(());
        }
        let base = match base_manifest(spec, &self.versions).await {
            Ok(base) => base,
            Err(error) if error.kind() == ErrorKind::Away => return Err(error),
            // What cannot be read says so when the job runs.
            Err(_) => return Ok(()),
        };
        let configs = spec.configs(base.as_ref())?;
        if !is_dataset_there {
            return Ok(());
        }
        let (memory, objects) = (self.resources.memory, self.store.objects());
        check_starts(configs, base.as_ref(), described(objects, &spec.dataset).await?).await?;
        memory.check(spec, base.as_ref(), objects).await
    }
}

/// Describes a data set, by the name that the caller knows.
pub(super) async fn described(objects: &Objects, name: &DatasetName) -> Result<DatasetInfo, JobError> {
    Ok(DatasetInfo {
        name: name.to_string(),
        ..datasets::describe(objects, name).await?
    })
}

fn load_base(dir: &Path, name: &ModelName, version: u32) -> Result<StoredWeights, VersionError> {
    let mut weights = registry::load_weights(dir)?;
    let found = weights.manifest.version;
    if found != version {
        return Err(VersionError::Refused {
            model: name.clone(),
            version,
            reason: format!("its manifest is of version {found}"),
        });
    }
    weights.manifest.name.clone_from(name);
    Ok(weights)
}

/// Errors: `Invalid` if trainings on a data set cannot start from their base, if they have one.
pub(super) async fn check_starts(
    configs: Vec<TrainConfig>,
    base: Option<&Manifest>,
    info: DatasetInfo,
) -> Result<(), JobError> {
    let Some(base) = base.cloned() else { return Ok(()) };
    // On a blocking thread: it makes tensors as large as the model.
    let checked = tokio::task::spawn_blocking(move || check_each_start(&configs, &info, &base));
    checked.await.unwrap_or(Err(JobError::Stopping))
}

fn check_each_start(configs: &[TrainConfig], info: &DatasetInfo, base: &Manifest) -> Result<(), JobError> {
    for (at, config) in configs.iter().enumerate() {
        // Most trainings of a sweep have the same network.
        if configs[..at].iter().any(|earlier| earlier.model == config.model) {
            continue;
        }
        training::check_start(config, info, base).map_err(|error| {
            let field = match error {
                TrainError::Config(_) => "dataset",
                _ => "from",
            };
            JobError::invalid(field, error_text::with_causes(&error))
        })?;
    }
    Ok(())
}

/// What a training will need, without starting it. Errors: as when it is submitted; those of a store that is away.
pub async fn estimate_training(
    spec: &TrainSpec,
    memory: JobMemory,
    versions: &Versions,
    objects: &Objects,
) -> Result<TrainingEstimate, JobError> {
    let base = base_manifest(spec, versions).await?;
    spec.check_sweep()?;
    let info = described(objects, &spec.dataset).await?;
    check_starts(spec.configs(base.as_ref())?, base.as_ref(), info).await?;
    memory.estimate(spec, base.as_ref(), objects).await
}

/// The description of the model that a training starts from; `None` for new weights. Errors: `NotFound` and `Invalid`, which name the
/// field; those of a store that is away.
async fn base_manifest(spec: &TrainSpec, versions: &Versions) -> Result<Option<Manifest>, JobError> {
    let Some(from) = &spec.from else { return Ok(None) };
    check_from(from, spec.from_version, spec.after, &versions.all().await?)?;
    match versions.manifest(from, spec.from_version).await {
        Ok(manifest) => Ok(Some(manifest)),
        Err(error) if error.kind() == ErrorKind::Away => Err(error.into()),
        Err(error) => Err(JobError::invalid("from", error.to_string())),
    }
}
