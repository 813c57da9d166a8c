//! The configuration of a training: all settings. `checks` has their ranges.

mod checks;
mod model;

pub use model::{ArchitectureConfig, ModelConfig};

use serde::{Deserialize, Serialize};

use super::TrainError;
use super::observer::TrainingStage;
use super::optimizer::{OptimizerConfig, UpdateRule};
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::nn::loss::Loss;
use foreframe_core::nn::spec::MIN_CHANNEL_STD;
use foreframe_core::nn::{Architecture, ChannelScale, FlowSpec, ModelSpec};
use foreframe_core::types::{Channel, ModelName, Seed};
use foreframe_data::dataset::{Dataset, DatasetInfo, Lacking, sampler::WindowShape};

/// All settings of a training. Together with the data set, they determine the weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// The model's name.
    pub name: ModelName,
    /// The origin of all randomness.
    pub seed: Seed,
    /// Settings of the network.
    #[doc(hidden)]
    pub model: ModelConfig,
    /// Settings of the windows.
    #[doc(hidden)]
    pub data: DataConfig,
    /// Stage 1, pre-training: the dense codec alone, as an autoencoder of single frames.
    #[doc(hidden)]
    pub pretrain: PretrainConfig,
    /// Stage 2, sequence training: the recurrent network.
    #[doc(hidden)]
    pub sequence: SequenceConfig,
    /// Settings of both stages.
    #[doc(hidden)]
    pub run: RunConfig,
}

/// Settings of the windows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Number of training windows, drawn at random, or `"all"`.
    pub windows: WindowBudget,
    /// Trains only on the first so many seconds of the training split (of each data set of a mixture), to see how much of a recording
    /// is needed; 0 for all. Only with `windows = "all"`.
    #[serde(default)]
    pub first_seconds: f64,
    /// Largest number of validation windows used to choose the best weights.
    pub validation_windows: usize,
    /// The seed of the split into training, validation and test parts.
    pub split_seed: Seed,
    /// What is mirrored left to right in half of the training windows.
    #[serde(default)]
    pub mirror: Mirror,
    /// Whether half of the training windows are played backwards. Only for models that take no actions and no state.
    #[serde(default)]
    pub reverse: bool,
    /// Each training window is made brighter or darker by up to this share, 0 to 0.9.
    #[serde(default)]
    pub brightness: f64,
    /// Each training window shows a part of the frames, enlarged: up to this share of each side is cut off, 0 to 0.5. Only for
    /// data sets without a camera model.
    #[serde(default)]
    pub crop: f64,
    /// The share of training windows that hide their states, half of them their actions too, 0 to 1. Only for networks that see how
    /// fast the camera drives (`model.flow.speeds`).
    #[serde(default)]
    pub hidden: f64,
    /// Whether a model may be conditioned on actions that never change in the training windows.
    #[serde(default)]
    pub constant_actions: bool,
}

/// A number of windows, or all windows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WindowBudget {
    /// `"all"`
    All,
    /// This number of windows.
    #[serde(untagged)]
    Count(usize),
}

/// What is mirrored left to right in half of the training windows.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mirror {
    /// `"off"`: nothing.
    #[default]
    Off,
    /// `"movers"`: what moves in front of a standing camera.
    Movers,
    /// Whole frames, with the sign of these channels of actions and states changed, as in `["steering"]`; it may be empty.
    #[serde(untagged)]
    Channels(Vec<String>),
}

/// Settings of pre-training (stage 1).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PretrainConfig {
    /// The initial weights of the codec.
    pub start: CodecStart,
    /// Number of updates.
    pub steps: usize,
    /// Frames per update.
    pub batch_size: usize,
    /// The highest learning rate.
    pub learning_rate: f64,
}

/// The initial weights of the codec.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CodecStart {
    /// The principal components of the training frames.
    Principal,
    /// Random weights, with biases that centre the features.
    Random,
}

