//! Why a network refuses a specification, weights or an input.

use super::options::{ArchitectureKind, Conditioning};
use crate::error_kind::{ErrorKind, HasErrorKind};

/// Why the network refused a specification, weights or an input.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NnError {
    /// A number of the specification is out of range.
    #[error("model specification: {field} is {value}; it must be {min} to {max}")]
    OutOfRange {
        /// The field's name.
        field: &'static str,
        /// The value given.
        value: f64,
        /// Smallest accepted value.
        min: f64,
        /// Largest accepted value.
        max: f64,
    },
    /// The conditioning needs channels, but the specification has none.
    #[error("model specification: conditioning \"{conditioning}\" needs at least one {kind} channel; {kind}s is empty")]
    NoChannels {
        /// The conditioning.
        conditioning: Conditioning,
        /// `action` or `state`.
        kind: &'static str,
    },
    /// The mean or standard deviation of a channel is not finite, or the standard deviation is negative.
    #[error(
        "model specification: {kind} channel \"{name}\" has mean {mean} and std {std}; both must be finite and std not negative"
    )]
    ChannelScale {
        /// `action` or `state`.
        kind: &'static str,
        /// The channel's name.
        name: String,
        /// Its mean.
        mean: f32,
        /// Its standard deviation.
        std: f32,
    },
    /// A side of the frames does not suit the flow network.
    #[error(
        "model specification: frames are {width}×{height} px; each side must be a multiple of {min} from {min} to {max}"
    )]
    FrameSides {
        /// Width of a frame in pixels.
        width: u32,
        /// Height of a frame in pixels.
        height: u32,
        /// Smallest side; sides are multiples of it.
        min: u32,
        /// Largest side.
        max: u32,
    },
    /// The recurrent form of the flow network takes no actions.
    #[error(
        "model specification: flow.recurrent is true and the conditioning is \"{conditioning}\"; the recurrent form takes no \
         actions: use \"none\" or \"state\", or flow.recurrent=false"
    )]
    RecurrentActions {
        /// The conditioning.
        conditioning: Conditioning,
    },
    /// Only the depth form finds movers.
    #[error("model specification: flow.movers is true, but flow.depth is false; only the depth form finds movers")]
    MoversDepth,
    /// Only the depth form sees how fast the camera drives.
    #[error("model specification: flow.speeds is true, but flow.depth is false; only the depth form estimates speeds")]
    SpeedsDepth,
    /// A memory of a room lacks something.
    #[error(
        "model specification: flow.memory is true; it needs flow.depth, actions, a camera model, and a state with x, y, heading_cos \
         and heading_sin"
    )]
    Memory,
    /// The sprite network reads frames alone.
    #[error(
        "model specification: the sprite network takes no actions and no state, but the conditioning is \"{conditioning}\"; use \"none\""
    )]
    SpriteConditioning {
        /// The conditioning.
        conditioning: Conditioning,
    },
    /// The sprite network follows motion from frame to frame.
    #[error("model specification: the sprite network needs a context of 2 frames or more")]
    SpriteContext,
    /// Two forms of the flow network at once.
    #[error("model specification: flow.recurrent and flow.depth are both true; a network has one of these forms")]
    RecurrentDepth,
    /// This device cannot be used.
    #[error("device is \"{device}\": {reason}")]
    Device {
        /// The device's name.
        device: String,
        /// Why not, and what can be done.
        reason: String,
    },
    /// Predictions cannot be in this precision.
    #[error("precision is \"{precision}\": {reason}")]
    Precision {
        /// The precision's name.
        precision: String,
        /// Why not, and what can be done.
        reason: String,
    },
    /// No camera has this field of view or tilt.
    #[error("model specification: {0}")]
    Camera(#[source] crate::frame::FrameError),
    /// An input has the wrong shape.
    #[error("{what} has shape {found:?}; this model takes {expected}")]
    Shape {
        /// The input.
        what: &'static str,
        /// The given shape.
        found: Vec<usize>,
        /// The expected shape.
        expected: String,
    },
    /// The model needs a conditioning input that is missing.
    #[error("no {what} given; this model's conditioning is \"{conditioning}\", which takes {expected}")]
    Missing {
        /// `actions` or `state`.
        what: &'static str,
        /// The model's conditioning.
        conditioning: Conditioning,
        /// The expected shape.
        expected: String,
    },
    /// The weights belong to another kind of network.
    #[error("the weights are those of a \"{found}\" network; the model's architecture is \"{expected}\"")]
    OtherArchitecture {
        /// The architecture that the weights belong to.
        found: ArchitectureKind,
        /// The model's architecture.
        expected: ArchitectureKind,
    },
    /// A tensor of the model is missing from the weights.
    #[error("tensor \"{name}\" is missing from the weights; the model needs it with shape {expected:?}")]
    TensorMissing {
        /// The tensor's name.
        name: String,
        /// The expected shape.
        expected: Vec<usize>,
    },
    /// The weights contain a tensor that the model does not have.
    #[error("the weights contain tensor \"{name}\", which this model does not have")]
    TensorUnknown {
        /// The tensor's name.
        name: String,
    },
    /// A tensor of the weights has the wrong shape.
    #[error("tensor \"{name}\" has shape {found:?}; the model needs {expected:?}")]
    TensorShape {
        /// The tensor's name.
        name: String,
        /// The shape in the weights.
        found: Vec<usize>,
        /// The expected shape.
        expected: Vec<usize>,
    },
    /// A tensor of the weights contains NaN or an infinity.
    #[error("tensor \"{name}\" contains a value that is not a finite number")]
    TensorNotFinite {
        /// The tensor's name.
        name: String,
    },
    /// The tensor library failed.
    #[error("tensor computation failed")]
    Tensor(#[source] TensorError),
}

/// What the tensor library said.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct TensorError(Box<dyn std::error::Error + Send + Sync>);

#[doc(hidden)]
impl From<candle_core::Error> for TensorError {
    fn from(error: candle_core::Error) -> Self {
        Self(Box::new(error))
    }
}

#[doc(hidden)]
impl From<candle_core::Error> for NnError {
    fn from(error: candle_core::Error) -> Self {
        Self::Tensor(error.into())
    }
}

impl HasErrorKind for NnError {
    fn kind(&self) -> ErrorKind {
        match self {
            // These come from settings.
            Self::OutOfRange { .. } | Self::NoChannels { .. } | Self::Device { .. } | Self::Precision { .. } => {
                ErrorKind::Usage
            }
            Self::Tensor(_) => ErrorKind::Internal,
            _ => ErrorKind::Unusable,
        }
    }
}

impl NnError {
    /// The error for an input with an unexpected shape.
    pub(in crate::nn) fn shape(what: &'static str, found: &candle_core::Tensor, expected: impl Into<String>) -> Self {
        Self::Shape {
            what,
            found: found.dims().to_vec(),
            expected: expected.into(),
        }
    }
}
