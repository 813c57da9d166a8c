//! Linear layers, activations, and pixels that move between channels and places.

use candle_core::{Result, Tensor};

use crate::nn::ops::linear::Linear;

/// The layer of rows `[N, D]`, with its tanh if it has one.
pub(in crate::nn) fn linear(layer: &Linear, x: &Tensor) -> Result<Tensor> {
    let sums = x.matmul(&layer.weight)?.broadcast_add(&layer.bias)?;
    if layer.has_tanh { sums.tanh() } else { Ok(sums) }
}

/// The layer at each place of images `[N, D, H, W]`.
pub(in crate::nn) fn linear_per_place(layer: &Linear, x: &Tensor) -> Result<Tensor> {
    let (items, _, height, width) = x.dims4()?;
    let weight = layer.weight.t()?.broadcast_left(items)?;
    let sums = weight.matmul(&x.flatten_from(2)?)?;
    let outputs = layer.bias.elem_count();
    let sums = sums.broadcast_add(&layer.bias.reshape((1, outputs, 1))?)?;
    sums.reshape((items, outputs, height, width))
}

/// Linear layers of rows `[N, D]` with `SiLU` between them.
pub(in crate::nn) fn perceptron(layers: &[Linear], x: &Tensor) -> Result<Tensor> {
    let mut values = x.clone();
    for (index, layer) in layers.iter().enumerate() {
        if index > 0 {
            values = values.silu()?;
        }
        values = linear(layer, &values)?;
    }
    Ok(values)
}

/// SiLU(x · (1 + scale) + shift) of images `[N, C, H, W]`, with `modulation` `[N, 2 · C]`: the scales of an item, then its shifts.
pub(in crate::nn) fn modulated_silu(x: &Tensor, modulation: &Tensor) -> Result<Tensor> {
    let channels = x.dim(1)?;
    let modulation = modulation.unsqueeze(2)?.unsqueeze(3)?;
    let (scale, shift) = (
        modulation.narrow(1, 0, channels)?,
        modulation.narrow(1, channels, channels)?,
    );
    x.broadcast_mul(&(scale + 1.0)?)?.broadcast_add(&shift)?.silu()
}

/// Spreads 4 · C channels over twice the sides: `[N, 4 · C, H, W]` → `[N, C, 2H, 2W]`. Channel group `2 · row + column` goes to that
/// row and column of each 2×2 block.
pub(in crate::nn) fn pixel_shuffle(x: &Tensor) -> Result<Tensor> {
    let (items, channels, height, width) = x.dims4()?;
    x.reshape(&[items, 2, 2, channels / 4, height, width][..])?
        .permute(vec![0, 3, 4, 1, 5, 2])?
        .reshape((items, channels / 4, 2 * height, 2 * width))
}

/// The inverse of [`pixel_shuffle`].
pub(in crate::nn) fn pixel_unshuffle(x: &Tensor) -> Result<Tensor> {
    let (items, channels, height, width) = x.dims4()?;
    x.reshape(&[items, channels, height / 2, 2, width / 2, 2][..])?
        .permute(vec![0, 3, 5, 1, 2, 4])?
        .reshape((items, 4 * channels, height / 2, width / 2))
}

/// σ(x) = (1 + tanh(x / 2)) / 2, of operations that have gradients. No exponent overflows.
pub(in crate::nn) fn sigmoid(x: &Tensor) -> Result<Tensor> {
    x.affine(0.5, 0.0)?.tanh()?.affine(0.5, 0.5)
}
