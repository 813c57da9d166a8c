//! The dense layers: the frame codec (paper, "pre-trained layers") and the LSTMs' outputs.

use candle_core::Tensor;

use super::NnError;

/// What follows a dense layer's sum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    Linear,
    /// tanh.
    Tanh,
}

/// y = activation(x · weight + bias); weight [D, O], bias [O].
#[derive(Clone, Debug)]
pub struct Dense {
    weight: Tensor,
    bias: Tensor,
    activation: Activation,
}

impl Dense {
    pub(super) fn new(weight: Tensor, bias: Tensor, activation: Activation) -> Self {
        Self {
            weight,
            bias,
            activation,
        }
    }

    /// The layer's output [N, O] for x [N, D].
    pub fn forward(&self, x: &Tensor) -> Result<Tensor, NnError> {
        let sum = x.matmul(&self.weight)?.broadcast_add(&self.bias)?;
        Ok(match self.activation {
            Activation::Linear => sum,
            Activation::Tanh => sum.tanh()?,
        })
    }
}
