//! What a job is asked to do, checked when it is posted so that mistakes come to light at once.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::JobError;
use crate::dataset::{self, CollectConfig, CollectionStatus, DatasetError};
use crate::evaluation::EvaluateConfig;
use crate::registry;
use crate::sim::Scenario;
use crate::training::{TrainConfig, TrainError};
use crate::types::Seed;
use crate::error_text;

/// Trials of one collection at most.
pub const MAX_TRIALS: u64 = 1_000_000;

/// Windows of each test set of an evaluation at most.
pub const MAX_WINDOWS: usize = 100_000;
/// Resamples of an evaluation at most.
pub const MAX_RESAMPLES: usize = 10_000;

/// What to do. The import of recordings will be a variant beside these.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum JobSpec {
    /// Collect a data set from the simulator.
    Collect(CollectSpec),
    /// Train a model on a data set.
    Train(TrainSpec),
    /// Measure a model on the held-out trials of a data set.
    Evaluate(EvaluateSpec),
}

/// A collection: writes the data set `name`. A collection that was cancelled goes on where it was when it is resumed, or
/// when the same is asked again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CollectSpec {
    /// The data set's name: a to z, 0 to 9 and `-`, at most 64 characters.
    #[schema(pattern = "^[a-z0-9][a-z0-9-]{0,63}$")]
    pub name: String,
    /// `static-observer`, `moving-observer` or `crowded`.
    pub scenario: String,
    /// Trials, 1 to 1,000,000.
    #[schema(minimum = 1, maximum = 1_000_000)]
    pub trials: u64,
    /// The seed all randomness comes from.
    #[serde(default = "default_seed")]
    #[schema(default = 1)]
    pub seed: u64,
}

/// A training: publishes the next version of the model `name`. One that was cancelled goes on from its checkpoint when it
/// is resumed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainSpec {
    /// The model's name: a to z, 0 to 9 and `-`, at most 64 characters.
    #[schema(pattern = "^[a-z0-9][a-z0-9-]{0,63}$")]
    pub name: String,
    /// `paper`, `static` or `moving`.
    pub preset: String,
    /// Name of a data set in the data directory.
    pub dataset: String,
    /// Fields of the preset to set otherwise.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    #[schema(value_type = Object)]
    pub settings: serde_json::Map<String, serde_json::Value>,
}

/// An evaluation: leaves a report with figures, to be had from the job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EvaluateSpec {
    /// The model's name.
    pub model: String,
    /// Its version; the active one where none is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version: Option<u32>,
    /// Name of a data set in the data directory.
    pub dataset: String,
    /// A model without conditioning, of the same budget, for the table that tells whether the action matters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub twin: Option<String>,
    /// Windows of each test set at most, 1 to 100,000.
    #[serde(default = "default_windows")]
    #[schema(minimum = 1, maximum = 100_000)]
    pub windows: usize,
    /// Resamples of the trials for the intervals, 100 to 10,000.
    #[serde(default = "default_resamples")]
    #[schema(minimum = 100, maximum = 10_000)]
    pub resamples: usize,
    /// Seed of the resamples and the shuffled actions.
    #[serde(default)]
    pub seed: u64,
}

fn default_seed() -> u64 {
    1
}

fn default_windows() -> usize {
    EvaluateConfig::default().max_windows
}

fn default_resamples() -> usize {
    EvaluateConfig::default().bootstrap_samples
}

/// What there is that jobs can start from.
#[derive(Clone, Copy, Debug)]
pub struct AvailableInputs<'a> {
    /// The data directory.
    pub data_dir: &'a Path,
    /// The finished data sets.
    pub datasets: &'a [String],
    /// The versions of each model.
    pub models: &'a BTreeMap<String, Vec<u32>>,
}

