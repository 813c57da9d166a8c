//! Feature-wise modulation (`FiLM`, Perez et al. 2018) and the activation that follows it, in one pass.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Shape, Tensor, bail};
use candle_nn::Module as _;

use super::activation::{rough_sigmoid, sigmoid_with};
use super::linear::Linear;
use super::row_weights::RowWeights;
use super::scratch::with_buffers;
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::nn::recycled::buffer;
use crate::nn::tensors::with_values;
use crate::vectorized::{Instructions, vectorized_by};

/// x · σ(x) of each value ("`SiLU`").
pub(in crate::nn) fn silu(x: &Tensor) -> Result<Tensor> {
    apply(Silu, [x])
}

/// Linear layers with [`silu`] between them.
pub(in crate::nn) fn perceptron(layers: &[Linear], x: &Tensor) -> Result<Tensor> {
    if let Some(packed) = PackedPerceptron::of(layers) {
        let (rows, inputs) = x.dims2()?;
        let mut out = vec![0.0; rows * packed.outputs()];
        with_values(x, |x| {
            packed.run(&mut out, inputs, |first, read| {
                read.copy_from_slice(&x[first * inputs..][..read.len()]);
            });
        })?;
        return Tensor::from_vec(out, (rows, packed.outputs()), x.device());
    }
    let mut values = x.clone();
    for (index, layer) in layers.iter().enumerate() {
        if index > 0 {
            values = silu(&values)?;
        }
        values = layer.forward(&values)?;
    }
    Ok(values)
}

/// Rows that go through all layers together, so that what is between the layers stays in the fastest cache.
const ROWS_TOGETHER: usize = 64;

/// A perceptron whose weights are packed.
pub(in crate::nn) struct PackedPerceptron<'a>(Vec<&'a RowWeights>);

impl<'a> PackedPerceptron<'a> {
    /// Of these layers; `None` if they are not packed, or there are none.
    pub(in crate::nn) fn of(layers: &'a [Linear]) -> Option<Self> {
        let packed: Option<Vec<&RowWeights>> = layers.iter().map(|layer| layer.packed.as_deref()).collect();
        packed.filter(|layers| !layers.is_empty()).map(Self)
    }

    /// Values of a row of its result.
    pub(in crate::nn) fn outputs(&self) -> usize {
        self.0.last().map_or(0, |last| last.outputs())
    }

    /// Fills `out` with the results of all rows. `read` writes the inputs of some rows, from the one with that index on.
    pub(in crate::nn) fn run(&self, out: &mut [f32], inputs: usize, mut read: impl FnMut(usize, &mut [f32])) {
        let outputs = self.outputs();
        let widest = self.0.iter().map(|layer| layer.outputs()).fold(inputs, usize::max);
        let length = ROWS_TOGETHER * widest;
        with_buffers([length, length, 0], |[from, to, _]| {
            for (index, out) in out.chunks_mut(ROWS_TOGETHER * outputs).enumerate() {
                let length = out.len() / outputs * inputs;
                read(index * ROWS_TOGETHER, &mut from[..length]);
                self.run_together([&mut *from, &mut *to], length, out);
            }
        });
    }

    /// Of rows that are the first `length` values of the first buffer.
    fn run_together(&self, [mut from, mut to]: [&mut [f32]; 2], mut length: usize, out: &mut [f32]) {
        let rows = out.len() / self.outputs();
        let mut layers = self.0.iter().peekable();
        while let Some(weights) = layers.next() {
            let Some(next) = layers.peek() else {
                return weights.multiply_alike(&from[..length], out);
            };
            let sums = &mut to[..rows * weights.outputs()];
            weights.multiply_alike(&from[..length], sums);
            match next {
                RowWeights::Single(_) => activate_all::<false>(sums),
                RowWeights::Reduced(_) => activate_all::<true>(sums),
            }
            length = sums.len();
            std::mem::swap(&mut from, &mut to);
        }
    }
}

/// [`activate`] of each value, in place.
fn activate_all<const ROUGHLY: bool>(values: &mut [f32]) {
    vectorized_by(
        #[inline(always)]
        |instructions| {
            for value in values {
                *value = activate::<ROUGHLY>(*value, instructions);
            }
        },
    );
}

/// SiLU(x · (1 + scale) + shift) of x `[N, …, C]`, with `modulation` `[N, 2 · C]`: the scales of an item, then its shifts.
/// Errors: shapes that do not fit.
pub(in crate::nn) fn modulated_silu(x: &Tensor, modulation: &Tensor) -> Result<Tensor> {
    apply(ModulatedSilu, [x, modulation])
}

/// `SiLU`; roughly: off by less than 4e-5 of x, for what is reduced to 16 or 8 bits.
#[inline(always)]
pub(super) fn activate<const ROUGHLY: bool>(x: f32, instructions: Instructions) -> f32 {
    if ROUGHLY {
        x * rough_sigmoid(x, instructions)
    } else {
        x * sigmoid_with(x, instructions)
    }
}

