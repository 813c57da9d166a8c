//! Feature-wise modulation (`FiLM`, Perez et al. 2018) and the activation that follows it, in one pass.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Result, Shape, Tensor, bail};

use super::activation::sigmoid;
use crate::nn::tensors::{slice, with_values};
use crate::vectorized::vectorized;

/// x · σ(x) of each value ("`SiLU`").
pub(in crate::nn) fn silu(x: &Tensor) -> Result<Tensor> {
    let x = x.contiguous()?;
    if x.track_op() {
        x.apply_op1(Silu)
    } else {
        x.apply_op1_no_bwd(&Silu)
    }
}

/// SiLU(x · (1 + scale) + shift) of x `[N, …, C]`, with `modulation` `[N, 2 · C]`: the scales of an item, then its shifts.
/// Errors: shapes that do not fit.
pub(in crate::nn) fn modulated_silu(x: &Tensor, modulation: &Tensor) -> Result<Tensor> {
    let (x, modulation) = (x.contiguous()?, modulation.contiguous()?);
    if x.track_op() || modulation.track_op() {
        x.apply_op2(&modulation, ModulatedSilu)
    } else {
        x.apply_op2_no_bwd(&modulation, &ModulatedSilu)
    }
}

#[inline(always)]
fn activate(x: f32) -> f32 {
    x * sigmoid(x)
}

#[inline(always)]
fn slope(x: f32) -> f32 {
    let share = sigmoid(x);
    share * (1.0 + x * (1.0 - share))
}

struct Silu;

impl CustomOp1 for Silu {
    fn name(&self) -> &'static str {
        "silu"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = slice(x, layout)?;
        let mut values = vec![0.0; x.len()];
        // Not `collect`: it is not inlined, so its loop would do without vector instructions.
        vectorized(
            #[inline(always)]
            || {
                for (value, &x) in values.iter_mut().zip(x) {
                    *value = activate(x);
                }
            },
        );
        Ok((CpuStorage::F32(values), layout.shape().clone()))
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let mut values = vec![0.0; x.elem_count()];
        with_values(x, |x| {
            with_values(gradient, |gradient| {
                vectorized(
                    #[inline(always)]
                    || {
                        for ((value, &x), gradient) in values.iter_mut().zip(x).zip(gradient) {
                            *value = gradient * slope(x);
                        }
                    },
                );
            })
        })??;
        Ok(Some(Tensor::from_vec(values, x.dims(), x.device())?))
    }
}

struct ModulatedSilu;

impl CustomOp2 for ModulatedSilu {
    fn name(&self) -> &'static str {
        "modulated-silu"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        modulation: &CpuStorage,
        modulation_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let shape = x_layout.shape();
        let (count, channels) = sizes(shape.dims(), modulation_layout.dims())?;
        let (x, modulation) = (slice(x, x_layout)?, slice(modulation, modulation_layout)?);
        let mut out = x.to_vec();
        let item = x.len() / count;
        vectorized(
            #[inline(always)]
            || {
                for (values, modulation) in out.chunks_exact_mut(item).zip(modulation.chunks_exact(2 * channels)) {
                    let (scale, shift) = modulation.split_at(channels);
                    for row in values.chunks_exact_mut(channels) {
                        for ((value, scale), shift) in row.iter_mut().zip(scale).zip(shift) {
                            *value = activate(*value * (1.0 + scale) + shift);
                        }
                    }
                }
            },
        );
        Ok((CpuStorage::F32(out), shape.clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        modulation: &Tensor,
        _y: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (count, channels) = sizes(x.dims(), modulation.dims())?;
        let item = x.elem_count() / count;
        let mut for_x = Vec::new();
        let mut for_modulation = vec![0.0; modulation.elem_count()];
        with_values(x, |x| {
            with_values(modulation, |modulation| {
                with_values(gradient, |gradient| {
                    for_x = gradient.to_vec();
                    let items = for_x
                        .chunks_exact_mut(item)
                        .zip(x.chunks_exact(item))
                        .zip(modulation.chunks_exact(2 * channels))
                        .zip(for_modulation.chunks_exact_mut(2 * channels));
                    vectorized(
                        #[inline(always)]
                        || {
                            for (((gradient, x), modulation), sums) in items {
                                item_gradient(gradient, x, modulation, sums);
                            }
                        },
                    );
                })
            })
        })???;
        Ok((
            Some(Tensor::from_vec(for_x, x.dims(), x.device())?),
            Some(Tensor::from_vec(for_modulation, modulation.dims(), x.device())?),
        ))
    }
}

/// Turns the output's gradient of one item into the input's, and adds up that of its modulation.
#[inline(always)]
fn item_gradient(gradient: &mut [f32], x: &[f32], modulation: &[f32], sums: &mut [f32]) {
    let channels = modulation.len() / 2;
    let (scale, shift) = modulation.split_at(channels);
    let (scale_sums, shift_sums) = sums.split_at_mut(channels);
    for (gradient, x) in gradient.chunks_exact_mut(channels).zip(x.chunks_exact(channels)) {
        for channel in 0..channels {
            let gain = 1.0 + scale[channel];
            let inner = gradient[channel] * slope(x[channel] * gain + shift[channel]);
            scale_sums[channel] += inner * x[channel];
            shift_sums[channel] += inner;
            gradient[channel] = inner * gain;
        }
    }
}

/// Items and channels.
fn sizes(x: &[usize], modulation: &[usize]) -> Result<(usize, usize)> {
    match (x, modulation) {
        ([count, .., channels], [items, both]) if count == items && *both == 2 * channels => Ok((*count, *channels)),
        _ => bail!("a modulation of shape {modulation:?} does not fit {x:?}"),
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
