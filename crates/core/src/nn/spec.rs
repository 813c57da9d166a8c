//! The specification of a model: its dimensions and what its numbers mean, with validation, and the sizes that follow.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};

use super::motion::StateChannels;
use super::sampling::ImageSize;
use super::{FlowLayers, NnError, PredictorOutput};
use crate::frame::preprocess::Preprocess;
use crate::frame::warp::CameraModel;
use crate::types::Channel;

/// Largest width and height of a model's frames, in pixels.
pub const MAX_MODEL_SIDE_PX: u32 = 512;
/// Largest frame period, in seconds; the smallest is [`MIN_FRAME_PERIOD_S`].
pub const MAX_FRAME_PERIOD_S: f64 = 3600.0;
/// Smallest frame period, in seconds.
pub const MIN_FRAME_PERIOD_S: f64 = 1e-4;
/// Largest number of context frames, and of predicted frames.
pub const MAX_STEPS: usize = 256;
/// Largest number of features of a frame.
pub const MAX_FEATURES: usize = 4096;
/// Largest number of hidden units of an LSTM.
pub const MAX_HIDDEN: usize = 4096;
/// Largest number of components of an action, and of a state.
pub const MAX_CHANNELS: usize = 64;
/// Largest standard deviation of the smoothing, in pixels.
pub const MAX_BLUR_SIGMA_PX: f32 = 16.0;
/// Largest number of parameters of a model (1 GiB in f32).
pub const MAX_PARAMETERS: u64 = 1 << 28;
/// Smallest standard deviation used to scale a channel, in the channel's unit. It avoids division by zero for a constant
/// channel.
pub const MIN_CHANNEL_STD: f32 = 1e-3;
/// Standard deviations from the mean beyond which the flow network limits a value.
const MAX_DEVIATIONS: f32 = 1e6;