/// Settings of sequence training (stage 2).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SequenceConfig {
    /// Number of updates.
    pub steps: usize,
    /// Windows per update.
    pub batch_size: usize,
    /// The highest learning rate.
    pub learning_rate: f64,
    /// Whether the pre-trained codec is trained further.
    pub codec: CodecTraining,
    /// The loss function, computed in the model's value range.
    pub loss: Loss,
    /// The target frames of the decoder, in both stages.
    pub target: Target,
    /// What the predictor gets as the previous frame in training, after its first step; `"prediction"` unless the network is dense.
    pub feedback: TrainingFeedback,
    /// Weight of the reconstruction loss; the prediction loss has weight 1. With 0, the reconstruction decoder is not
    /// trained. The sprite network learns what its sprites look like from this loss, so there it must be above 0.
    pub reconstruction_weight: f64,
    /// Weight of the similarity loss (flow and sprite networks): 1 minus the structural similarity of the predicted frames.
    #[serde(default)]
    pub ssim_weight: f64,
    /// In this share of the updates, the first ones, the frame and SSIM losses count only the first `short_horizon` predicted
    /// frames of each window (flow network). In its recurrent form, these updates take less time.
    #[serde(default)]
    pub short_share: f64,
    /// Frames that count in these first updates, 1 to the horizon.
    #[serde(default = "SequenceConfig::default_short_horizon")]
    pub short_horizon: usize,
    /// Weight of the scene loss (flow network): the difference between the scene alone and the true frames.
    #[serde(default)]
    pub scene_weight: f64,
    /// Weight of the motion loss. Flow network: the difference between the predicted camera motion and the motion between the
    /// measured poses, if the states have a pose. Sprite network: the distance, in pixels, between where sprites are predicted and where
    /// their blocks go.
    #[serde(default)]
    pub motion_weight: f64,
    /// Weight of the loss of movers (flow network with `movers`): the cross entropy of where they are and will be.
    #[serde(default)]
    pub movers_weight: f64,
    /// Weight of the loss of speeds (flow network with `speeds`): the difference between the speeds that the frames show and those
    /// in the states, in m/s and rad/s.
    #[serde(default)]
    pub speeds_weight: f64,
}

impl SequenceConfig {
    fn default_short_horizon() -> usize {
        1
    }

    /// How many frames of a window of `horizon` count in the update after `step` updates.
    pub(super) fn frames_that_count(&self, step: usize, horizon: usize) -> usize {
        if (step as f64) < self.short_share * self.steps as f64 {
            self.short_horizon
        } else {
            horizon
        }
    }
}

/// The target frames of the decoder, in both stages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Target {
    /// The camera's frames without smoothing, inverted if the model inverts.
    Sharp,
    /// The same frames as the encoder's inputs: smoothed.
    Smoothed,
}

/// How the pre-trained codec is used in stage 2.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CodecTraining {
    /// Its weights do not change.
    Frozen,
    /// It is trained together with the recurrent network.
    FineTuned,
}

/// What the predictor gets as the previous frame in training, after its first step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TrainingFeedback {
    /// Its own last prediction, as in use (autoregressive).
    Prediction,
    /// The true frame's features (teacher forcing).
    TeacherForcing,
}

/// Settings of both stages.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// How weights are updated: `"adam"`, or `"muon"` (flow and sprite networks).
    #[serde(default)]
    pub optimizer: UpdateRule,
    /// Updates over which the learning rate rises from 0.
    pub warmup_steps: usize,
    /// The final learning rate as a share of the highest one; the rate decreases along a cosine.
    pub final_learning_rate: f64,
    /// The largest norm of all gradients together; larger gradients are scaled down.
    pub clip_norm: f64,
    /// Number of equal parts of a batch whose gradients are computed in parallel, each on one core.
    pub batch_parts: usize,
    /// Updates between two validations.
    pub validate_every_steps: usize,
    /// Updates between two checkpoints.
    pub checkpoint_every_steps: usize,
}

impl RunConfig {
    /// The optimizer's settings.
    pub(super) fn optimizer(&self) -> OptimizerConfig {
        OptimizerConfig {
            rule: self.optimizer,
            clip_norm: self.clip_norm,
        }
    }
}

impl TrainConfig {
    /// The configuration as TOML text. Errors: `Config`.
    pub fn to_toml(&self) -> Result<String, TrainError> {
        toml::to_string_pretty(self).map_err(|error| TrainError::Config(error.to_string()))
    }

    /// The number of updates of a stage, and its highest learning rate.
    pub(super) fn stage(&self, stage: TrainingStage) -> (usize, f64) {
        match stage {
            TrainingStage::Pretrain => (self.pretrain.steps, self.pretrain.learning_rate),
            TrainingStage::Sequence => (self.sequence.steps, self.sequence.learning_rate),
        }
    }

    /// Whether the network sees in the frames how fast the camera drives, so that states and actions may be missing.
    #[doc(hidden)]
    #[must_use]
    pub fn sees_speeds(&self) -> bool {
        matches!(self.model.architecture, ArchitectureConfig::Flow(layers) if layers.speeds)
    }