impl JobSpec {
    /// The kinds there are.
    pub const KINDS: [&'static str; 3] = ["collect", "train", "evaluate"];

    /// Its kind.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Collect(_) => "collect",
            Self::Train(_) => "train",
            Self::Evaluate(_) => "evaluate",
        }
    }

    /// Kind and name of what no other job may make at the same time. Versions and reports never meet.
    #[must_use]
    pub fn makes(&self) -> Option<(&'static str, &str)> {
        match self {
            Self::Collect(spec) => Some(("data set", &spec.name)),
            Self::Train(_) | Self::Evaluate(_) => None,
        }
    }

    /// The data set that it makes or reads.
    #[must_use]
    pub fn dataset(&self) -> &str {
        match self {
            Self::Collect(spec) => &spec.name,
            Self::Train(spec) => &spec.dataset,
            Self::Evaluate(spec) => &spec.dataset,
        }
    }

    /// Checks all that can be known before the work begins. Errors: `Invalid` and `NotFound`, which name the field; `Taken`,
    /// `Occupied`, `Dataset`.
    pub fn check(&self, ground: AvailableInputs<'_>) -> Result<(), JobError> {
        match self {
            Self::Collect(spec) => spec.check(ground),
            Self::Train(spec) => spec.check(ground.datasets),
            Self::Evaluate(spec) => spec.check(ground),
        }
    }
}

impl EvaluateSpec {
    fn check(&self, ground: AvailableInputs<'_>) -> Result<(), JobError> {
        check_dataset(&self.dataset, ground.datasets)?;
        check_model("model", &self.model, ground.models)?;
        if let Some(twin) = &self.twin {
            check_model("twin", twin, ground.models)?;
        }
        let versions = ground.models.get(&self.model).map_or(&[][..], Vec::as_slice);
        if let Some(version) = self.version.filter(|version| !versions.contains(version)) {
            return Err(JobError::NotFound {
                field: "version",
                kind: "version",
                name: version.to_string(),
                known: versions.iter().map(u32::to_string).collect(),
            });
        }
        check_range("windows", self.windows, 1..=MAX_WINDOWS)?;
        check_range("resamples", self.resamples, 100..=MAX_RESAMPLES)
    }
}

impl CollectSpec {
    fn check(&self, ground: AvailableInputs<'_>) -> Result<(), JobError> {
        check_name("name", &self.name)?;
        if !(1..=MAX_TRIALS).contains(&self.trials) {
            return Err(JobError::Invalid {
                field: "trials",
                reason: format!(
                    "{} is out of range; 1 to {MAX_TRIALS} trials can be collected",
                    self.trials
                ),
            });
        }
        let config = self.config(&ground.data_dir.join("datasets"))?;
        let is_there = ground.datasets.contains(&self.name);
        // Where objects are shared, a set that is finished here alone was deleted elsewhere, or could not be pushed.
        if !is_there && dataset::is_finished(&config.out) {
            return Ok(());
        }
        match CollectionStatus::of(&config) {
            Ok(CollectionStatus::New | CollectionStatus::Unfinished { .. }) if !is_there => Ok(()),
            Ok(_) => Err(JobError::Taken {
                kind: "data set",
                name: self.name.clone(),
                why: "exists",
            }),
            Err(DatasetError::OutExists { .. }) => {
                Err(self.occupied("has its place taken by other files; move them".to_owned()))
            }
            Err(DatasetError::OtherArguments { differences, .. }) => Err(self.occupied(format!(
                "was begun with other arguments ({differences}); use those to go on"
            ))),
            Err(error) => Err(error.into()),
        }
    }

    fn occupied(&self, why: String) -> JobError {
        let name = self.name.clone();
        JobError::Occupied { name, why }
    }

    /// What to collect into a directory of that name below `datasets`. Errors: `Invalid`, which names the scenarios.
    pub(super) fn config(&self, datasets: &Path) -> Result<CollectConfig, JobError> {
        let out = datasets.join(&self.name);
        Ok(CollectConfig::new(self.scenario()?, self.trials, Seed(self.seed), &out))
    }

