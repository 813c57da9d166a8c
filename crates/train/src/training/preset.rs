//! The presets, and how a file and single settings change them.

use super::config::TrainConfig;
use super::{START_KEY, TrainError};
use crate::settings::{LayeredSettings, SettingsLayer};
use foreframe_core::registry::Manifest;

/// Name and text of each preset.
const PRESETS: [(&str, &str); 8] = [
    ("paper", include_str!("presets/paper.toml")),
    ("static", include_str!("presets/static.toml")),
    ("moving", include_str!("presets/moving.toml")),
    ("static-flow", include_str!("presets/static-flow.toml")),
    ("moving-flow", include_str!("presets/moving-flow.toml")),
    ("rooms", include_str!("presets/rooms.toml")),
    ("recording", include_str!("presets/recording.toml")),
    ("moving-mnist", include_str!("presets/moving-mnist.toml")),
];

/// The command that lists all settings.
const LISTING: &str = "foreframe train --print-config";

impl TrainConfig {
    /// The names of the presets.
    #[must_use]
    pub fn preset_names() -> Vec<&'static str> {
        PRESETS.iter().map(|(name, _)| *name).collect()
    }

    /// A preset as it is. Errors: `UnknownPreset` with the known names.
    pub fn preset(name: &str) -> Result<Self, TrainError> {
        Self::from_layers(name, [])
    }

    /// A preset, changed by a TOML text, then by settings `KEY=VALUE` with dotted keys, and checked.
    /// Errors: `UnknownPreset`, `Config` with the field that is wrong.
    pub fn layered(preset: &str, text: Option<&str>, settings: &[String]) -> Result<Self, TrainError> {
        let text = text.map(|text| SettingsLayer::toml("settings", text)).into_iter();
        let settings = settings.iter().map(|setting| SettingsLayer::assignment(setting));
        let layers: Result<Vec<_>, _> = text.chain(settings).collect();
        Self::from_layers(preset, layers?)
    }

    /// A preset under layers of settings, later ones over earlier ones, checked.
    /// Errors: `UnknownPreset`, `Config` with the field that is wrong.
    pub fn from_layers(preset: &str, layers: impl IntoIterator<Item = SettingsLayer>) -> Result<Self, TrainError> {
        let (_, text) = PRESETS
            .iter()
            .find(|(name, _)| *name == preset)
            .ok_or_else(|| TrainError::UnknownPreset {
                name: preset.to_owned(),
                known: Self::preset_names(),
            })?;
        let origin = format!("preset {preset}");
        let written = SettingsLayer::toml(&origin, text)?;
        Self::over(written, origin, layers)
    }

    /// The settings with which a model was trained, without its pre-training, under layers of settings, checked.
    /// Errors: `Config` with the field that is wrong.
    pub fn of_model(manifest: &Manifest, layers: impl IntoIterator<Item = SettingsLayer>) -> Result<Self, TrainError> {
        let origin = format!("model {}", manifest.name);
        let mut settings = manifest.training.clone();
        if let Some(settings) = settings.as_object_mut() {
            settings.remove(START_KEY);
        }
        // Its codec has been trained already, and it knows the first frames.
        for known in ["/pretrain/steps", "/sequence/short_share"] {
            if let Some(value) = settings.pointer_mut(known) {
                *value = 0.into();
            }
        }
        let written = SettingsLayer::serialized(&origin, &settings);
        Self::over(written, origin, layers)
    }

    fn over(
        written: SettingsLayer,
        origin: String,
        layers: impl IntoIterator<Item = SettingsLayer>,
    ) -> Result<Self, TrainError> {
        let written: Self = extract(written, [])?;
        // With the settings that the preset's text leaves out, so that they can be given too.
        let defaults = SettingsLayer::serialized(origin, &written);
        let config: Self = extract(defaults, layers)?;
        config.validate()?;
        Ok(config)
    }
}

fn extract(
    defaults: SettingsLayer,
    layers: impl IntoIterator<Item = SettingsLayer>,
) -> Result<TrainConfig, TrainError> {
    let values = LayeredSettings::merge(defaults, layers, LISTING)?;
    Ok(values.extract(expected)?)
}

