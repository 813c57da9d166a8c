//! What a training is told: every setting, and its range.

use serde::{Deserialize, Serialize};

use super::TrainError;
use super::optimizer::AdamConfig;
use crate::dataset::{Dataset, sampler::WindowShape};
use crate::frame::preprocess::Preprocess;
use crate::nn::loss::Loss;
use crate::frame::warp::CameraModel;
use crate::nn::{Architecture, ChannelScale, Conditioning, FlowLayers, ModelSpec, Reconstruction};
use crate::types::{Channel, Seed};

/// The most steps of one stage.
const MAX_STEPS: usize = 10_000_000;
/// The most windows or frames in one batch.
const MAX_BATCH_SIZE: usize = 4096;

/// Everything that, with a data set, decides the weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// The model's name.
    pub name: String,
    /// The origin of all randomness.
    pub seed: Seed,
    /// The network.
    pub model: ModelConfig,
    /// Which windows.
    pub data: DataConfig,
    /// Stage 1: the dense codec alone, as an autoencoder of single frames.
    pub pretrain: PretrainConfig,
    /// Stage 2: the recurrent network.
    pub fit: FitConfig,
    /// What both stages share.
    pub run: RunConfig,
}

/// The network's free choices; the data set gives the rest of the [`ModelSpec`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// The kind of network.
    #[serde(default = "dense")]
    pub architecture: Architecture,
    /// Frames that the encoder reads.
    pub context: usize,
    /// Frames that the predictor writes.
    pub horizon: usize,
    /// Units of the dense codec.
    #[serde(default = "default_features")]
    pub features: usize,
    /// Units of each recurrent layer.
    #[serde(default = "default_hidden")]
    pub hidden: usize,
    /// Which of the paper's two ways to reconstruct.
    #[serde(default = "default_reconstruction")]
    pub reconstruction: Reconstruction,
    /// What the predictor is told.
    pub conditioning: Conditioning,
    /// How frames enter the model's space.
    pub preprocess: Preprocess,
    /// Sizes of the flow network.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flow: Option<FlowLayers>,
    /// The camera, where the data set does not describe it or is to be overruled. Only the flow network uses it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraModel>,
}

fn dense() -> Architecture {
    Architecture::Dense
}

fn default_features() -> usize {
    ModelSpec::default().features
}

fn default_hidden() -> usize {
    ModelSpec::default().hidden
}

fn default_reconstruction() -> Reconstruction {
    ModelSpec::default().reconstruction
}

/// The windows that are trained on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// How many, drawn at random, or `"all"`.
    pub windows: WindowBudget,
    /// How many windows of the validation split choose the best weights, at most.
    pub validation_windows: usize,
    /// The seed of the split into training, validation and test.
    pub split_seed: Seed,
}

/// A number of windows, or all there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum WindowBudget {
    /// So many.
    Count(usize),
    /// Every one.
    All(All),
}

/// The word `all`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum All {
    /// `"all"`
    All,
}

/// Stage 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PretrainConfig {
    /// Where the codec's weights start.
    pub start: CodecStart,
    /// Updates.
    pub steps: usize,
    /// Frames an update.
    pub batch_size: usize,
    /// Adam's, at its highest.
    pub learning_rate: f64,
}

/// Where the codec's weights start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CodecStart {
    /// At the principal components of the training frames.
    Principal,
    /// At random.
    Random,
}

/// Stage 2.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FitConfig {
    /// Updates.
    pub steps: usize,
    /// Windows an update.
    pub batch_size: usize,
    /// Adam's, at its highest.
    pub learning_rate: f64,
    /// Whether the pre-trained codec is trained on.
    pub codec: CodecTraining,
    /// What is minimized, in the model's space.
    pub loss: Loss,
    /// Which frames the decoder learns to write.
    pub target: Target,
    /// What the predictor reads after its first step while it is trained.
    pub feedback: TrainingFeedback,
    /// Weight of the reconstruction's loss beside the prediction's; 0 leaves the reconstruction decoder untrained.
    pub reconstruction_weight: f64,
    /// Weight of the scene's own loss (flow network): how far the surroundings alone are from the true frames.
    #[serde(default)]
    pub scene_weight: f64,
    /// Weight of the loss of the camera's motion (flow network) against the poses measured later, where there are any.
    #[serde(default)]
    pub motion_weight: f64,
}

/// Which frames the decoder learns to write, in both stages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Target {
    /// As the camera took them, inverted where the model inverts.
    Sharp,
    /// As the encoder reads them: smoothed too.
    Smoothed,
}

/// What becomes of the pre-trained codec in stage 2.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CodecTraining {
    /// It stays as pre-trained.
    Frozen,
    /// It is trained on with the rest.
    FineTuned,
}

/// What the predictor reads after its first step while it is trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TrainingFeedback {
    /// Its own last prediction, as when it is used.
    Prediction,
    /// The true frame's features (teacher forcing).
    TeacherForcing,
}

/// What both stages share.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Updates over which the learning rate rises from 0.
    pub warmup_steps: usize,
    /// The last learning rate as a share of the highest, reached along a cosine.
    pub final_learning_rate: f64,
    /// The largest norm of all gradients together.
    pub clip_norm: f64,
    /// Equal parts of a batch that are differentiated side by side, each on a core.
    pub batch_parts: usize,
    /// Updates from one validation to the next.
    pub validate_every_steps: usize,
    /// Updates from one checkpoint to the next.
    pub checkpoint_every_steps: usize,
}

