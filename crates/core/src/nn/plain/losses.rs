//! The losses in tensor operations, for predictions that are not on the CPU.

use candle_core::{Result, Tensor};

use crate::frame::quality::{SSIM_C1, SSIM_C2, ssim_kernel};

/// The mean of the squared differences.
pub(in crate::nn) fn squared(prediction: &Tensor, target: &Tensor) -> Result<Tensor> {
    (prediction - target)?.sqr()?.mean_all()
}

/// The mean of the absolute differences.
pub(in crate::nn) fn absolute(prediction: &Tensor, target: &Tensor) -> Result<Tensor> {
    (prediction - target)?.abs()?.mean_all()
}

/// The binary cross entropy of logits and a mask of 0 and 1, without an overflow for large logits.
pub(in crate::nn) fn cross_entropy(logits: &Tensor, mask: &Tensor) -> Result<Tensor> {
    let beyond = ((logits.abs()?.neg()?.exp()? + 1.0)?).log()?;
    ((logits.relu()? - (logits * mask)?)? + beyond)?.mean_all()
}

/// 1 minus the mean structural similarity of frames `[…, P]` with rows of `width` pixels.
pub(in crate::nn) fn dissimilarity(prediction: &Tensor, target: &Tensor, width: usize) -> Result<Tensor> {
    let [a, b] =
        [prediction, target].map(|frames| frames.reshape(((), frames.dims()[frames.rank() - 1] / width, width)));
    let (a, b) = (a?, b?);
    let (count, height, _) = a.dims3()?;
    let [rows, columns] = [blur(height, &a)?, blur(width, &a)?.t()?.contiguous()?];
    // All images that are blurred, in two products.
    let images = Tensor::cat(&[&a, &b, &a.sqr()?, &b.sqr()?, &(&a * &b)?], 0)?;
    let along = images.reshape((5 * count * height, width))?.matmul(&columns)?;
    let along = along.reshape((5 * count, height, width))?;
    let means = rows.broadcast_left(5 * count)?.matmul(&along)?;
    let part = |index: usize| means.narrow(0, index * count, count);
    let (mean_a, mean_b) = (part(0)?, part(1)?);
    let (aa, bb, ab) = (mean_a.sqr()?, mean_b.sqr()?, (&mean_a * &mean_b)?);
    let luminance = ab.affine(2.0, SSIM_C1.into())?;
    let structure = (part(4)? - &ab)?.affine(2.0, SSIM_C2.into())?;
    let energy = (&aa + &bb)?.affine(1.0, SSIM_C1.into())?;
    let variance = ((part(2)? - aa)? + (part(3)? - bb)?)?.affine(1.0, SSIM_C2.into())?;
    let similarity = ((luminance * structure)? / (energy * variance)?)?;
    similarity.mean_all()?.affine(-1.0, 1.0)
}

/// The matrix `[side, side]` that blurs a column of so many pixels; beyond the border, the edge pixel is repeated.
fn blur(side: usize, like: &Tensor) -> Result<Tensor> {
    let kernel = ssim_kernel();
    let radius = kernel.len() / 2;
    let mut shares = vec![0.0; side * side];
    for pixel in 0..side {
        for (tap, share) in kernel.iter().enumerate() {
            let from = (pixel + tap).saturating_sub(radius).min(side - 1);
            shares[pixel * side + from] += share;
        }
    }
    Tensor::from_vec(shares, (side, side), like.device())
}
