//! What is common to all models, and which network a model is.

use super::channels::ChannelScale;
use super::dense::DenseSpec;
use super::flow::FlowSpec;
use super::limits::{
    MAX_BLUR_SIGMA_PX, MAX_CHANNELS, MAX_FRAME_PERIOD_S, MAX_MODEL_SIDE_PX, MAX_STEPS, MIN_FRAME_PERIOD_S, in_range,
};
use super::sprites::SpriteSpec;
use crate::frame::preprocess::Preprocess;
use crate::nn::error::NnError;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::options::{ArchitectureKind, Conditioning};

/// The network of a model, with its sizes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Architecture {
    /// The paper's: a dense codec and LSTMs.
    Dense(DenseSpec),
    /// A convolutional network that moves the pixels of the last frame.
    Flow(FlowSpec),
    /// A network that moves two pictures, each as a whole.
    Sprites(SpriteSpec),
}

impl Architecture {
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

/// All dimensions of a model, and the meaning of its inputs.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelSpec {
    /// The network.
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
    /// The inputs of a prediction besides the context frames.
    pub conditioning: Conditioning,
    /// Components of an action in the training data; used only if `conditioning` includes actions.
    pub actions: Vec<ChannelScale>,
    /// Components of a state in the training data; used only if `conditioning` includes the state.
    pub states: Vec<ChannelScale>,
}

impl Default for ModelSpec {
    fn default() -> Self {
        Self {
            architecture: Architecture::Dense(DenseSpec::default()),
            frame_width_px: 64,
            frame_height_px: 64,
            frame_period_s: 0.2,
            preprocess: Preprocess::default(),
            context: 5,
            horizon: 5,
            conditioning: Conditioning::None,
            actions: Vec::new(),
            states: Vec::new(),
        }
    }
}

impl ModelSpec {
    /// The sizes of the dense network; `None` for another architecture.
    #[must_use]
    pub fn dense(&self) -> Option<&DenseSpec> {
        match &self.architecture {
            Architecture::Dense(dense) => Some(dense),
            Architecture::Flow(_) | Architecture::Sprites(_) => None,
        }
    }

    /// The sizes of the flow network; `None` for another architecture.
    #[must_use]
    pub fn flow(&self) -> Option<&FlowSpec> {
        match &self.architecture {
            Architecture::Flow(flow) => Some(flow),
            Architecture::Dense(_) | Architecture::Sprites(_) => None,
        }
    }

    /// The sizes of the sprite network; `None` for another architecture.
    #[must_use]
    pub fn sprites(&self) -> Option<&SpriteSpec> {
        match &self.architecture {
            Architecture::Sprites(sprites) => Some(sprites),
            Architecture::Dense(_) | Architecture::Flow(_) => None,
        }
    }

    /// Pixels of a frame, P.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.frame_width_px as usize * self.frame_height_px as usize
    }

    /// Number of values that the model keeps of each frame: the features for the dense network, the pixels for the other
    /// networks.
    #[must_use]
    pub fn code_len(&self) -> usize {
        match &self.architecture {
            Architecture::Dense(dense) => dense.features,
            Architecture::Flow(_) | Architecture::Sprites(_) => self.pixels(),
        }
    }

    /// Whether the code of a frame is the frame itself, in the model's value range.
    #[must_use]
    pub fn keeps_frames(&self) -> bool {
        !matches!(self.architecture, Architecture::Dense(_))
    }

    /// Height and width of a frame.
    pub(in crate::nn) fn image_size(&self) -> ImageSize {
        ImageSize {
            height: self.frame_height_px as usize,
            width: self.frame_width_px as usize,
        }
    }

    /// The state scaled for the network.
    pub(in crate::nn) fn scaled_state(&self, state: &[f32]) -> Vec<f32> {
        state
            .iter()
            .zip(&self.states)
            .map(|(value, channel)| channel.scaled(*value))
            .collect()
    }

    /// Number of action components that the predictor gets; `None` if the conditioning does not include actions.
    #[must_use]
    pub fn action_inputs(&self) -> Option<usize> {
        self.conditioning.has_actions().then_some(self.actions.len())
    }

    /// Number of state components that the predictor gets; `None` if the conditioning does not include the state.
    #[must_use]
    pub fn state_inputs(&self) -> Option<usize> {
        self.conditioning.has_state().then_some(self.states.len())
    }

    /// Components of actions and states that the predictor gets.
    pub(in crate::nn) fn conditioning_inputs(&self) -> usize {
        self.action_inputs().unwrap_or(0) + self.state_inputs().unwrap_or(0)
    }

    /// Checks the range of every field. Errors: `OutOfRange`, `NoChannels`, `ChannelScale`, `Camera`, `RecurrentActions`,
    /// `FrameSides`.
    pub(in crate::nn) fn check_fields(&self) -> Result<(), NnError> {
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
        if let Architecture::Dense(dense) = &self.architecture {
            dense.check()?;
        }
        in_range("number of actions", self.actions.len() as f64, 0.0, MAX_CHANNELS as f64)?;
        in_range("number of states", self.states.len() as f64, 0.0, MAX_CHANNELS as f64)?;
        self.check_channels()?;
        match &self.architecture {
            Architecture::Dense(_) => Ok(()),
            Architecture::Flow(flow) => {
                flow.check(self.conditioning, [self.frame_width_px, self.frame_height_px])?;
                if flow.layers.memory && !self.can_remember_a_room() {
                    return Err(NnError::Memory);
                }
                Ok(())
            }
            Architecture::Sprites(sprites) => {
                let sides = [self.frame_width_px, self.frame_height_px];
                sprites.check(self.conditioning, self.context, sides)
            }
        }
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
}
