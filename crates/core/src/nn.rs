//! The network of the paper, written with candle: a dense codec for single frames, a peephole LSTM that encodes the context,
//! and two LSTM decoders. One decoder predicts the next frames, the other reconstructs the context.
//!
//! Symbols in shapes: B windows of a batch, N frames, T time steps, P pixels of a frame, F features of a frame, D inputs of
//! a layer, H hidden units of an LSTM, A components of an action, S components of a state. All tensors are f32, row-major,
//! on the CPU. Frames are in the model's value range ([`crate::frame::preprocess`]).
//!
//! Reading order: [`spec`] (sizes) → [`parameters`] and [`init`] (weights) → [`dense`] → [`lstm_cell`] (equations 1–5)
//! → [`lstm`] (sequences; `recurrence` and `gates` are its fast f32 implementation) → [`conditioned`] (actions and state)
//! → [`autoencoder`] (the dense network) → [`loss`]. [`costs`] compares the model's cost with other networks.
//!
//! The second architecture is [`flow`]: `conv`, `pixel_shuffle`, `modulation`, `sampling` and `compose` are its operations,
//! `rays` and `room` its geometry, `motion` and `scene` compute the camera's motion and the look of the surroundings.
//! [`model`] is the type that the rest of the program uses for both architectures.

mod activation;
pub mod autoencoder;
mod compose;
pub mod conditioned;
mod conv;
pub mod costs;
pub mod dense;
mod drive;
pub mod flow;
mod flow_inputs;
pub mod flow_spec;
mod gates;
#[cfg(test)]
pub mod gradient_check;
pub mod init;
mod long_futures;
pub mod loss;
pub mod lstm;
pub mod lstm_cell;
pub mod model;
mod modulation;
mod motion;
pub mod parameters;
mod pixel_shuffle;
mod predictor_output;
mod rays;
mod recurrence;
mod room;
mod sampling;
mod scene;
pub mod spec;
pub mod ssim_loss;
pub mod tensors;

use crate::error_kind::{ErrorKind, HasErrorKind};

pub use autoencoder::Feedback;
pub use conditioned::ConditioningTensors;
pub use flow::FlowPrediction;
pub use flow_spec::FlowLayers;
pub use loss::Loss;
pub use model::Model;
pub use parameters::Parameters;
pub use predictor_output::PredictorOutput;
pub use spec::{Architecture, ChannelScale, Conditioning, ModelSpec, Reconstruction};

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
    /// No camera has this field of view or tilt.
    #[error("model specification: {0}")]
    Camera(#[source] crate::frame::FrameError),
    /// The name of an enumeration value is unknown.
    #[error("unknown {kind} \"{name}\"; there are {known}")]
    UnknownName {
        /// The enumeration.
        kind: &'static str,
        /// The name given.
        name: String,
        /// The known names.
        known: &'static str,
    },
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
        found: Architecture,
        /// The model's architecture.
        expected: Architecture,
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
    Tensor(#[from] candle_core::Error),
}

impl HasErrorKind for NnError {
    fn kind(&self) -> ErrorKind {
        match self {
            // A training takes these from its settings.
            Self::OutOfRange { .. } | Self::NoChannels { .. } => ErrorKind::Usage,
            Self::ChannelScale { .. }
            | Self::FrameSides { .. }
            | Self::RecurrentActions { .. }
            | Self::Camera(_)
            | Self::UnknownName { .. }
            | Self::Shape { .. }
            | Self::Missing { .. }
            | Self::OtherArchitecture { .. }
            | Self::TensorMissing { .. }
            | Self::TensorUnknown { .. }
            | Self::TensorShape { .. }
            | Self::TensorNotFinite { .. } => ErrorKind::Unusable,
            Self::Tensor(_) => ErrorKind::Internal,
        }
    }
}

impl NnError {
    /// The error for an input with an unexpected shape.
    fn shape(what: &'static str, found: &candle_core::Tensor, expected: impl Into<String>) -> Self {
        Self::Shape {
            what,
            found: found.dims().to_vec(),
            expected: expected.into(),
        }
    }
}
