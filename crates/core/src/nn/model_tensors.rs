//! Where a network takes its layers from: tensors by name.

use std::collections::BTreeMap;

use candle_core::Tensor;

use super::ops::convolution::Convolution3;
use super::ops::image_geometry::ConvShape;
use super::ops::linear::Linear;

/// A model's tensors by name, each of the shape that the specification gives.
pub(super) struct ModelTensors {
    pub(super) tensors: BTreeMap<String, Tensor>,
    /// Whether the network computes in plain tensor operations on the CPU too.
    pub(super) always_plain: bool,
}

impl ModelTensors {
    /// Whether the network computes in plain tensor operations.
    pub(super) fn are_plain(&self) -> bool {
        self.always_plain || self.tensors.values().any(|tensor| !tensor.device().is_cpu())
    }

    /// The tensor of that name.
    #[expect(clippy::expect_used, reason = "the specification names every tensor of the model")]
    pub(super) fn tensor(&self, name: &str) -> Tensor {
        let tensor = self.tensors.get(name).cloned();
        tensor.expect("a tensor that tensor_shapes() does not list is a bug")
    }

    /// The linear layer of that name.
    pub(super) fn linear(&self, name: &str) -> Linear {
        Linear {
            weight: self.tensor(&format!("{name}.weight")),
            bias: self.tensor(&format!("{name}.bias")),
            has_tanh: false,
            packed: None,
        }
    }

    /// The convolution of that name.
    pub(super) fn convolution(&self, name: &str, shape: ConvShape) -> Convolution3 {
        Convolution3 {
            weight: self.tensor(&format!("{name}.weight")),
            bias: self.tensor(&format!("{name}.bias")),
            shape,
            packed: None,
        }
    }
}
