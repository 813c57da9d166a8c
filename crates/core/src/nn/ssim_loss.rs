//! The structural similarity (Wang et al. 2004) as a loss: 1 minus its mean over all pixels.
//!
//! The same measure as [`crate::frame::quality::ssim`]. Its gradient is written by hand, since it is then one pass of blurs
//! back as it is one forward. candle-nn has no such loss.

use candle_core::{Result, Shape, Tensor};
use rayon::prelude::*;

use super::error::NnError;
use super::fused::{FusedOperation, Operand, apply};
use super::loss::check_same_shape;
use super::plain::losses;
use crate::frame::quality::SsimTerms;

/// 1 minus the mean structural similarity of the frames `[…, P]`, as a scalar; `width` is a row's length in pixels.
/// Only `prediction` gets a gradient. Errors: `Shape` if the shapes differ.
pub fn ssim_loss(prediction: &Tensor, target: &Tensor, width: usize) -> std::result::Result<Tensor, NnError> {
    check_same_shape(prediction, target)?;
    if !prediction.device().is_cpu() {
        let target = target.to_device(prediction.device())?.detach();
        return Ok(losses::dissimilarity(prediction, &target, width)?);
    }
    let frame = prediction.dims().last().copied().unwrap_or(0);
    Ok(apply(SsimLoss { frame, width }, [prediction, &target.detach()])?)
}

struct SsimLoss {
    /// Pixels of a frame.
    frame: usize,
    width: usize,
}

impl SsimLoss {
    /// The similarity of each frame of the prediction and of the target.
    fn terms<'a>(&self, [prediction, target]: [Operand<'a>; 2]) -> impl IndexedParallelIterator<Item = SsimTerms<'a>> {
        let frames = prediction.values.par_chunks_exact(self.frame);
        let pairs = frames.zip(target.values.par_chunks_exact(self.frame));
        pairs.map(|(prediction, target)| SsimTerms::new(prediction, target, self.width))
    }
}

impl FusedOperation<2> for SsimLoss {
    const NAME: &'static str = "ssim-loss";

    fn forward(&self, inputs: [Operand; 2]) -> Result<(Vec<f32>, Shape)> {
        let sums: Vec<f64> = self.terms(inputs).map(|terms| terms.sum()).collect();
        let loss = 1.0 - sums.iter().sum::<f64>() / inputs[0].values.len() as f64;
        Ok((vec![loss as f32], Shape::from(())))
    }

    fn backward(&self, inputs: [Operand; 2], _loss: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 2]> {
        let scale = -gradient.values[0] / inputs[0].values.len() as f32;
        let slopes = self.terms(inputs).flat_map_iter(|terms| terms.gradient());
        Ok([Some(slopes.map(|slope| slope * scale).collect()), None])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::noise;

    #[test]
    fn a_frame_like_the_target_has_no_loss() {
        let frames = noise(&[2, 3, 48], 1);
        let loss = ssim_loss(&frames, &frames, 8).unwrap().to_scalar::<f32>().unwrap();
        assert!(loss.abs() < 1e-5, "{loss}");
    }

    #[test]
    fn a_step_against_the_gradient_lowers_the_loss() {
        let target = noise(&[2, 2, 96], 2);
        let frames = candle_core::Var::from_tensor(&noise(&[2, 2, 96], 3)).unwrap();
        let loss = ssim_loss(&frames, &target, 12).unwrap();
        let gradients = loss.backward().unwrap();
        let slope = gradients.get(&frames).unwrap();
        let moved = (frames.as_tensor() - (slope * 0.1).unwrap()).unwrap();
        let lower = ssim_loss(&moved, &target, 12).unwrap().to_scalar::<f32>().unwrap();
        let expected = 0.1 * slope.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap();
        let fall = loss.to_scalar::<f32>().unwrap() - lower;
        assert!((fall - expected).abs() < 0.2 * expected, "{fall} {expected}");
    }
}
