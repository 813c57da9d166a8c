//! The networks, written with candle.
//!
//! Symbols in shapes: B windows of a batch, N frames, T time steps, P pixels of a frame, F features of a frame, D inputs of
//! a layer, H hidden units of an LSTM, A components of an action, S components of a state. All tensors are f32 and row-major.
//! Inputs and parameters are on the CPU. Frames are in the model's value range ([`crate::frame::preprocess`]).
//!
//! There are three architectures: the paper's in [`dense`] (a codec of single frames, a peephole LSTM that encodes the context,
//! one LSTM decoder that predicts the next frames and one that reconstructs the context), [`flow`], which moves the
//! pixels of the last frame, and [`sprites`], which moves two pictures as wholes. None uses another. [`network`] is the type that the rest of the
//! program uses for all.
//!
//! On the CPU, a network computes in fused operations (`ops`). In `plain` and in the folders of that name inside [`dense`] and [`flow`],
//! the same networks are written in candle's own tensor operations: short to read, and the path of graphics cards ([`device`]). The sprite network
//! always computes on the CPU.
//! `plain_agreement` tests that both give the same predictions and gradients.
//!
//! The modules in reading order; each uses only those above it: `options` (enumerations) → [`error`] → [`device`], [`precision`] →
//! [`tensors`] → `recycled` (buffers that serve again) → `fused` (what an operation with a gradient of its own is) → `ops` (such operations) → `plain` → [`loss`], [`ssim_loss`], [`mask_loss`] →
//! [`spec`] (sizes and meaning of a model) → `model_tensors`, `conditioning` (actions and state) → `geometry` (cameras and wheels) → [`dense`], [`flow`], [`sprites`] → `model_size` (tensors and cost) → `init`, [`parameters`] →
//! [`network`]. [`costs`] compares the model's cost with other networks.

mod conditioning;
pub mod costs;
pub mod dense;
pub mod device;
pub mod error;
pub mod flow;
mod fused;
mod geometry;
#[cfg(test)]
pub mod gradient_check;
mod init;
pub mod loss;
pub mod mask_loss;
mod model_size;
mod model_tensors;
pub mod network;
mod ops;
mod options;
pub mod parameters;
mod plain;
#[cfg(test)]
mod plain_agreement;
pub mod precision;
mod recycled;
pub mod spec;
pub mod sprites;
pub mod ssim_loss;
pub mod tensors;

pub use conditioning::ConditioningTensors;
pub use dense::Feedback;
pub use error::{NnError, TensorError};
pub use flow::{FlowPrediction, Occupancy};
#[doc(hidden)]
pub use geometry::state_channels::POSE_CHANNELS;
pub use loss::Loss;
pub use network::Network;
pub use options::{ArchitectureKind, Conditioning, PredictorOutput, Reconstruction, UnknownName};
pub use parameters::Parameters;
pub use spec::{Architecture, ChannelScale, DenseSpec, FlowLayers, FlowSpec, ModelSpec, SpriteSpec};