/// What a setting must be, where its type does not say it well.
fn expected(key: &str) -> Option<String> {
    let expected = match key {
        "name" => "a name of 1 to 64 characters of a to z, 0 to 9 and -, not starting with -",
        "data.windows" => "a whole number, 1 or more, or \"all\"",
        "data.mirror" => {
            "\"off\", \"movers\" (for a camera that stands), or a list of the channels whose sign changes, as in [\"steering\"]"
        }
        "run.optimizer" => "\"adam\" or \"muon\"",
        _ => return None,
    };
    Some(expected.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::config::{CodecTraining, WindowBudget};
    use foreframe_core::types::Seed;

    #[test]
    fn every_preset_is_valid_and_named_as_its_file() {
        for name in TrainConfig::preset_names() {
            assert_eq!(TrainConfig::preset(name).unwrap().name, name);
        }
    }

    #[test]
    fn a_printed_configuration_is_accepted_again() {
        for name in TrainConfig::preset_names() {
            let config = TrainConfig::preset(name).unwrap();
            let again = TrainConfig::layered(name, Some(&config.to_toml().unwrap()), &[]).unwrap();
            assert_eq!(again, config);
        }
    }

    #[test]
    fn settings_override_the_file_which_overrides_the_preset() {
        let file = "seed = 5\n[sequence]\nsteps = 10\nlearning_rate = 0.5\n";
        let settings = [
            "sequence.steps=20".to_owned(),
            "data.windows=all".to_owned(),
            "sequence.codec=frozen".to_owned(),
        ];
        let config = TrainConfig::layered("paper", Some(file), &settings).unwrap();
        assert_eq!(
            (config.seed, config.sequence.steps, config.sequence.learning_rate),
            (Seed(5), 20, 0.5)
        );
        assert_eq!(
            (config.data.windows, config.sequence.codec),
            (WindowBudget::All, CodecTraining::Frozen)
        );
    }

    #[test]
    fn the_error_for_an_unknown_preset_lists_the_presets() {
        let error = TrainConfig::preset("papper").unwrap_err().to_string();
        assert_eq!(
            error,
            "there is no preset \"papper\"; there are: paper, static, moving, static-flow, moving-flow, rooms, recording, \
             moving-mnist"
        );
    }

    #[test]
    fn a_misspelt_field_is_refused_by_name() {
        let error = TrainConfig::layered("paper", None, &["sequence.stepz=3".to_owned()])
            .unwrap_err()
            .to_string();
        assert_eq!(
            error,
            "unknown field `stepz` in `sequence` (--set); `foreframe train --print-config` lists all settings"
        );
    }

    #[test]
    fn a_value_of_another_kind_is_refused_with_its_field_and_origin() {
        let message =
            |file, settings: &[String]| TrainConfig::layered("paper", file, settings).unwrap_err().to_string();
        assert_eq!(
            message(None, &["sequence.steps=many".to_owned()]),
            "sequence.steps is \"many\" (--set); it must be a whole number, 0 or more"
        );
        assert_eq!(
            message(Some("[data]\nwindows = \"some\"\n"), &[]),
            "data.windows is \"some\" (settings); it must be a whole number, 1 or more, or \"all\""
        );
        assert_eq!(
            message(Some("[sequence]\ncodec = \"thawed\"\n"), &[]),
            "sequence.codec is \"thawed\" (settings); it must be frozen or fine-tuned"
        );
        assert_eq!(
            message(Some("sequence = 3\n"), &[]),
            "sequence is 3 (settings); it must be a table"
        );
    }

    #[test]
    fn a_number_out_of_range_is_refused_with_its_range() {
        let error = TrainConfig::layered("paper", None, &["sequence.learning_rate=nan".to_owned()])
            .unwrap_err()
            .to_string();
        assert_eq!(error, "sequence.learning_rate is NaN; it must be 0 to 1");
        let error = TrainConfig::layered("paper", None, &["sequence.batch_size=0".to_owned()])
            .unwrap_err()
            .to_string();
        assert_eq!(error, "sequence.batch_size is 0; it must be 1 to 4096");
    }
}
