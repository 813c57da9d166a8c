//! The specification of an evaluation.

use serde::{Deserialize, Serialize};

use super::{
    AvailableInputs, MAX_RESAMPLES, MAX_WINDOWS, check_dataset, check_known, check_parts, check_range, check_version,
    default_parts, is_one,
};
use crate::jobs::JobError;
use crate::store::JobId;
use foreframe_core::types::{DatasetName, ModelName};
use foreframe_train::evaluation::{EvaluateConfig, MIN_RESAMPLES};

/// An evaluation: writes a report with figures, which the job's files contain.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EvaluateSpec {
    /// The model's name.
    #[schema(value_type = String)]
    pub model: ModelName,
    /// Its version. If it is absent, the job's first attempt sets it: the version that the job before it made, else the active one.
    /// With `parts`, the active one is set when the job is submitted, unless a job before it makes the model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version: Option<u32>,
    /// Name of a data set in the data directory.
    #[schema(value_type = String)]
    pub dataset: DatasetName,
    /// A model of the same size without conditioning. The report then shows what the actions are worth.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub twin: Option<ModelName>,
    /// The maximum number of windows of each test set, 1 to 100,000.
    #[serde(default = "default_windows")]
    #[schema(minimum = 1, maximum = 100_000)]
    pub windows: usize,
    /// Bootstrap resamples for the intervals, 100 to 10,000.
    #[serde(default = "default_resamples")]
    #[schema(minimum = 100, maximum = 10_000)]
    pub resamples: usize,
    /// The random seed of the resamples and of the shuffled actions.
    #[serde(default)]
    pub seed: u64,
    /// Waits until the job with this id has ended, and fails if that has failed. The data set or model that it makes need not
    /// exist yet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, pattern = "^job-[0-9]{1,18}$")]
    pub after: Option<JobId>,
    /// In how many parts workers may compute it, 1 to 64: each takes its share of the windows, in batches of 64. The report is
    /// the same however many there are.
    #[serde(default = "default_parts", skip_serializing_if = "is_one")]
    #[schema(minimum = 1, maximum = 64, default = 1)]
    pub parts: usize,
    /// Which of the parts this job computes, from 0. Only jobs that are parts have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(read_only)]
    pub part: Option<usize>,
}

fn default_windows() -> usize {
    EvaluateConfig::default().max_windows
}

fn default_resamples() -> usize {
    EvaluateConfig::default().bootstrap_samples
}

impl EvaluateSpec {
    pub(super) fn check(&self, available: AvailableInputs<'_>) -> Result<(), JobError> {
        check_dataset(&self.dataset, available.datasets)?;
        for (field, model) in [("model", Some(&self.model)), ("twin", self.twin.as_ref())] {
            model.map_or(Ok(()), |model| {
                check_known((field, "model"), model, available.models.keys())
            })?;
        }
        check_version("version", self.version, self.after, available.models.get(&self.model))?;
        check_parts(self.parts, self.part)?;
        check_range("windows", self.windows, 1..=MAX_WINDOWS)?;
        check_range("resamples", self.resamples, MIN_RESAMPLES..=MAX_RESAMPLES)
    }

    /// Its parts; none if it is computed as a whole. There are never more parts than batches.
    pub(super) fn parts(&self) -> Vec<Self> {
        let parts = self.parts.min(self.windows.div_ceil(EvaluateConfig::default().batch));
        if parts < 2 || self.part.is_some() {
            return Vec::new();
        }
        let part = |part| Self {
            parts,
            part: Some(part),
            ..self.clone()
        };
        (0..parts).map(part).collect()
    }

    /// The same evaluation of this version without parts, which gives the same report.
    pub(in crate::jobs) fn undivided(&self, version: u32) -> Self {
        Self {
            version: Some(version),
            parts: 1,
            part: None,
            ..self.clone()
        }
    }
}