impl RunConfig {
    /// The optimizer's constants.
    pub(super) fn adam(&self) -> AdamConfig {
        AdamConfig {
            clip_norm: self.clip_norm,
            ..AdamConfig::default()
        }
    }
}

impl TrainConfig {
    /// The configuration as a TOML text.
    pub fn to_toml(&self) -> Result<String, TrainError> {
        toml::to_string_pretty(self).map_err(|error| TrainError::Config(error.to_string()))
    }

    /// Errors: `Config` with the first field that is out of range and its range.
    pub fn validate(&self) -> Result<(), TrainError> {
        if !crate::registry::is_valid_name(&self.name) {
            return Err(crate::registry::RegistryError::Name(self.name.clone()).into());
        }
        let (run, fit, pretrain) = (&self.run, &self.fit, &self.pretrain);
        let counts = [
            ("pretrain.steps", pretrain.steps, 0, MAX_STEPS),
            ("pretrain.batch_size", pretrain.batch_size, 1, MAX_BATCH_SIZE),
            ("fit.steps", fit.steps, 1, MAX_STEPS),
            ("fit.batch_size", fit.batch_size, 1, MAX_BATCH_SIZE),
            ("data.validation_windows", self.data.validation_windows, 1, MAX_STEPS),
            ("run.batch_parts", run.batch_parts, 1, 64),
            ("run.validate_every_steps", run.validate_every_steps, 1, MAX_STEPS),
            ("run.checkpoint_every_steps", run.checkpoint_every_steps, 1, MAX_STEPS),
            ("run.warmup_steps", run.warmup_steps, 0, MAX_STEPS),
        ];
        for (field, value, least, most) in counts {
            if !(least..=most).contains(&value) {
                return Err(TrainError::Config(format!(
                    "{field} is {value}; it must be {least} to {most}"
                )));
            }
        }
        let numbers = [
            ("pretrain.learning_rate", pretrain.learning_rate, 1.0),
            ("fit.learning_rate", fit.learning_rate, 1.0),
            ("fit.reconstruction_weight", fit.reconstruction_weight, 100.0),
            ("fit.scene_weight", fit.scene_weight, 100.0),
            ("fit.motion_weight", fit.motion_weight, 100.0),
            ("run.final_learning_rate", run.final_learning_rate, 1.0),
            ("run.clip_norm", run.clip_norm, 1e6),
        ];
        for (field, value, most) in numbers {
            if !(0.0..=most).contains(&value) {
                return Err(TrainError::Config(format!(
                    "{field} is {value}; it must be 0 to {most}"
                )));
            }
        }
        for (field, size) in [
            ("pretrain.batch_size", pretrain.batch_size),
            ("fit.batch_size", fit.batch_size),
        ] {
            if !size.is_multiple_of(run.batch_parts) {
                return Err(TrainError::Config(format!(
                    "{field} is {size}; it must be a multiple of run.batch_parts, {}",
                    run.batch_parts
                )));
            }
        }
        if self.data.windows == WindowBudget::Count(0) {
            return Err(TrainError::Config(
                "data.windows is 0; it must be at least 1, or \"all\"".to_owned(),
            ));
        }
        Ok(())
    }

    /// Inputs and targets of one window.
    #[must_use]
    pub fn window_shape(&self) -> WindowShape {
        WindowShape {
            context: self.model.context,
            horizon: self.model.horizon,
        }
    }

    /// The model's description on that data set, channels scaled by the given training frames.
    #[must_use]
    pub fn model_spec(&self, dataset: &Dataset, frames: &[usize]) -> ModelSpec {
        let (info, model) = (dataset.info(), &self.model);
        let actions = scales(&info.action_channels, frames, |frame| dataset.action(frame));
        let states = scales(&info.state_channels, frames, |frame| dataset.state(frame));
        let is_flow = model.architecture == Architecture::Flow;
        ModelSpec {
            architecture: model.architecture,
            frame_width_px: info.frame_width_px,
            frame_height_px: info.frame_height_px,
            frame_period_s: info.frame_period_s,
            preprocess: model.preprocess,
            context: model.context,
            horizon: model.horizon,
            features: model.features,
            hidden: model.hidden,
            reconstruction: model.reconstruction,
            conditioning: model.conditioning,
            actions,
            states,
            flow: is_flow.then(|| model.flow.unwrap_or_default()),
            camera: model.camera.or(info.camera).filter(|_| is_flow),
        }
    }
}

/// Mean and standard deviation of each channel over the frames.
fn scales<'a>(channels: &[Channel], frames: &[usize], values: impl Fn(usize) -> &'a [f32]) -> Vec<ChannelScale> {
    let count = frames.len().max(1) as f64;
    let moment = |index: usize, power: i32, mean: f64| {
        frames
            .iter()
            .map(|&frame| (f64::from(values(frame)[index]) - mean).powi(power))
            .sum::<f64>()
            / count
    };
    let scale = |(index, channel): (usize, &Channel)| {
        let mean = moment(index, 1, 0.0);
        ChannelScale {
            name: channel.name.clone(),
            unit: channel.unit.clone(),
            mean: mean as f32,
            std: (moment(index, 2, mean).sqrt() as f32).max(1e-3),
        }
    };
    channels.iter().enumerate().map(scale).collect()
}
