//! The sizes of the dense network.

use super::limits::{MAX_FEATURES, MAX_HIDDEN, in_range};
use crate::nn::error::NnError;
use crate::nn::options::{PredictorOutput, Reconstruction};

/// Sizes and options of the dense network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DenseSpec {
    /// Features of a frame, F.
    pub features: usize,
    /// Hidden units of each LSTM, H.
    pub hidden: usize,
    /// How the context frames are reconstructed.
    pub reconstruction: Reconstruction,
    /// What the predictor gives at each step.
    pub predictor_output: PredictorOutput,
}

impl Default for DenseSpec {
    fn default() -> Self {
        Self {
            features: 128,
            hidden: 256,
            reconstruction: Reconstruction::Sequence,
            predictor_output: PredictorOutput::Residual,
        }
    }
}

impl DenseSpec {
    /// Errors: `OutOfRange` at the first size that is out of range.
    pub(super) fn check(&self) -> Result<(), NnError> {
        in_range("features", self.features as f64, 1.0, MAX_FEATURES as f64)?;
        in_range("hidden", self.hidden as f64, 1.0, MAX_HIDDEN as f64)
    }
}
