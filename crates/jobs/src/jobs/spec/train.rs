//! The specification of a training.

use std::collections::BTreeMap;
use std::iter;

use serde::{Deserialize, Serialize};

use super::{AvailableInputs, check_dataset, check_known, check_version};
use crate::jobs::JobError;
use crate::store::JobId;
use foreframe_core::error_text;
use foreframe_core::registry::Manifest;
use foreframe_core::types::{DatasetName, ModelName};
use foreframe_train::settings::SettingsLayer;
use foreframe_train::training::sweep::set_nested;
use foreframe_train::training::{Sweep, TrainConfig, TrainError};

/// The setting that is a field of the job.
const NAME: &str = "name";
const NAME_REASON: &str = "the model has the name of the job; leave it out, and give the job another name";

/// A training: publishes the next version of the model `name`. It starts with new weights and the settings of a `preset`, or from
/// the weights of a model and with its settings (`from`); one of the two must be there. A cancelled training resumes from its
/// checkpoint. With `sweep`, it has one part for each combination of the values, and each part publishes a version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainSpec {
    /// The model's name: a to z, 0 to 9 and `-`, at most 64 characters.
    #[schema(value_type = String, pattern = "^[a-z0-9][a-z0-9-]{0,63}$")]
    pub name: ModelName,
    /// The preset of its settings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(schema_with = preset_schema)]
    pub preset: Option<String>,
    /// Instead of a preset: the model to start from (fine-tuning). Its settings count but for the pre-training, which is left out. A
    /// few hundred steps are often enough: `{"sequence": {"steps": 300}}`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub from: Option<ModelName>,
    /// Its version. If it is absent, the job's first attempt sets it: the version that the job before it made, else the active one.
    /// For a sweep, the active one is set when the job is submitted, unless a job before it makes the model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1)]
    pub from_version: Option<u32>,
    /// Name of a data set in the data directory.
    #[schema(value_type = String)]
    pub dataset: DatasetName,
    /// Further data sets to train on, each with a weight above 0: how many windows it gives for one of `dataset`. Frame size,
    /// frame period and channels must be those of `dataset`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schema(value_type = BTreeMap<String, f64>)]
    pub mixture: BTreeMap<DatasetName, f64>,
    /// Settings that replace those of the preset, or of the model to start from.
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
        .description(Some("The preset of its settings. Absent with `from`."))
        .enum_values(Some(TrainConfig::preset_names()))
        .build()
}

