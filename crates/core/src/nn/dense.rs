//! The dense network, the paper's: a codec of single frames, an LSTM that encodes the context, and two LSTM decoders.
//!
//! Reading order: `lstm_cell` (weights and state) → `gates` (equations 1–5) → `recurrence` (all steps as one operation) →
//! `lstm` (sequences) → `autoencoder` (the network). `layers` lists its tensors; `packed_rollouts` predicts with packed weights;
//! `plain` has the same in candle's own tensor operations.

mod autoencoder;
mod gates;
mod layer_form;
mod layers;
mod lstm;
mod lstm_cell;
mod packed_rollouts;
mod plain;
mod recurrence;

pub(super) use autoencoder::DenseNetwork;
pub use autoencoder::Feedback;
pub(super) use layers::{multiply_adds_per_frame, tensor_shapes};
pub use lstm::unroll;
pub use lstm_cell::{LstmState, PeepholeCell};