macro_rules! named_enum {
    ($(#[$doc:meta])* $name:ident, $kind:literal, $known:literal, { $($(#[$vdoc:meta])* $variant:ident = $text:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
        #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
        #[serde(rename_all = "kebab-case")]
        pub enum $name {
            $($(#[$vdoc])* $variant,)+
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(match self { $(Self::$variant => $text,)+ })
            }
        }

        impl FromStr for $name {
            type Err = NnError;

            fn from_str(name: &str) -> Result<Self, NnError> {
                match name {
                    $($text => Ok(Self::$variant),)+
                    _ => Err(NnError::UnknownName { kind: $kind, name: name.to_owned(), known: $known }),
                }
            }
        }
    };
}
pub(super) use named_enum;

named_enum!(
    /// The kind of network.
    Architecture, "architecture", "\"dense\" and \"flow\"", {
        /// The paper's: a dense codec and LSTMs.
        Dense = "dense",
        /// A convolutional network that moves the pixels of the last frame.
        Flow = "flow",
    }
);

impl Architecture {
    /// The architecture that these tensors belong to, if their names show it.
    pub(super) fn of_tensors(tensors: &BTreeMap<String, Tensor>) -> Option<Self> {
        let has = |prefix: &str| tensors.keys().any(|name| name.starts_with(prefix));
        match (has("flow."), has("frame_encoder.")) {
            (true, false) => Some(Self::Flow),
            (false, true) => Some(Self::Dense),
            _ => None,
        }
    }

    /// The architecture of specifications that name none.
    pub fn dense() -> Self {
        Self::Dense
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_dense(architecture: &Architecture) -> bool {
    *architecture == Architecture::Dense
}

named_enum!(
    /// The paper's two approaches to reconstruct the context frames.
    Reconstruction, "reconstruction", "\"sequence\" and \"stepwise\"", {
        /// Encodes the whole sequence, then decodes it (approach 1).
        Sequence = "sequence",
        /// Reconstructs after each frame (approach 2).
        Stepwise = "stepwise",
    }
);

named_enum!(
    /// The inputs of a prediction besides the context frames.
    Conditioning, "conditioning", "\"none\", \"action\", \"state\" and \"state-action\"", {
        /// No further inputs.
        None = "none",
        /// The action that leads to each predicted frame.
        Action = "action",
        /// The state at the last context frame.
        State = "state",
        /// The action that leads to each predicted frame, and the state at the last context frame.
        StateAction = "state-action",
    }
);

/// One component of an action or a state, and how it is scaled for the network: (value − mean) / std.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct ChannelScale {
    /// The component's name, for example `linear`.
    pub name: String,
    /// Its unit, for example `m/s`; empty if it has none.
    pub unit: String,
    /// Mean over the training data, in that unit.
    pub mean: f32,
    /// Standard deviation over the training data, in that unit; at least [`MIN_CHANNEL_STD`] is used.
    pub std: f32,
}

impl ChannelScale {
    /// The value, limited to [`MAX_DEVIATIONS`] standard deviations from the mean.
    pub(super) fn limited(&self, value: f32) -> f32 {
        let most = MAX_DEVIATIONS * self.std.max(MIN_CHANNEL_STD);
        value.clamp(self.mean - most, self.mean + most)
    }

    /// The value scaled for the network: (value − mean) / std.
    #[must_use]
    pub fn scaled(&self, value: f32) -> f32 {
        (value - self.mean) / self.std.max(MIN_CHANNEL_STD)
    }
}

impl fmt::Display for ChannelScale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Channel::new(&self.name, &self.unit).fmt(f)
    }
}

/// All dimensions of a model, and the meaning of its inputs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct ModelSpec {
    /// The kind of network.
    #[serde(default = "Architecture::dense", skip_serializing_if = "is_dense")]
    pub architecture: Architecture,
    /// Width of a frame in pixels.
    pub frame_width_px: u32,
    /// Height of a frame in pixels.
    pub frame_height_px: u32,
    /// Seconds from one frame to the next.
    pub frame_period_s: f64,
    /// How frames are converted to the model's value range.
    pub preprocess: Preprocess,
    /// Number of context frames.
    pub context: usize,
    /// Number of predicted frames.
    pub horizon: usize,
    /// Features of a frame, F; not used by the flow network.
    pub features: usize,
    /// Hidden units of each LSTM, H; not used by the flow network.
    pub hidden: usize,
    /// How the context frames are reconstructed.
    pub reconstruction: Reconstruction,
    /// What the predictor gives at each step; not used by the flow network.
    #[serde(
        default = "PredictorOutput::residual",
        skip_serializing_if = "PredictorOutput::is_residual"
    )]
    pub predictor_output: PredictorOutput,
    /// The inputs of a prediction besides the context frames.
    pub conditioning: Conditioning,
    /// Components of an action in the training data; used only if `conditioning` includes actions.
    pub actions: Vec<ChannelScale>,
    /// Components of a state in the training data; used only if `conditioning` includes the state.
    pub states: Vec<ChannelScale>,
    /// Layer sizes of the flow network; absent for the dense network.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flow: Option<FlowLayers>,
    /// The camera model, if it is known. Only the flow network uses it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraModel>,
}

impl Default for ModelSpec {
    fn default() -> Self {
        Self {
            architecture: Architecture::Dense,
            frame_width_px: 64,
            frame_height_px: 64,
            frame_period_s: 0.2,
            preprocess: Preprocess::default(),
            context: 5,
            horizon: 5,
            features: 128,
            hidden: 256,
            reconstruction: Reconstruction::Sequence,
            predictor_output: PredictorOutput::Residual,
            conditioning: Conditioning::None,
            actions: Vec::new(),
            states: Vec::new(),
            flow: None,
            camera: None,
        }
    }
}

