//! The presets, and how a file and single settings change them.

use toml::{Table, Value};

use super::TrainError;
use super::config::TrainConfig;

/// Name and text of each preset.
const PRESETS: [(&str, &str); 5] = [
    ("paper", include_str!("presets/paper.toml")),
    ("static", include_str!("presets/static.toml")),
    ("moving", include_str!("presets/moving.toml")),
    ("static-flow", include_str!("presets/static-flow.toml")),
    ("moving-flow", include_str!("presets/moving-flow.toml")),
];

impl TrainConfig {
    /// The names of the presets.
    #[must_use]
    pub fn preset_names() -> Vec<&'static str> {
        PRESETS.iter().map(|(name, _)| *name).collect()
    }

    /// A preset as it is. Errors: `UnknownPreset` with the names there are.
    pub fn preset(name: &str) -> Result<Self, TrainError> {
        Self::layered(name, None, &[])
    }

    /// A preset, changed by a TOML text, then by settings `KEY=VALUE` with dotted keys, and checked.
    /// Errors: `UnknownPreset`, `Config` with the field that is wrong.
    pub fn layered(preset: &str, file: Option<&str>, settings: &[String]) -> Result<Self, TrainError> {
        let (_, text) = PRESETS
            .iter()
            .find(|(name, _)| *name == preset)
            .ok_or_else(|| TrainError::UnknownPreset(preset.to_owned()))?;
        let mut table = parse(text)?;
        if let Some(file) = file {
            merge(&mut table, parse(file)?);
        }
        for setting in settings {
            merge(&mut table, parse_setting(setting)?);
        }
        let config: Self = table
            .try_into()
            .map_err(|error| TrainError::Config(with_field(&error)))?;
        config.validate()?;
        Ok(config)
    }
}

fn parse(text: &str) -> Result<Table, TrainError> {
    text.parse().map_err(|error: toml::de::Error| {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        let line = before.matches('\n').count() + 1;
        TrainError::Config(format!(
            "the configuration is no TOML in line {line}: {}",
            error.message()
        ))
    })
}

/// The error's message, and the field that it tells in a line of its own.
fn with_field(error: &toml::de::Error) -> String {
    error.to_string().trim().replace('\n', " ")
}

/// `fit.steps=3000` as the table it stands for; a value that is no TOML is taken as a string.
fn parse_setting(setting: &str) -> Result<Table, TrainError> {
    let (key, value) = setting.split_once('=').ok_or_else(|| {
        TrainError::Config(format!(
            "{setting:?} is no setting; write KEY=VALUE, as in fit.steps=3000"
        ))
    })?;
    let (key, value) = (key.trim(), value.trim());
    format!("{key} = {value}")
        .parse()
        .or_else(|_| format!("{key} = {value:?}").parse())
        .map_err(|_| TrainError::Config(format!("{key:?} is no field; --print-config shows them all")))
}

/// Lays `over` upon `base`, table by table.
fn merge(base: &mut Table, over: Table) {
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(inner)), Value::Table(value)) => merge(inner, value),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::config::{All, CodecTraining, WindowBudget};
    use crate::types::Seed;

    #[test]
    fn every_preset_is_valid_and_named_as_its_file() {
        for name in TrainConfig::preset_names() {
            assert_eq!(TrainConfig::preset(name).unwrap().name, name);
        }
    }

    #[test]
    fn settings_override_the_file_which_overrides_the_preset() {
        let file = "seed = 5\n[fit]\nsteps = 10\nlearning_rate = 0.5\n";
        let settings = [
            "fit.steps=20".to_owned(),
            "data.windows=all".to_owned(),
            "fit.codec=frozen".to_owned(),
        ];
        let config = TrainConfig::layered("paper", Some(file), &settings).unwrap();
        assert_eq!(
            (config.seed, config.fit.steps, config.fit.learning_rate),
            (Seed(5), 20, 0.5)
        );
        assert_eq!(
            (config.data.windows, config.fit.codec),
            (WindowBudget::All(All::All), CodecTraining::Frozen)
        );
    }

    #[test]
    fn an_unknown_preset_is_answered_with_the_names_there_are() {
        let error = TrainConfig::preset("papper").unwrap_err().to_string();
        assert_eq!(error, "there is no preset \"papper\"; there are: paper, static, moving, static-flow, moving-flow");
    }

    #[test]
    fn a_misspelt_field_is_refused_by_name() {
        let error = TrainConfig::layered("paper", None, &["fit.stepz=3".to_owned()])
            .unwrap_err()
            .to_string();
        assert!(error.contains("unknown field `stepz`"), "{error}");
    }

    #[test]
    fn a_value_of_another_kind_is_refused_with_its_field_and_a_damaged_file_with_its_line() {
        let message =
            |file, settings: &[String]| TrainConfig::layered("paper", file, settings).unwrap_err().to_string();
        assert_eq!(
            message(None, &["fit.steps=many".to_owned()]),
            "invalid type: string \"many\", expected usize in `fit.steps`"
        );
        assert!(message(Some("seed = 5\n[fit\n"), &[]).starts_with("the configuration is no TOML in line 2: "));
        assert!(message(None, &["fit steps=3".to_owned()]).starts_with("\"fit steps\" is no field"));
    }

    #[test]
    fn a_number_out_of_range_is_refused_with_its_range() {
        let error = TrainConfig::layered("paper", None, &["fit.learning_rate=nan".to_owned()])
            .unwrap_err()
            .to_string();
        assert_eq!(error, "fit.learning_rate is NaN; it must be 0 to 1");
        let error = TrainConfig::layered("paper", None, &["fit.batch_size=0".to_owned()])
            .unwrap_err()
            .to_string();
        assert_eq!(error, "fit.batch_size is 0; it must be 1 to 4096");
    }
}
