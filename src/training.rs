//! From windows to weights: pre-training, fitting, checkpoints.

pub mod optimizer;