impl TrainSpec {
    pub(super) fn check(&self, available: AvailableInputs<'_>) -> Result<(), JobError> {
        let datasets = available.datasets;
        self.check_sweep()?;
        match &self.from {
            // Its settings are known when the model is read.
            Some(from) => {
                self.check_start()?;
                check_from(from, self.from_version, self.after, available.models)?;
            }
            None => drop(self.configs(None)?),
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

    /// Errors: `Invalid` unless it starts either with a preset or from a model.
    fn check_start(&self) -> Result<(), JobError> {
        match (&self.preset, &self.from) {
            (Some(_), Some(_)) => Err(JobError::invalid(
                "from",
                "a training starts either with a preset or from a model; leave out preset or from",
            )),
            (None, None) => {
                let known = TrainConfig::preset_names().join(", ");
                let reason = format!("it is absent; name one of {known}, or name a model in from");
                Err(JobError::invalid("preset", reason))
            }
            (Some(_), None) if self.from_version.is_some() => Err(JobError::invalid(
                "from_version",
                "it is the version of a model to start from; name that model in from",
            )),
            _ => Ok(()),
        }
    }

    /// Errors: `Invalid` if the sweep is too large, or sweeps what is no setting of a job.
    pub(in crate::jobs) fn check_sweep(&self) -> Result<(), JobError> {
        let checked = self.sweep.check();
        checked.map_err(|error| JobError::invalid("sweep", error.to_string()))?;
        match self.sweep.points().first() {
            Some(point) if point.contains_key(NAME) => Err(JobError::invalid("sweep.name", NAME_REASON)),
            _ => Ok(()),
        }
    }

    /// The settings of all its trainings, before them those that they have in common. Errors: those of [`Self::config`].
    pub(in crate::jobs) fn configs(&self, base: Option<&Manifest>) -> Result<Vec<TrainConfig>, JobError> {
        let parts = self.parts();
        iter::once(self).chain(&parts).map(|spec| spec.config(base)).collect()
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

    /// The settings of the preset, or of the model to start from, under the job's. Errors: `Invalid`, which names the presets or the
    /// setting.
    pub(in crate::jobs) fn config(&self, base: Option<&Manifest>) -> Result<TrainConfig, JobError> {
        self.check_start()?;
        let layer = SettingsLayer::toml("settings", &settings_text(&self.settings)?);
        let layer = layer.map_err(|error| JobError::invalid("settings", error.to_string()))?;
        let config = match base {
            Some(base) => TrainConfig::of_model(base, [layer]),
            None => TrainConfig::from_layers(self.preset.as_deref().unwrap_or_default(), [layer]),
        };
        let config = config.map_err(|error| match error {
            TrainError::UnknownPreset { .. } => JobError::invalid("preset", error.to_string()),
            other => JobError::invalid("settings", error_text::with_causes(&other)),
        })?;
        Ok(TrainConfig {
            name: self.name.clone(),
            ..config
        })
    }
}

/// Errors: `NotFound` if there is no model `from`; those of [`check_version`].
pub(in crate::jobs) fn check_from(
    from: &ModelName,
    version: Option<u32>,
    after: Option<JobId>,
    models: &BTreeMap<ModelName, Vec<u32>>,
) -> Result<(), JobError> {
    check_known(("from", "model"), from, models.keys())?;
    check_version("from_version", version, after, models.get(from))
}

/// Settings of a job as TOML. Errors: `Invalid`.
pub(super) fn settings_text(settings: &serde_json::Map<String, serde_json::Value>) -> Result<String, JobError> {
    if settings.contains_key(NAME) {
        return Err(JobError::invalid("settings.name", NAME_REASON));
    }
    toml::to_string(settings).map_err(|error| {
        let reason = format!("{error}; a setting is a number, a string, true or false, not null");
        JobError::invalid("settings", reason)
    })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn training(more: &serde_json::Value) -> TrainSpec {
        let mut spec = serde_json::json!({"name": "m", "dataset": "a"});
        spec.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        serde_json::from_value(spec).unwrap()
    }

    /// Checks a training where the data sets `a` and `b` and version 1 of the model `base` are there.
    fn check(spec: &TrainSpec) -> Result<(), String> {
        let available = AvailableInputs {
            data_dir: Path::new("data"),
            import_dir: None,
            datasets: &["a", "b"].map(|name| name.parse().unwrap()),
            models: &[("base".parse().unwrap(), vec![1])].into(),
        };
        spec.check(available).map_err(|error| error.to_string())
    }

    #[test]
    fn a_training_starts_with_a_preset_or_from_a_model() {
        let refused = |more| check(&training(&more)).unwrap_err();
        let unknown = refused(serde_json::json!({"preset": "papr"}));
        assert!(
            unknown.starts_with("preset: ") && unknown.contains("moving"),
            "{unknown}"
        );
        let neither = refused(serde_json::json!({}));
        assert!(
            neither.starts_with("preset: it is absent; name one of paper, static"),
            "{neither}"
        );
        let both = refused(serde_json::json!({"preset": "paper", "from": "base"}));
        assert!(both.starts_with("from: a training starts either"), "{both}");
        let version = refused(serde_json::json!({"preset": "paper", "from_version": 1}));
        assert!(version.starts_with("from_version: it is the version"), "{version}");
        let model = refused(serde_json::json!({"from": "bass"}));
        assert!(model.contains("there is no model \"bass\"; there are: base"), "{model}");
        let model = refused(serde_json::json!({"from": "base", "from_version": 2}));
        assert!(model.starts_with("from_version: "), "{model}");
        let waiting = refused(serde_json::json!({"from": "base", "from_version": 2, "after": "job-7"}));
        assert_eq!(
            waiting,
            "from_version: there is no version \"2\" yet; if job-7 makes it, leave out from_version: then this job uses what job-7 made"
        );
        for more in [
            serde_json::json!({"from": "base", "from_version": 1}),
            serde_json::json!({"from": "base", "from_version": 1, "after": "job-7"}),
        ] {
            assert_eq!(check(&training(&more)), Ok(()));
        }
    }

    #[test]
    fn the_name_is_no_setting() {
        let refused = |more| check(&training(&more)).unwrap_err();
        let set = refused(serde_json::json!({"preset": "paper", "settings": {"name": "other"}}));
        assert!(
            set.starts_with("settings.name: the model has the name of the job"),
            "{set}"
        );
        let swept = refused(serde_json::json!({"preset": "paper", "sweep": {"name": ["a", "b"]}}));
        assert!(
            swept.starts_with("sweep.name: the model has the name of the job"),
            "{swept}"
        );
        let of_group = refused(serde_json::json!({"preset": "paper", "sweep": {"name.x": [1]}}));
        assert!(of_group.starts_with("settings.name: "), "{of_group}");
    }

    #[test]
    fn a_sweep_is_a_training_for_each_combination() {
        let spec = |sweep: serde_json::Value| {
            let settings = serde_json::json!({"model": {"hidden": 8}, "seed": 9});
            training(&serde_json::json!({"preset": "paper", "settings": settings, "sweep": sweep}))
        };
        let swept = spec(serde_json::json!({"seed": [1, 2], "model.features": [4, 8]}));
        check(&swept).unwrap();
        let parts = swept.parts();
        let expected = serde_json::json!({"model": {"hidden": 8, "features": 4}, "seed": 2});
        assert_eq!(serde_json::Value::Object(parts[1].settings.clone()), expected);
        assert_eq!((parts.len(), parts[1].config(None).unwrap().seed.0), (4, 2));
        let refused = |sweep| check(&spec(sweep)).unwrap_err();
        assert!(refused(serde_json::json!({"seed": []})).starts_with("sweep: \"seed\" has no values"));
        assert!(refused(serde_json::json!({"model.hiden": [1]})).contains("hiden"));
    }

    #[test]
    fn a_mixture_names_other_data_sets_with_weights_above_0() {
        let check = |mixture| check(&training(&serde_json::json!({"preset": "paper", "mixture": mixture})));
        assert_eq!(check(serde_json::json!({"b": 0.3})), Ok(()));
        let zero = check(serde_json::json!({"b": 0.0})).unwrap_err();
        assert!(zero.contains("the weight of \"b\" is 0"), "{zero}");
        let same = check(serde_json::json!({"a": 1.0})).unwrap_err();
        assert!(same.contains("is the data set itself"), "{same}");
        let unknown = check(serde_json::json!({"c": 1.0})).unwrap_err();
        assert!(unknown.starts_with("mixture: "), "{unknown}");
    }
}
