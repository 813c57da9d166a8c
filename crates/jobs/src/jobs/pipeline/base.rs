//! The model whose weights a training or an adaptation starts from.

use super::super::executor::JobFailure;
use super::super::retry_policy::RetryPolicy;
use super::super::spec::train::check_from;
use super::super::{JobError, JobSpec, TrainSpec};
use super::{Pipeline, failed};
use crate::versions::{VersionError, Versions};
use foreframe_core::error_kind::{ErrorKind, HasErrorKind as _};
use foreframe_core::registry::{self, Manifest, StoredWeights};
use foreframe_core::types::ModelName;

/// The model that a job starts from.
pub(super) struct Base {
    pub(super) weights: StoredWeights,
    /// The job, with the version that it starts from.
    pub(super) spec: JobSpec,
}

impl Pipeline {
    /// Loads the model `from`. Without a version, it is the one that the job `after` made, else the active one. The version is also
    /// written to the job, so that a later attempt starts from the same one. Errors: `Cancelled` if the lease is lost.
    pub(super) fn base(&self, spec: &JobSpec, from: &ModelName, retry: &RetryPolicy<'_>) -> Result<Base, JobFailure> {
        let version = match (spec.starting_version(), spec.after()) {
            (None, Some(after)) => retry.run(async || self.made_version(after, from).await)?,
            (version, _) => version,
        };
        let weights = retry.run(async || self.load_base(from, version).await)?;
        let with_version = spec.with_starting_version(Some(weights.manifest.version));
        if with_version != *spec {
            let text = serde_json::to_string(&with_version).map_err(|error| failed(&error))?;
            let is_written = retry.run(async || self.store.set_spec(retry.report.lease(), &text).await)?;
            if !is_written {
                return Err(JobFailure::Cancelled);
            }
        }
        Ok(Base {
            weights,
            spec: with_version,
        })
    }

    async fn load_base(&self, name: &ModelName, version: Option<u32>) -> Result<StoredWeights, VersionError> {
        let version = match version {
            Some(version) => version,
            None => self.versions.active(name).await?.unwrap_or_default(),
        };
        let mut weights = registry::load_weights(&self.versions.directory(name, version).await?)?;
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
        spec.check_settings(base.as_ref())?;
        if !is_dataset_there {
            return Ok(());
        }
        self.resources
            .memory
            .check(spec, base.as_ref(), self.store.objects())
            .await
    }
}

/// The description of the model that a training starts from; `None` for new weights. Errors: `NotFound` and `Invalid`, which name the
/// field; those of a store that is away.
pub async fn base_manifest(spec: &TrainSpec, versions: &Versions) -> Result<Option<Manifest>, JobError> {
    let Some(from) = &spec.from else { return Ok(None) };
    check_from(from, spec.from_version, &versions.all().await?)?;
    match versions.manifest(from, spec.from_version).await {
        Ok(manifest) => Ok(Some(manifest)),
        Err(error) if error.kind() == ErrorKind::Away => Err(error.into()),
        Err(error) => Err(JobError::invalid("from", error.to_string())),
    }
}