#[inline(always)]
fn slope(x: f32, instructions: Instructions) -> f32 {
    let share = sigmoid_with(x, instructions);
    share * (1.0 + x * (1.0 - share))
}

struct Silu;

impl FusedOperation<1> for Silu {
    const NAME: &'static str = "silu";

    fn forward(&self, [x]: [Operand; 1]) -> Result<(Vec<f32>, Shape)> {
        let mut values = buffer(x.values.len());
        // Not `collect`: it is not inlined, so its loop would do without vector instructions.
        vectorized_by(
            #[inline(always)]
            |instructions| {
                for (value, &x) in values.iter_mut().zip(x.values) {
                    *value = activate::<false>(x, instructions);
                }
            },
        );
        Ok((values, x.layout.shape().clone()))
    }

    fn backward(&self, [x]: [Operand; 1], _output: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 1]> {
        let mut values = vec![0.0; x.values.len()];
        vectorized_by(
            #[inline(always)]
            |instructions| {
                for ((value, &x), gradient) in values.iter_mut().zip(x.values).zip(gradient.values) {
                    *value = gradient * slope(x, instructions);
                }
            },
        );
        Ok([Some(values)])
    }
}

struct ModulatedSilu;

impl FusedOperation<2> for ModulatedSilu {
    const NAME: &'static str = "modulated-silu";

    fn forward(&self, [x, modulation]: [Operand; 2]) -> Result<(Vec<f32>, Shape)> {
        let (item, channels) = sizes(x, modulation)?;
        let mut out = x.values.to_vec();
        let items = out
            .chunks_exact_mut(item)
            .zip(modulation.values.chunks_exact(2 * channels));
        vectorized_by(
            #[inline(always)]
            |instructions| {
                for (values, modulation) in items {
                    let (scale, shift) = modulation.split_at(channels);
                    for row in values.chunks_exact_mut(channels) {
                        for ((value, scale), shift) in row.iter_mut().zip(scale).zip(shift) {
                            *value =
                                activate::<false>(instructions.multiply_add(*value, 1.0 + scale, *shift), instructions);
                        }
                    }
                }
            },
        );
        Ok((out, x.layout.shape().clone()))
    }

    fn backward(
        &self,
        [x, modulation]: [Operand; 2],
        _output: Operand,
        gradient: Operand,
    ) -> Result<[Option<Vec<f32>>; 2]> {
        let (item, channels) = sizes(x, modulation)?;
        let mut for_x = gradient.values.to_vec();
        let mut for_modulation = vec![0.0; modulation.values.len()];
        let items = for_x
            .chunks_exact_mut(item)
            .zip(x.values.chunks_exact(item))
            .zip(modulation.values.chunks_exact(2 * channels))
            .zip(for_modulation.chunks_exact_mut(2 * channels));
        vectorized_by(
            #[inline(always)]
            |instructions| {
                for (((gradient, x), modulation), sums) in items {
                    item_gradient([x, modulation], gradient, sums, instructions);
                }
            },
        );
        Ok([Some(for_x), Some(for_modulation)])
    }
}

/// Turns the output's gradient of one item into the input's, and adds up that of its modulation.
#[inline(always)]
fn item_gradient([x, modulation]: [&[f32]; 2], gradient: &mut [f32], sums: &mut [f32], instructions: Instructions) {
    let channels = modulation.len() / 2;
    let (scale, shift) = modulation.split_at(channels);
    let (scale_sums, shift_sums) = sums.split_at_mut(channels);
    for (gradient, x) in gradient.chunks_exact_mut(channels).zip(x.chunks_exact(channels)) {
        for channel in 0..channels {
            let gain = 1.0 + scale[channel];
            let modulated = instructions.multiply_add(x[channel], gain, shift[channel]);
            let inner = gradient[channel] * slope(modulated, instructions);
            scale_sums[channel] += inner * x[channel];
            shift_sums[channel] += inner;
            gradient[channel] = inner * gain;
        }
    }
}

/// Values of an item, and channels.
fn sizes(x: Operand, modulation: Operand) -> Result<(usize, usize)> {
    match (x.dims(), modulation.dims()) {
        (&[count, .., channels], &[items, both]) if count == items && both == 2 * channels => {
            Ok((x.values.len() / count, channels))
        }
        (x, modulation) => bail!("a modulation of shape {modulation:?} does not fit {x:?}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise};

    #[test]
    fn gradients_agree_with_differences() {
        let (x, modulation) = (noise(&[2, 3, 2, 4], 1), noise(&[2, 8], 2));
        assert_gradients(std::slice::from_ref(&x), 1e-2, |inputs| silu(&inputs[0]));
        assert_gradients(&[x, modulation], 1e-2, |inputs| modulated_silu(&inputs[0], &inputs[1]));
    }

    #[test]
    fn without_modulation_it_is_silu() {
        let x = noise(&[2, 3, 2, 4], 1);
        let none = Tensor::zeros((2, 8), candle_core::DType::F32, x.device()).unwrap();
        let values = |tensor: Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(values(silu(&x).unwrap()), values(modulated_silu(&x, &none).unwrap()));
    }
}