    /// The scenario by its name. Errors: `Invalid`, which names those there are.
    fn scenario(&self) -> Result<Scenario, JobError> {
        self.scenario
            .parse()
            .map_err(|error: <Scenario as std::str::FromStr>::Err| JobError::Invalid {
                field: "scenario",
                reason: error.to_string(),
            })
    }
}

impl TrainSpec {
    fn check(&self, datasets: &[String]) -> Result<(), JobError> {
        check_name("name", &self.name)?;
        self.config()?;
        check_dataset(&self.dataset, datasets)
    }

    /// The preset with the settings laid over it. Errors: `Invalid`, which names the presets or the setting.
    pub(super) fn config(&self) -> Result<TrainConfig, JobError> {
        let settings = |reason: String| JobError::Invalid {
            field: "settings",
            reason,
        };
        let text = toml::to_string(&self.settings).map_err(|error| {
            settings(format!(
                "{error}; a setting is a number, a text or true or false, not null"
            ))
        })?;
        let layered = TrainConfig::layered(&self.preset, Some(&text), &[]);
        let config = layered.map_err(|error| match error {
            TrainError::UnknownPreset(_) => JobError::Invalid {
                field: "preset",
                reason: error.to_string(),
            },
            other => settings(error_text::with_causes(&other)),
        })?;
        Ok(TrainConfig {
            name: self.name.clone(),
            ..config
        })
    }
}

/// Names become directories, so nothing but small letters, digits and `-` is taken: no name can leave the data directory.
fn check_name(field: &'static str, name: &str) -> Result<(), JobError> {
    if registry::is_valid_name(name) {
        return Ok(());
    }
    Err(JobError::Invalid {
        field,
        reason: format!(
            "\"{}\" is no name; a name is 1 to 64 of a to z, 0 to 9 and -, and does not start with -",
            name.escape_default()
        ),
    })
}

fn check_dataset(name: &str, known: &[String]) -> Result<(), JobError> {
    check_name("dataset", name)?;
    check_known("dataset", "data set", name, known.iter())
}

fn check_model(field: &'static str, name: &str, known: &BTreeMap<String, Vec<u32>>) -> Result<(), JobError> {
    check_name(field, name)?;
    check_known(field, "model", name, known.keys())
}

fn check_known<'a>(
    field: &'static str,
    kind: &'static str,
    name: &str,
    mut known: impl Iterator<Item = &'a String> + Clone,
) -> Result<(), JobError> {
    let all = known.clone();
    if known.any(|known| known == name) {
        return Ok(());
    }
    Err(JobError::NotFound {
        field,
        kind,
        name: name.to_owned(),
        known: all.cloned().collect(),
    })
}

fn check_range(field: &'static str, value: usize, range: RangeInclusive<usize>) -> Result<(), JobError> {
    if range.contains(&value) {
        return Ok(());
    }
    Err(JobError::Invalid {
        field,
        reason: format!(
            "{value} is out of range; it must be {} to {}",
            range.start(),
            range.end()
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_name_can_leave_the_data_directory() {
        for name in ["", "..", "../x", "a/b", "A", "-a", "a b", &"a".repeat(65), "ä"] {
            assert!(check_name("name", name).is_err(), "{name}");
        }
        assert!(check_name("name", "a-1").is_ok());
    }

    #[test]
    fn an_unknown_field_of_a_job_is_refused() {
        let text = r#"{"kind":"collect","name":"a","scenario":"crowded","trials":1,"colour":"red"}"#;
        let error = serde_json::from_str::<JobSpec>(text).unwrap_err().to_string();
        assert!(error.contains("unknown field `colour`"), "{error}");
    }

    #[test]
    fn an_unknown_preset_is_refused_with_those_there_are() {
        let spec = TrainSpec {
            name: "a".to_owned(),
            preset: "papr".to_owned(),
            dataset: "d".to_owned(),
            settings: serde_json::Map::new(),
        };
        let error = spec.check(&[]).unwrap_err().to_string();
        assert!(error.starts_with("preset: ") && error.contains("moving"), "{error}");
    }
}
