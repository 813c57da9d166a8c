//! The specification of a training.

use std::collections::BTreeMap;
use std::iter;

use serde::{Deserialize, Serialize};

use super::{check_dataset, check_known, dataset, name};
use crate::jobs::JobError;
use crate::store::JobId;
use foreframe_core::error_text;
use foreframe_core::types::{DatasetName, ModelName};
use foreframe_train::training::sweep::set_nested;
use foreframe_train::training::{Sweep, TrainConfig, TrainError};

/// A training: publishes the next version of the model `name`. A cancelled training resumes from its checkpoint. With `sweep`, it
/// has one part for each combination of the values, and each part publishes a version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainSpec {
    /// The model's name: a to z, 0 to 9 and `-`, at most 64 characters.
    #[serde(deserialize_with = "name")]
    #[schema(value_type = String, pattern = "^[a-z0-9][a-z0-9-]{0,63}$")]
    pub name: ModelName,
    /// The preset of its settings.
    #[schema(schema_with = preset_schema)]
    pub preset: String,
    /// Name of a data set in the data directory.
    #[serde(deserialize_with = "dataset")]
    #[schema(value_type = String)]
    pub dataset: DatasetName,
    /// Further data sets to train on, each with a weight above 0: how many windows it gives for one of `dataset`. Frame size,
    /// frame period and channels must be those of `dataset`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schema(value_type = BTreeMap<String, f64>)]
    pub mixture: BTreeMap<DatasetName, f64>,
    /// Settings that replace those of the preset.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    #[schema(value_type = Object)]
    pub settings: serde_json::Map<String, serde_json::Value>,
    /// Settings with dotted keys, each with the values that it takes in turn: `{"seed": [1, 2, 3], "model.hidden": [64, 128]}` is
    /// 6 trainings. At most 64. The result lists them, the lowest validation error first.
    #[serde(default, skip_serializing_if = "Sweep::is_empty")]
    #[schema(value_type = BTreeMap<String, Vec<serde_json::Value>>)]
    pub sweep: Sweep,
    /// Waits until the job with this id has ended, and fails if that has failed. The data set or model that it makes need not
    /// exist yet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, pattern = "^job-[0-9]{1,18}$")]
    pub after: Option<JobId>,
}

/// The names of all presets.
fn preset_schema() -> utoipa::openapi::Object {
    utoipa::openapi::ObjectBuilder::new()
        .schema_type(utoipa::openapi::Type::String)
        .description(Some("The preset of its settings."))
        .enum_values(Some(TrainConfig::preset_names()))
        .build()
}

impl TrainSpec {
    pub(super) fn check(&self, datasets: &[DatasetName]) -> Result<(), JobError> {
        let sweep = self.sweep.check();
        sweep.map_err(|error| JobError::invalid("sweep", error.to_string()))?;
        self.config()?;
        for part in self.parts() {
            part.config()?;
        }
        check_dataset(&self.dataset, datasets)?;
        for (name, weight) in &self.mixture {
            check_known(("mixture", "data set"), name, datasets.iter())?;
            if !(weight.is_finite() && *weight > 0.0) {
                let reason = format!("the weight of \"{name}\" is {weight}; it must be above 0");
                return Err(JobError::invalid("mixture", reason));
            }
            if *name == self.dataset {
                let reason = format!("\"{name}\" is the data set itself, which has the weight 1");
                return Err(JobError::invalid("mixture", reason));
            }
        }
        Ok(())
    }

    /// All data sets with their weights.
    pub(in crate::jobs) fn datasets(&self) -> impl Iterator<Item = (&DatasetName, f64)> {
        iter::once((&self.dataset, 1.0)).chain(self.mixture.iter().map(|(name, weight)| (name, *weight)))
    }

    /// The trainings of a sweep; none without one.
    pub(in crate::jobs) fn parts(&self) -> Vec<Self> {
        let points = if self.sweep.is_empty() {
            Vec::new()
        } else {
            self.sweep.points()
        };
        let parts = points.into_iter().map(|point| {
            let mut settings = self.settings.clone();
            for (key, value) in point {
                set_nested(&mut settings, &key, value);
            }
            Self {
                settings,
                sweep: Sweep::default(),
                ..self.clone()
            }
        });
        parts.collect()
    }

