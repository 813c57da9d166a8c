//! The structural similarity (Wang et al. 2004) as a loss: 1 minus its mean over all pixels.
//!
//! The same measure as [`crate::frame::quality::ssim`]. Its gradient is written by hand, since it is then one pass of blurs
//! back as it is one forward.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};
use rayon::prelude::*;

use super::error::NnError;
use super::loss::check_same_shape;
use super::tensors::{slice, with_values};
use crate::frame::quality::SsimTerms;

/// 1 minus the mean structural similarity of the frames `[…, P]`, as a scalar; `width` is a row's length in pixels.
/// Only `prediction` gets a gradient. Errors: `Shape` if the shapes differ.
pub fn ssim_loss(prediction: &Tensor, target: &Tensor, width: usize) -> std::result::Result<Tensor, NnError> {
    check_same_shape(prediction, target)?;
    let frame = prediction.dims().last().copied().unwrap_or(0);
    let operation = SsimLoss { frame, width };
    Ok(prediction
        .contiguous()?
        .apply_op2(&target.detach().contiguous()?, operation)?)
}

struct SsimLoss {
    /// Pixels of a frame.
    frame: usize,
    width: usize,
}

impl CustomOp2 for SsimLoss {
    fn name(&self) -> &'static str {
        "ssim-loss"
    }

    fn cpu_fwd(
        &self,
        prediction: &CpuStorage,
        prediction_layout: &Layout,
        target: &CpuStorage,
        target_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (prediction, target) = (slice(prediction, prediction_layout)?, slice(target, target_layout)?);
        let sum: f64 = prediction
            .par_chunks_exact(self.frame)
            .zip(target.par_chunks_exact(self.frame))
            .map(|(prediction, target)| SsimTerms::new(prediction, target, self.width).sum())
            .collect::<Vec<_>>()
            .iter()
            .sum();
        let loss = 1.0 - sum / prediction.len() as f64;
        Ok((CpuStorage::F32(vec![loss as f32]), Shape::from(())))
    }

    fn bwd(
        &self,
        prediction: &Tensor,
        target: &Tensor,
        _loss: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let scale = -gradient.to_scalar::<f32>()? / prediction.elem_count() as f32;
        let values: Vec<f32> = with_values(prediction, |prediction| {
            with_values(target, |target| {
                let frames = prediction
                    .par_chunks_exact(self.frame)
                    .zip(target.par_chunks_exact(self.frame));
                frames
                    .flat_map_iter(|(prediction, target)| {
                        let slopes = SsimTerms::new(prediction, target, self.width).gradient();
                        slopes.into_iter().map(|slope| slope * scale)
                    })
                    .collect()
            })
        })??;
        let gradient = Tensor::from_vec(values, prediction.dims(), prediction.device())?;
        Ok((Some(gradient), None))
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