impl ModelSpec {
    /// Checks the range of every field. Errors: `OutOfRange`, `NoChannels`, `ChannelScale`, `Camera`, `RecurrentActions`,
    /// `FrameSides`.
    pub fn validate(&self) -> Result<(), NnError> {
        let side = f64::from(MAX_MODEL_SIDE_PX);
        in_range("frame_width_px", f64::from(self.frame_width_px), 1.0, side)?;
        in_range("frame_height_px", f64::from(self.frame_height_px), 1.0, side)?;
        in_range(
            "frame_period_s",
            self.frame_period_s,
            MIN_FRAME_PERIOD_S,
            MAX_FRAME_PERIOD_S,
        )?;
        let sigma = f64::from(self.preprocess.blur_sigma_px);
        in_range("preprocess.blur_sigma_px", sigma, 0.0, f64::from(MAX_BLUR_SIGMA_PX))?;
        in_range("context", self.context as f64, 1.0, MAX_STEPS as f64)?;
        in_range("horizon", self.horizon as f64, 1.0, MAX_STEPS as f64)?;
        in_range("features", self.features as f64, 1.0, MAX_FEATURES as f64)?;
        in_range("hidden", self.hidden as f64, 1.0, MAX_HIDDEN as f64)?;
        in_range("number of actions", self.actions.len() as f64, 0.0, MAX_CHANNELS as f64)?;
        in_range("number of states", self.states.len() as f64, 0.0, MAX_CHANNELS as f64)?;
        self.check_channels()?;
        if let Some(camera) = &self.camera {
            camera.validate().map_err(NnError::Camera)?;
        }
        if self.architecture == Architecture::Flow {
            self.flow_layers().validate(self)?;
        }
        in_range(
            "number of parameters",
            self.parameter_count() as f64,
            1.0,
            MAX_PARAMETERS as f64,
        )
    }

    fn check_channels(&self) -> Result<(), NnError> {
        let used = [
            ("action", &self.actions, self.action_inputs()),
            ("state", &self.states, self.state_inputs()),
        ];
        for (kind, channels, inputs) in used {
            if inputs == Some(0) {
                return Err(NnError::NoChannels {
                    conditioning: self.conditioning,
                    kind,
                });
            }
            if let Some(channel) = channels
                .iter()
                .find(|channel| !channel.mean.is_finite() || !channel.std.is_finite() || channel.std < 0.0)
            {
                return Err(NnError::ChannelScale {
                    kind,
                    name: channel.name.clone(),
                    mean: channel.mean,
                    std: channel.std,
                });
            }
        }
        Ok(())
    }