    /// The preset with the job's settings. Errors: `Invalid`, which names the presets or the setting.
    pub(in crate::jobs) fn config(&self) -> Result<TrainConfig, JobError> {
        let text = settings_text(&self.settings)?;
        let layered = TrainConfig::layered(&self.preset, Some(&text), &[]);
        let config = layered.map_err(|error| match error {
            TrainError::UnknownPreset { .. } => JobError::invalid("preset", error.to_string()),
            other => JobError::invalid("settings", error_text::with_causes(&other)),
        })?;
        Ok(TrainConfig {
            name: self.name.clone(),
            ..config
        })
    }
}

/// Settings of a job as TOML. Errors: `Invalid`.
pub(super) fn settings_text(settings: &serde_json::Map<String, serde_json::Value>) -> Result<String, JobError> {
    toml::to_string(settings).map_err(|error| {
        let reason = format!("{error}; a setting is a number, a string, true or false, not null");
        JobError::invalid("settings", reason)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_preset_is_refused_with_the_available_ones() {
        let spec = TrainSpec {
            name: "a".parse().unwrap(),
            preset: "papr".to_owned(),
            dataset: "d".parse().unwrap(),
            mixture: BTreeMap::new(),
            settings: serde_json::Map::new(),
            sweep: Sweep::default(),
            after: None,
        };
        let error = spec.check(&[]).unwrap_err().to_string();
        assert!(error.starts_with("preset: ") && error.contains("moving"), "{error}");
    }

    #[test]
    fn a_sweep_is_a_training_for_each_combination() {
        let spec = |sweep: serde_json::Value| -> TrainSpec {
            let settings = serde_json::json!({"model": {"hidden": 8}, "seed": 9});
            let spec = serde_json::json!({"name": "m", "preset": "paper", "dataset": "a", "settings": settings, "sweep": sweep});
            serde_json::from_value(spec).unwrap()
        };
        let swept = spec(serde_json::json!({"seed": [1, 2], "model.features": [4, 8]}));
        let known = ["a".parse().unwrap()];
        swept.check(&known).unwrap();
        let parts = swept.parts();
        let expected = serde_json::json!({"model": {"hidden": 8, "features": 4}, "seed": 2});
        assert_eq!(serde_json::Value::Object(parts[1].settings.clone()), expected);
        assert_eq!((parts.len(), parts[1].config().unwrap().seed.0), (4, 2));
        let refused = |sweep| spec(sweep).check(&known).unwrap_err().to_string();
        assert!(refused(serde_json::json!({"seed": []})).starts_with("sweep: \"seed\" has no values"));
        assert!(refused(serde_json::json!({"model.hiden": [1]})).contains("hiden"));
    }

    #[test]
    fn a_mixture_names_other_data_sets_with_weights_above_0() {
        let known: Vec<DatasetName> = ["a", "b"].map(|name| name.parse().unwrap()).into();
        let check = |mixture: &[(&str, f64)]| {
            let spec = TrainSpec {
                name: "m".parse().unwrap(),
                preset: "paper".to_owned(),
                dataset: "a".parse().unwrap(),
                mixture: mixture
                    .iter()
                    .map(|&(name, weight)| (name.parse().unwrap(), weight))
                    .collect(),
                settings: serde_json::Map::new(),
                sweep: Sweep::default(),
                after: None,
            };
            spec.check(&known).map_err(|error| error.to_string())
        };
        assert_eq!(check(&[("b", 0.3)]), Ok(()));
        assert!(check(&[("b", 0.0)]).unwrap_err().contains("the weight of \"b\" is 0"));
        assert!(check(&[("a", 1.0)]).unwrap_err().contains("is the data set itself"));
        assert!(check(&[("c", 1.0)]).unwrap_err().starts_with("mixture: "));
    }
}
