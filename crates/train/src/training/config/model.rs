//! The settings of the network.

use serde::{Deserialize, Serialize};

use foreframe_core::frame::preprocess::Preprocess;
use foreframe_core::nn::{
    ArchitectureKind, Conditioning, DenseSpec, FlowLayers, PredictorOutput, Reconstruction, SpriteSpec,
};

/// Settings of the network. The other values of the [`ModelSpec`](foreframe_core::nn::ModelSpec) come from the data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "ModelSettings", into = "ModelSettings")]
pub struct ModelConfig {
    /// The network, with its sizes.
    pub architecture: ArchitectureConfig,
    /// Number of context frames.
    pub context: usize,
    /// Number of predicted frames.
    pub horizon: usize,
    /// The inputs of a prediction besides the context frames.
    pub conditioning: Conditioning,
    /// How frames are converted to the model's value range.
    pub preprocess: Preprocess,
}

/// The network of a training, with its sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArchitectureConfig {
    /// The paper's.
    Dense(DenseSpec),
    /// A convolutional network that moves the pixels of the last frame.
    Flow(FlowLayers),
    /// A network that moves two pictures, each as a whole.
    Sprites(SpriteSpec),
}

impl ArchitectureConfig {
    /// The kind of network.
    #[must_use]
    pub fn kind(&self) -> ArchitectureKind {
        match self {
            Self::Dense(_) => ArchitectureKind::Dense,
            Self::Flow(_) => ArchitectureKind::Flow,
            Self::Sprites(_) => ArchitectureKind::Sprites,
        }
    }
}

/// The written form: one table, in which the sizes of all networks stand beside what is common. Only those of the network that
/// `architecture` names count, so that `--set model.architecture=flow` can change the
/// network of a preset.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelSettings {
    #[serde(default = "ArchitectureKind::dense")]
    architecture: ArchitectureKind,
    context: usize,
    horizon: usize,
    #[serde(default = "default_features")]
    features: usize,
    #[serde(default = "default_hidden")]
    hidden: usize,
    #[serde(default = "default_reconstruction")]
    reconstruction: Reconstruction,
    #[serde(default = "PredictorOutput::residual")]
    predictor_output: PredictorOutput,
    conditioning: Conditioning,
    preprocess: Preprocess,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    flow: Option<FlowLayers>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sprites: Option<SpriteSpec>,
}

fn default_features() -> usize {
    DenseSpec::default().features
}

fn default_hidden() -> usize {
    DenseSpec::default().hidden
}

fn default_reconstruction() -> Reconstruction {
    DenseSpec::default().reconstruction
}

impl From<ModelSettings> for ModelConfig {
    fn from(settings: ModelSettings) -> Self {
        let architecture = match settings.architecture {
            ArchitectureKind::Dense => ArchitectureConfig::Dense(DenseSpec {
                features: settings.features,
                hidden: settings.hidden,
                reconstruction: settings.reconstruction,
                predictor_output: settings.predictor_output,
            }),
            ArchitectureKind::Flow => ArchitectureConfig::Flow(settings.flow.unwrap_or_default()),
            ArchitectureKind::Sprites => ArchitectureConfig::Sprites(settings.sprites.unwrap_or_default()),
        };
        Self {
            architecture,
            context: settings.context,
            horizon: settings.horizon,
            conditioning: settings.conditioning,
            preprocess: settings.preprocess,
        }
    }
}

impl From<ModelConfig> for ModelSettings {
    fn from(config: ModelConfig) -> Self {
        let (dense, flow, sprites) = match config.architecture {
            ArchitectureConfig::Dense(dense) => (dense, None, None),
            ArchitectureConfig::Flow(layers) => (DenseSpec::default(), Some(layers), None),
            ArchitectureConfig::Sprites(sprites) => (DenseSpec::default(), None, Some(sprites)),
        };
        Self {
            architecture: config.architecture.kind(),
            context: config.context,
            horizon: config.horizon,
            features: dense.features,
            hidden: dense.hidden,
            reconstruction: dense.reconstruction,
            predictor_output: dense.predictor_output,
            conditioning: config.conditioning,
            preprocess: config.preprocess,
            flow,
            sprites,
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::training::config::TrainConfig;

    fn model_settings(preset: &str, settings: &[&str]) -> toml::Table {
        let settings: Vec<String> = settings.iter().map(|setting| (*setting).to_owned()).collect();
        let config = TrainConfig::layered(preset, None, &settings).unwrap();
        let mut all: toml::Table = config.to_toml().unwrap().parse().unwrap();
        match all.remove("model") {
            Some(toml::Value::Table(model)) => model,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn all_settings_are_written_under_their_names() {
        let keys = |model: &toml::Table| model.keys().cloned().collect::<Vec<_>>().join(" ");
        let common = "architecture conditioning context features";
        let rest = "hidden horizon predictor_output preprocess reconstruction";
        let dense = model_settings("moving", &["model.features=64"]);
        assert_eq!(keys(&dense), format!("{common} {rest}"));
        assert_eq!(dense["features"].as_integer(), Some(64));
        let flow = model_settings("moving-flow", &["model.flow.channels=32"]);
        assert_eq!(keys(&flow), format!("{common} flow {rest}"));
        assert_eq!(flow["flow"]["channels"].as_integer(), Some(32));
    }

    #[test]
    fn settings_can_name_the_other_network() {
        let dense = model_settings(
            "moving-flow",
            &["model.architecture=dense", "model.hidden=32", "pretrain.steps=1"],
        );
        assert_eq!(
            (dense["hidden"].as_integer(), dense.contains_key("flow")),
            (Some(32), false)
        );
        let flow = model_settings(
            "moving",
            &["model.architecture=flow", "pretrain.steps=0", "pretrain.start=random"],
        );
        assert_eq!(flow["flow"]["channels"].as_integer(), Some(48));
    }

    #[test]
    fn unknown_settings_of_a_network_are_refused() {
        let refused = |setting: &str| {
            let config = TrainConfig::layered("moving-flow", None, &[setting.to_owned()]);
            config.unwrap_err().to_string()
        };
        assert!(refused("model.featurez=3").starts_with("unknown field `featurez` in `model`"));
        assert!(refused("model.flow.channelz=3").starts_with("unknown field `channelz` in `model.flow`"));
        assert!(refused("model.features=many").starts_with("model.features is \"many\""));
    }
}
