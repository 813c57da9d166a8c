//! The network of the paper on candle: a dense codec of single frames, a peephole LSTM that encodes what has been seen,
//! and two LSTM decoders, one that predicts the frames to come and one that reconstructs those seen.
//!
//! Legend of shapes: B windows of a batch, N frames, T time, P pixels of a frame, F features of a frame, D inputs of a
//! layer, H hidden units of an LSTM, A components of an action, S components of a state. All tensors are f32, row-major,
//! on the CPU. Frames are in the model's space ([`crate::frame::preprocess`]).
//!
//! Reading order: [`spec`] (sizes) → [`parameters`] and [`init`] (weights) → [`dense`] → [`lstm_cell`] (equations 1–5)
//! → [`lstm`] (over time; `recurrence` and `gates` are its
//! fast f32 form) → [`conditioned`] (actions and state) → [`autoencoder`] (the dense network) → [`loss`]; [`costs`] compares with other networks.
//!
//! The second architecture is [`flow`]: `conv`, `modulation`, `sampling` and `compose` are its operations, `rays` and `room`
//! its geometry, `motion` and `scene` what it knows of the camera and the surroundings. [`model`] is the type that the rest
//! of the program uses for both.

mod activation;
mod compose;
pub mod autoencoder;
pub mod conditioned;
mod conv;
pub mod costs;
pub mod dense;
pub mod flow;
mod flow_inputs;
pub mod flow_spec;
mod gates;
#[cfg(test)]
mod gradient_check;
pub mod init;
pub mod loss;
pub mod lstm;
pub mod lstm_cell;
pub mod model;
mod modulation;
mod motion;
pub mod parameters;
mod rays;
mod recurrence;
mod room;
mod sampling;
mod scene;
pub mod spec;
pub(crate) mod tensors;

pub use autoencoder::Feedback;
pub use conditioned::ConditioningTensors;
pub use flow::FlowPrediction;
pub use flow_spec::FlowLayers;
pub use loss::Loss;
pub use model::Model;
pub use parameters::Parameters;
pub use spec::{Architecture, ChannelScale, Conditioning, ModelSpec, Reconstruction};

/// Why the network refused a specification, weights or an input.
#[derive(Debug, thiserror::Error)]
pub enum NnError {
    /// A number of the specification is outside its bounds.
    #[error("model specification: {field} is {value}; it must be {min} to {max}")]
    OutOfRange {
        /// The field's name.
        field: &'static str,
        /// The value given.
        value: f64,
        /// Least value accepted.
        min: f64,
        /// Greatest value accepted.
        max: f64,
    },
    /// The conditioning needs channels that the specification doesn't describe.
    #[error("model specification: conditioning \"{conditioning}\" needs at least one {kind} channel; {kind}s is empty")]
    NoChannels {
        /// The conditioning.
        conditioning: Conditioning,
        /// `action` or `state`.
        kind: &'static str,
    },
    /// A channel's scale is not a finite number, or negative.
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
        "model specification: frames are {width}×{height} px; each side must be a multiple of {least} from {least} to {most}"
    )]
    FrameSides {
        /// Width of a frame in pixels.
        width: u32,
        /// Height of a frame in pixels.
        height: u32,
        /// Least side, and what sides are multiples of.
        least: u32,
        /// Greatest side.
        most: u32,
    },
    /// The camera model is impossible.
    #[error("model specification: {0}")]
    Camera(#[source] crate::frame::FrameError),
    /// A name of an enumeration is unknown.
    #[error("unknown {kind} \"{name}\"; there are {known}")]
    UnknownName {
        /// What was named.
        kind: &'static str,
        /// The name given.
        name: String,
        /// The names there are.
        known: &'static str,
    },
    /// An input has the wrong shape.
    #[error("{what} has shape {found:?}; this model takes {expected}")]
    Shape {
        /// The input.
        what: &'static str,
        /// The shape given.
        found: Vec<usize>,
        /// The shape needed.
        expected: String,
    },
    /// The model is conditioned on something that wasn't given.
    #[error("no {what} given; this model's conditioning is \"{conditioning}\", which takes {expected}")]
    Missing {
        /// `actions` or `state`.
        what: &'static str,
        /// The model's conditioning.
        conditioning: Conditioning,
        /// The shape needed.
        expected: String,
    },
    /// The weights are another network's.
    #[error("the weights are those of a \"{found}\" network; the model's architecture is \"{expected}\"")]
    OtherArchitecture {
        /// The network that the weights belong to.
        found: Architecture,
        /// The model's.
        expected: Architecture,
    },
    /// A weight is absent.
    #[error("tensor \"{name}\" is missing from the weights; the model needs it with shape {expected:?}")]
    TensorMissing {
        /// The tensor's name.
        name: String,
        /// The shape needed.
        expected: Vec<usize>,
    },
    /// A weight is not part of the model.
    #[error("the weights hold tensor \"{name}\", which this model doesn't have")]
    TensorUnknown {
        /// The tensor's name.
        name: String,
    },
    /// A weight has the wrong shape.
    #[error("tensor \"{name}\" has shape {found:?}; the model needs {expected:?}")]
    TensorShape {
        /// The tensor's name.
        name: String,
        /// The shape found.
        found: Vec<usize>,
        /// The shape needed.
        expected: Vec<usize>,
    },
    /// A weight holds NaN or an infinity.
    #[error("tensor \"{name}\" holds a value that is not a finite number")]
    TensorNotFinite {
        /// The tensor's name.
        name: String,
    },
    /// The tensor library failed.
    #[error("tensor computation failed")]
    Tensor(#[from] candle_core::Error),
}

impl NnError {
    /// An input's shape against what was needed.
    fn shape(what: &'static str, found: &candle_core::Tensor, expected: impl Into<String>) -> Self {
        Self::Shape {
            what,
            found: found.dims().to_vec(),
            expected: expected.into(),
        }
    }
}
