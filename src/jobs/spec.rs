//! What a job is asked to do, checked when it is posted so that mistakes come to light at once.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::JobError;
use crate::dataset::{CollectConfig, Standing};
use crate::registry;
use crate::sim::Scenario;
use crate::training::{TrainConfig, TrainError};
use crate::types::Seed;

/// Trials of one collection at most.
pub const MAX_TRIALS: u64 = 1_000_000;

/// What to do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum JobSpec {
    /// Collect a data set from the simulator.
    Collect(CollectSpec),
    /// Train a model on a data set.
    Train(TrainSpec),
}

/// A collection: writes the data set `name`. A collection that was cancelled goes on where it was when the same is asked
/// again.
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
    #[serde(default)]
    pub seed: u64,
}

/// A training: writes the run `name` and publishes the model `name`. A training that was cancelled goes on from its
/// checkpoint when the same is asked again.
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

impl JobSpec {
    /// The kind and name of what the job makes.
    #[must_use]
    pub fn makes(&self) -> (&'static str, &str) {
        match self {
            Self::Collect(spec) => ("data set", &spec.name),
            Self::Train(spec) => ("model", &spec.name),
        }
    }

    /// Checks all that can be known before the work begins. `models` are the names of the loaded models.
    /// Errors: `Invalid` and `NotFound`, which name the field; `Taken`.
    pub fn check(&self, data_dir: &Path, models: &[String]) -> Result<(), JobError> {
        match self {
            Self::Collect(spec) => spec.check(data_dir),
            Self::Train(spec) => spec.check(data_dir, models),
        }
    }
}

impl CollectSpec {
    fn check(&self, data_dir: &Path) -> Result<(), JobError> {
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
        match Standing::of(&self.config(&data_dir.join("datasets"))?) {
            Ok(Standing::New | Standing::Begun { .. }) => Ok(()),
            Ok(Standing::Finished(_)) => Err(JobError::Taken {
                kind: "data set",
                name: self.name.clone(),
                why: "exists",
            }),
            Err(error) => Err(JobError::Occupied {
                reason: error.to_string(),
            }),
        }
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
    fn check(&self, data_dir: &Path, models: &[String]) -> Result<(), JobError> {
        check_name("name", &self.name)?;
        check_name("dataset", &self.dataset)?;
        self.config()?;
        let datasets = data_dir.join("datasets");
        if !is_dataset(&datasets.join(&self.dataset)) {
            return Err(JobError::NotFound {
                field: "dataset",
                kind: "data set",
                name: self.dataset.clone(),
                known: datasets_in(&datasets),
            });
        }
        if models.contains(&self.name) || data_dir.join("models").join(&self.name).exists() {
            return Err(JobError::Taken {
                kind: "model",
                name: self.name.clone(),
                why: "exists",
            });
        }
        Ok(())
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
            other => settings(other.to_string()),
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

/// Whether a finished data set is there.
fn is_dataset(dir: &Path) -> bool {
    dir.join("meta").join("info.json").is_file()
}

fn datasets_in(dir: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries
        .filter(|entry| is_dataset(&entry.path()))
        .filter_map(|entry| entry.file_name().into_string().ok())
        .collect();
    names.sort();
    names
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
        let error = spec.check(Path::new("nowhere"), &[]).unwrap_err().to_string();
        assert!(error.starts_with("preset: ") && error.contains("moving"), "{error}");
    }
}