    /// Pixels of a frame, P.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.frame_width_px as usize * self.frame_height_px as usize
    }

    /// Number of values that the model keeps of each frame: the features for the dense network, the pixels for the flow
    /// network.
    #[must_use]
    pub fn code_len(&self) -> usize {
        match self.architecture {
            Architecture::Dense => self.features,
            Architecture::Flow => self.pixels(),
        }
    }

    /// Layer sizes of the flow network; the defaults if none are given.
    #[must_use]
    pub fn flow_layers(&self) -> FlowLayers {
        self.flow.unwrap_or_default()
    }

    /// Height and width of a frame.
    pub(super) fn image_size(&self) -> ImageSize {
        ImageSize {
            height: self.frame_height_px as usize,
            width: self.frame_width_px as usize,
        }
    }

    /// How the camera moved from the state `[B, S]` to each of the later states `[B, T, S]`: yaw, ahead and left
    /// `[B, T, 3]`, in radians and metres. `None` if the model gets no state or the state has no pose.
    pub fn measured_motion(&self, state: &Tensor, later: &Tensor) -> Result<Option<Tensor>, NnError> {
        let channels = StateChannels::of(self);
        if channels.pose.is_none() {
            return Ok(None);
        }
        let (batch, time, count) = later.dims3()?;
        let (now, later) = (
            state.flatten_all()?.to_vec1::<f32>()?,
            later.flatten_all()?.to_vec1::<f32>()?,
        );
        let windows = now.chunks_exact(count).zip(later.chunks_exact(time * count));
        let motions: Vec<f32> = windows
            .flat_map(|(now, later)| {
                let now = channels.pose_in(now);
                later
                    .chunks_exact(count)
                    .flat_map(move |later| now.motion_to(channels.pose_in(later)))
            })
            .collect();
        Ok(Some(Tensor::from_vec(motions, (batch, time, 3), &Device::Cpu)?))
    }

    /// The state scaled for the network.
    pub(super) fn scaled_state(&self, state: &[f32]) -> Vec<f32> {
        state
            .iter()
            .zip(&self.states)
            .map(|(value, channel)| channel.scaled(*value))
            .collect()
    }

    /// Number of action components that the predictor gets; `None` if the conditioning does not include actions.
    #[must_use]
    pub fn action_inputs(&self) -> Option<usize> {
        matches!(self.conditioning, Conditioning::Action | Conditioning::StateAction).then_some(self.actions.len())
    }

    /// Number of state components that the predictor gets; `None` if the conditioning does not include the state.
    #[must_use]
    pub fn state_inputs(&self) -> Option<usize> {
        matches!(self.conditioning, Conditioning::State | Conditioning::StateAction).then_some(self.states.len())
    }

    /// Inputs of the predictor's LSTM: features, then the action, then the state.
    #[must_use]
    pub fn predictor_inputs(&self) -> usize {
        self.features + self.action_inputs().unwrap_or(0) + self.state_inputs().unwrap_or(0)
    }

    /// Inputs of the reconstructor's LSTM: its own previous output (approach 1), or the encoder's output (approach 2).
    #[must_use]
    pub fn reconstructor_inputs(&self) -> usize {
        match self.reconstruction {
            Reconstruction::Sequence => self.features,
            Reconstruction::Stepwise => self.hidden,
        }
    }

    /// Name and shape of every trained tensor. Gate order in `w_x`, `w_h` and `bias` is i, f, c, o.
    #[must_use]
    pub fn tensor_shapes(&self) -> BTreeMap<String, Vec<usize>> {
        if self.architecture == Architecture::Flow {
            return self.flow_layers().tensor_shapes(self);
        }
        let (pixels, features, hidden) = (self.pixels(), self.features, self.hidden);
        let mut shapes = BTreeMap::new();
        let mut dense = |name: &str, inputs: usize, outputs: usize| {
            shapes.insert(format!("{name}.weight"), vec![inputs, outputs]);
            shapes.insert(format!("{name}.bias"), vec![outputs]);
        };
        dense("frame_encoder", pixels, features);
        dense("frame_decoder", features, pixels);
        dense("predictor.output", hidden, features);
        dense("reconstructor.output", hidden, features);
        let lstms = [
            ("encoder", features),
            ("predictor", self.predictor_inputs()),
            ("reconstructor", self.reconstructor_inputs()),
        ];
        for (name, inputs) in lstms {
            shapes.insert(format!("{name}.w_x"), vec![inputs, 4 * hidden]);
            shapes.insert(format!("{name}.w_h"), vec![hidden, 4 * hidden]);
            shapes.insert(format!("{name}.bias"), vec![4 * hidden]);
            for gate in ["i", "f", "o"] {
                shapes.insert(format!("{name}.peephole_{gate}"), vec![hidden]);
            }
        }
        shapes
    }

    /// Number of parameters, including the reconstructor's.
    #[must_use]
    pub fn parameter_count(&self) -> u64 {
        self.tensor_shapes()
            .values()
            .map(|shape| shape.iter().map(|&size| size as u64).product::<u64>())
            .sum()
    }

    /// Multiply–add operations with weights per predicted frame, rounded up. Biases and the products inside the gates are
    /// not counted. The cost of encoding the context is divided by the horizon:
    ///
    /// `(context · (P·F + L(F)) + horizon · (L(F+A+S) + H·F + F·P)) / horizon`, `L(D) = 4H·(D + H) + 3H`.
    ///
    /// A session keeps the features of earlier frames, so it computes less. The reconstructor is not used in a prediction.
    /// For the flow network, the products of all layers with their weights are counted.
    #[must_use]
    pub fn multiply_adds_per_frame(&self) -> u64 {
        if self.architecture == Architecture::Flow {
            return self.flow_layers().multiply_adds_per_frame(self);
        }
        let (context, horizon) = (self.context as u64, self.horizon.max(1) as u64);
        let (pixels, features, hidden) = (self.pixels() as u64, self.features as u64, self.hidden as u64);
        let lstm = |inputs: u64| 4 * hidden * (inputs + hidden) + 3 * hidden;
        let encoding = context * (pixels * features + lstm(features));
        let prediction = lstm(self.predictor_inputs() as u64) + hidden * features + features * pixels;
        encoding.div_ceil(horizon) + prediction
    }
}

/// Errors: `OutOfRange` if the value is NaN or not in the range.
pub(super) fn in_range(field: &'static str, value: f64, min: f64, max: f64) -> Result<(), NnError> {
    if (min..=max).contains(&value) {
        return Ok(());
    }
    Err(NnError::OutOfRange { field, value, min, max })
}
