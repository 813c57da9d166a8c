//! Linear layers with an optional activation: the frame codec (paper, "pre-trained layers"), the output layers of the LSTMs,
//! and the layers of the flow network that have no neighbours.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp3, Layout, Shape, Tensor};
use candle_nn::Module;

use super::activation::tanh;
use crate::nn::tensors::{add_columns, matrix, slice, with_values};
use crate::vectorized::vectorized;

/// The activation function of a linear layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::nn) enum Activation {
    /// No activation function.
    None,
    /// tanh.
    Tanh,
}

/// y = activation(x · weight + bias); weight `[D, O]`, bias `[O]`.
#[derive(Clone, Debug)]
pub(in crate::nn) struct Linear {
    pub(in crate::nn) weight: Tensor,
    pub(in crate::nn) bias: Tensor,
    activation: Activation,
}

impl Linear {
    /// A layer of weight `[D, O]` and bias `[O]`.
    pub(in crate::nn) fn new(weight: Tensor, bias: Tensor, activation: Activation) -> Self {
        Self {
            weight,
            bias,
            activation,
        }
    }
}

impl Module for Linear {
    /// The layer's output `[N, O]` for x `[N, D]`, all f32.
    fn forward(&self, x: &Tensor) -> candle_core::Result<Tensor> {
        let fused = FusedLinear {
            activation: self.activation,
            wants_input_gradient: x.track_op(),
        };
        let x = x.contiguous()?;
        if x.track_op() || self.weight.track_op() || self.bias.track_op() {
            x.apply_op3(&self.weight, &self.bias, fused)
        } else {
            x.apply_op3_no_bwd(&self.weight, &self.bias, &fused)
        }
    }
}

/// Sum, bias and activation in one pass. It computes the input's gradient only if it is needed.
struct FusedLinear {
    activation: Activation,
    wants_input_gradient: bool,
}

impl CustomOp3 for FusedLinear {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let ((rows, inputs), (_, outputs)) = (x_layout.shape().dims2()?, weight_layout.shape().dims2()?);
        let mut sums = x.matmul(weight, (1, rows, outputs, inputs), x_layout, weight_layout)?;
        let bias = slice(bias, bias_layout)?;
        if let CpuStorage::F32(sums) = &mut sums {
            vectorized(
                #[inline(always)]
                || {
                    for row in sums.chunks_exact_mut(outputs) {
                        add_columns(row, bias);
                        if self.activation == Activation::Tanh {
                            for value in row {
                                *value = tanh(*value);
                            }
                        }
                    }
                },
            );
        }
        Ok((sums, Shape::from((rows, outputs))))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _bias: &Tensor,
        y: &Tensor,
        gradient: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (x, weight) = (x.detach(), weight.detach());
        let gradient = match self.activation {
            Activation::None => gradient.contiguous()?,
            Activation::Tanh => through_tanh(y, gradient)?,
        };
        let mut sums = vec![0.0; gradient.dim(1)?];
        with_values(&gradient, |gradient| {
            vectorized(
                #[inline(always)]
                || add_columns(&mut sums, gradient),
            );
        })?;
        let for_bias = Tensor::from_vec(sums, gradient.dim(1)?, gradient.device())?;
        let for_weight = x.t()?.matmul(&gradient)?;
        let for_x = self
            .wants_input_gradient
            .then(|| gradient.matmul(&weight.t()?))
            .transpose()?;
        Ok((for_x, Some(for_weight), Some(for_bias)))
    }
}

/// The gradient of y = tanh(sum) for the sum: gradient · (1 − y²).
fn through_tanh(y: &Tensor, gradient: &Tensor) -> candle_core::Result<Tensor> {
    let columns = y.dim(1)?;
    let product = with_values(y, |y| {
        with_values(gradient, |gradient| {
            vectorized(
                #[inline(always)]
                || {
                    y.iter()
                        .zip(gradient)
                        .map(|(y, gradient)| gradient * (1.0 - y * y))
                        .collect()
                },
            )
        })
    })??;
    matrix(product, columns)
}