    /// Whether the network remembers one room, for which the pose must be known.
    pub(super) fn remembers_room(&self) -> bool {
        matches!(self.model.architecture, ArchitectureConfig::Flow(layers) if layers.memory)
    }

    /// What becomes of channels and masks that one of several data sets lacks.
    #[doc(hidden)]
    #[must_use]
    pub fn lacking(&self) -> Lacking {
        if self.sees_speeds() && !self.remembers_room() {
            Lacking::NotKnown
        } else {
            Lacking::Refused
        }
    }

    /// Context and horizon of a window.
    #[must_use]
    pub fn window_shape(&self) -> WindowShape {
        WindowShape {
            context: self.model.context,
            horizon: self.model.horizon,
        }
    }

    /// The model specification for this data set. Channels are scaled by their statistics over the given training frames.
    #[must_use]
    pub fn model_spec(&self, dataset: &Dataset, frames: &[usize]) -> ModelSpec {
        let info = dataset.info();
        let mut spec = self.unscaled_spec(info);
        spec.actions = scales(&info.action_channels, frames, |frame| dataset.action(frame));
        spec.states = scales(&info.state_channels, frames, |frame| dataset.state(frame));
        if let Architecture::Flow(flow) = &mut spec.architecture
            && flow.layers.depth
        {
            flow.camera = mean_camera(dataset).or(info.camera);
        }
        spec
    }

    /// As [`Self::model_spec`], without the statistics of the channels and without the cameras of the episodes.
    pub(super) fn unscaled_spec(&self, info: &DatasetInfo) -> ModelSpec {
        let model = &self.model;
        let unscaled = |channels: &[Channel]| channels.iter().map(|channel| scaled(channel, 0.0, 1.0)).collect();
        ModelSpec {
            architecture: match model.architecture {
                ArchitectureConfig::Dense(dense) => Architecture::Dense(dense),
                ArchitectureConfig::Flow(layers) => Architecture::Flow(FlowSpec {
                    layers,
                    camera: info.camera,
                }),
                ArchitectureConfig::Sprites(sprites) => Architecture::Sprites(sprites),
            },
            frame_width_px: info.frame_width_px,
            frame_height_px: info.frame_height_px,
            frame_period_s: info.frame_period_s,
            preprocess: model.preprocess,
            context: model.context,
            horizon: model.horizon,
            conditioning: model.conditioning,
            actions: unscaled(&info.action_channels),
            states: unscaled(&info.state_channels),
        }
    }
}

fn scaled(channel: &Channel, mean: f32, std: f32) -> ChannelScale {
    ChannelScale {
        name: channel.name.clone(),
        unit: channel.unit.clone(),
        mean,
        std,
    }
}

/// The mean of the episodes' cameras: what a model that serves any camera takes where a request names none.
fn mean_camera(dataset: &Dataset) -> Option<CameraModel> {
    let cameras: Vec<CameraModel> = (0..dataset.episodes().len())
        .filter_map(|episode| dataset.camera(episode))
        .collect();
    let heights: Vec<f32> = cameras.iter().filter_map(|camera| camera.height_m).collect();
    let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len().max(1) as f32;
    let of = |value: fn(&CameraModel) -> f32| mean(&cameras.iter().map(value).collect::<Vec<_>>());
    (!cameras.is_empty()).then(|| CameraModel {
        horizontal_fov_rad: of(|camera| camera.horizontal_fov_rad),
        tilt_down_rad: of(|camera| camera.tilt_down_rad),
        height_m: (!heights.is_empty()).then(|| mean(&heights)),
    })
}

/// Mean and standard deviation of each channel over the frames of which it is known.
fn scales<'a>(channels: &[Channel], frames: &[usize], values: impl Fn(usize) -> &'a [f32]) -> Vec<ChannelScale> {
    // Of joined data sets, one may lack a channel.
    let known = |index: usize| -> Vec<f64> {
        let all = frames.iter().map(|&frame| f64::from(values(frame)[index]));
        all.filter(|value| value.is_finite()).collect()
    };
    let moment = |known: &[f64], power: i32, mean: f64| {
        let sum: f64 = known.iter().map(|value| (value - mean).powi(power)).sum();
        sum / known.len().max(1) as f64
    };
    let scale = |(index, channel): (usize, &Channel)| {
        let known = known(index);
        let mean = moment(&known, 1, 0.0);
        let std = (moment(&known, 2, mean).sqrt() as f32).max(MIN_CHANNEL_STD);
        scaled(channel, mean as f32, std)
    };
    channels.iter().enumerate().map(scale).collect()
}
