//! Where a network takes its layers from: tensors by name.

use candle_core::Tensor;

use super::error::NnError;
use super::ops::convolution::{ConvShape, Convolution3};
use super::ops::linear::{Activation, Linear};

/// Finds a model's layers among its parameters.
pub(super) trait TensorSource {
    /// The tensor of that name. Errors: `TensorMissing`, `TensorShape`.
    fn tensor(&self, name: &str) -> Result<Tensor, NnError>;

    /// The linear layer of that name.
    fn linear(&self, name: &str, activation: Activation) -> Result<Linear, NnError> {
        let (weight, bias) = (format!("{name}.weight"), format!("{name}.bias"));
        Ok(Linear::new(self.tensor(&weight)?, self.tensor(&bias)?, activation))
    }

    /// The convolution of that name.
    fn convolution(&self, name: &str, shape: ConvShape) -> Result<Convolution3, NnError> {
        let (weight, bias) = (format!("{name}.weight"), format!("{name}.bias"));
        Ok(Convolution3::new(self.tensor(&weight)?, self.tensor(&bias)?, shape))
    }
}
