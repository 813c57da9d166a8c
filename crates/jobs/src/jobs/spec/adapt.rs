//! The specification of an adaptation.

use serde::{Deserialize, Serialize};

use super::train::{check_from, settings_text};
use super::{AvailableInputs, check_dataset, check_range};
use crate::jobs::JobError;
use crate::store::JobId;
use foreframe_core::types::{DatasetName, ModelName};
use foreframe_train::adaptation::AdaptSettings;
use foreframe_train::settings::SettingsLayer;

/// The maximum number of updates of an adaptation.
const MAX_STEPS: u32 = 100_000;

/// An adaptation: trains a model that sees depth and speeds further on a recording of a robot that it never saw, and publishes
/// the next version of the model `name`, unless it became no better. Estimates the camera if the recording does not say it. A
/// cancelled adaptation resumes from its checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct AdaptSpec {
    /// The new model's name: a to z, 0 to 9 and `-`, at most 64 characters.
    #[schema(value_type = String, pattern = "^[a-z0-9][a-z0-9-]{0,63}$")]
    pub name: ModelName,
    /// Name of a data set in the data directory.
    #[schema(value_type = String)]
    pub dataset: DatasetName,
    /// The model to start from.
    #[serde(default = "default_base")]
    #[schema(value_type = String, default = "rooms")]
    pub from: ModelName,
    /// Its version. If it is absent, the job's first attempt sets it: the version that the job before it made, else the active one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1)]
    pub from_version: Option<u32>,
    /// Updates, of 16 windows each, 1 to 100,000; the weights with the least validation error are kept.
    #[serde(default = "default_steps")]
    #[schema(minimum = 1, maximum = 100_000, default = default_steps)]
    pub steps: u32,
    /// Channels whose sign changes in a mirror, such as a steering angle. If there are any, half of the training windows are
    /// mirrored.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub mirror: Vec<String>,
    /// Whether it also remembers what the room of the recording looks like, for a robot that stays in it. The states must have x, y,
    /// `heading_cos` and `heading_sin`, always from the same origin, there must be actions, and `mirror` must be empty.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub remember: bool,
    /// Other settings of the training.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    #[schema(value_type = Object)]
    pub settings: serde_json::Map<String, serde_json::Value>,
    /// Waits until the job with this id has ended, and fails if that has failed. The data set or model that it makes need not
    /// exist yet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, pattern = "^job-[0-9]{1,18}$")]
    pub after: Option<JobId>,
}

fn default_base() -> ModelName {
    "rooms".parse().expect("an invalid name of a shipped model is a bug")
}

fn default_steps() -> u32 {
    AdaptSettings::STEPS
}

impl AdaptSpec {
    pub(super) fn check(&self, available: AvailableInputs<'_>) -> Result<(), JobError> {
        check_range("steps", self.steps as usize, 1..=MAX_STEPS as usize)?;
        self.settings()?;
        check_dataset(&self.dataset, available.datasets)?;
        check_from(&self.from, self.from_version, self.after, available.models)
    }

    /// How the model is adapted. Errors: `Invalid`, which names the setting.
    pub(in crate::jobs) fn settings(&self) -> Result<AdaptSettings, JobError> {
        let layer = SettingsLayer::toml("settings", &settings_text(&self.settings)?);
        let layer = layer.map_err(|error| JobError::invalid("settings", error.to_string()))?;
        Ok(AdaptSettings {
            name: self.name.clone(),
            steps: self.steps,
            mirror: self.mirror.clone(),
            remember: self.remember,
            layers: vec![layer],
        })
    }
}
