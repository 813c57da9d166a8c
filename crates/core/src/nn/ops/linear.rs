//! Linear layers with an optional activation: the frame codec (paper, "pre-trained layers"), the output layers of the LSTMs,
//! and the layers of the flow network that have no neighbours.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use std::sync::Arc;

use candle_core::{CpuStorage, Layout, Result, Shape, Tensor};
use candle_nn::Module;

use super::activation::tanh;
use super::row_weights::RowWeights;
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::nn::precision::Precision;
use crate::nn::recycled::buffer;
use crate::nn::tensors::{add_columns, product, slice, sum_columns, with_values};
use crate::vectorized::vectorized;

/// y = x · weight + bias, or its tanh; weight `[D, O]`, bias `[O]`.
#[derive(Clone, Debug)]
pub(in crate::nn) struct Linear {
    pub(in crate::nn) weight: Tensor,
    pub(in crate::nn) bias: Tensor,
    pub(in crate::nn) has_tanh: bool,
    /// For prediction, which then does not use the tensors.
    pub(in crate::nn) packed: Option<Arc<RowWeights>>,
}

impl Linear {
    /// Packs the weights as they are now.
    pub(in crate::nn) fn pack(&mut self, precision: Precision) -> Result<()> {
        self.packed = Some(RowWeights::of(&self.weight, &self.bias, precision)?);
        Ok(())
    }
}

impl Module for Linear {
    /// The layer's output `[N, O]` for x `[N, D]`, all f32.
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        if let Some(packed) = &self.packed {
            let rows = x.dims2()?.0;
            let mut out = with_values(x, |x| packed.times(x, rows))?;
            if self.has_tanh {
                tanh_all(&mut out);
            }
            return Tensor::from_vec(out, (rows, packed.outputs()), x.device());
        }
        let has_tanh = self.has_tanh;
        apply(FusedLinear { has_tanh }, [x, &self.weight, &self.bias])
    }
}

/// The tanh of each value, in place.
fn tanh_all(values: &mut [f32]) {
    vectorized(
        #[inline(always)]
        || {
            for value in values {
                *value = tanh(*value);
            }
        },
    );
}

/// The layer at each place of a grid `[M, h, w, D]`.
pub(in crate::nn) fn per_place(layer: &Linear, x: &Tensor) -> Result<Tensor> {
    let (items, height, width, inputs) = x.dims4()?;
    if let Some(packed) = layer.packed.as_ref().filter(|_| !layer.has_tanh) {
        let (places, outputs) = (height * width, packed.outputs());
        let mut out = buffer(items * places * outputs);
        with_values(x, |x| {
            let items = x
                .chunks_exact(places * inputs)
                .zip(out.chunks_exact_mut(places * outputs));
            items.for_each(|(x, out)| packed.multiply_alike(x, out));
        })?;
        return Tensor::from_vec(out, (items, height, width, outputs), x.device());
    }
    layer.forward(&x.flatten(0, 2)?)?.reshape((items, height, width, ()))
}

/// Sum, bias and activation in one pass. It computes the input's gradient only if it is needed.
struct FusedLinear {
    has_tanh: bool,
}

impl FusedOperation<3> for FusedLinear {
    const NAME: &'static str = "linear";

    fn forward(&self, [x, weight, bias]: [Operand; 3]) -> Result<(Vec<f32>, Shape)> {
        let mut sums = product((x.storage, x.layout), (weight.storage, weight.layout))?;
        let (_, outputs) = weight.layout.shape().dims2()?;
        vectorized(
            #[inline(always)]
            || {
                for row in sums.chunks_exact_mut(outputs) {
                    add_columns(row, bias.values);
                    if self.has_tanh {
                        for value in row {
                            *value = tanh(*value);
                        }
                    }
                }
            },
        );
        let rows = sums.len() / outputs;
        Ok((sums, Shape::from((rows, outputs))))
    }

    fn backward(
        &self,
        [x, weight, bias]: [Operand; 3],
        output: Operand,
        gradient: Operand,
    ) -> Result<[Option<Vec<f32>>; 3]> {
        let (through_tanh, contiguous);
        let for_sums = if self.has_tanh {
            through_tanh = CpuStorage::F32(gradient_through_tanh(output.values, gradient.values));
            contiguous = Layout::contiguous(gradient.layout.shape());
            (&through_tanh, &contiguous)
        } else {
            (gradient.storage, gradient.layout)
        };
        let mut for_bias = vec![0.0; bias.values.len()];
        let values = slice(for_sums.0, for_sums.1)?;
        sum_columns(&mut for_bias, values);
        let for_weight = product((x.storage, &x.layout.transpose(0, 1)?), for_sums)?;
        let for_x = x
            .is_tracked
            .then(|| product(for_sums, (weight.storage, &weight.layout.transpose(0, 1)?)))
            .transpose()?;
        Ok([for_x, Some(for_weight), Some(for_bias)])
    }
}

/// The gradient of y = tanh(sum) for the sum: gradient · (1 − y²).
fn gradient_through_tanh(y: &[f32], gradient: &[f32]) -> Vec<f32> {
    vectorized(
        #[inline(always)]
        || {
            let pairs = y.iter().zip(gradient);
            pairs.map(|(y, gradient)| gradient * (1.0 - y * y)).collect()
        },
    )
}
