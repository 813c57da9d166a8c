//! The loss of a mask: how far logits are from whether each pixel belongs to it. candle-nn's binary cross entropy takes
//! the logarithm of a probability, which is infinite for a large logit; this one is finite for all.

use candle_core::{Shape, Tensor};

use super::error::NnError;
use super::fused::{FusedOperation, Operand, apply};
use super::loss::check_same_shape;
use super::plain::losses;

/// The binary cross entropy of logits and a mask of 0 and 1, mean over all pixels, as a scalar tensor. Only `logits` gets a
/// gradient. Errors: `Shape` if the shapes differ.
pub fn mask_loss(logits: &Tensor, mask: &Tensor) -> Result<Tensor, NnError> {
    check_same_shape(logits, mask)?;
    if !logits.device().is_cpu() {
        let mask = mask.to_device(logits.device())?.detach();
        return Ok(losses::cross_entropy(logits, &mask)?);
    }
    Ok(apply(MaskLoss, [logits, &mask.detach()])?)
}

/// The probability that a logit stands for.
fn probability(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

struct MaskLoss;

impl FusedOperation<2> for MaskLoss {
    const NAME: &'static str = "mask-loss";

    fn forward(&self, [logits, mask]: [Operand; 2]) -> candle_core::Result<(Vec<f32>, Shape)> {
        let pairs = logits.values.iter().zip(mask.values);
        // Without an overflow for large logits of either sign.
        let sum: f64 = pairs
            .map(|(&logit, &mask)| f64::from(logit.max(0.0) - logit * mask + (-logit.abs()).exp().ln_1p()))
            .sum();
        Ok((vec![(sum / logits.values.len() as f64) as f32], Shape::from(())))
    }

    fn backward(
        &self,
        [logits, mask]: [Operand; 2],
        _loss: Operand,
        gradient: Operand,
    ) -> candle_core::Result<[Option<Vec<f32>>; 2]> {
        let scale = gradient.values[0] / logits.values.len() as f32;
        let pairs = logits.values.iter().zip(mask.values);
        Ok([
            Some(
                pairs
                    .map(|(&logit, &mask)| scale * (probability(logit) - mask))
                    .collect(),
            ),
            None,
        ])
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise};

    #[test]
    fn the_loss_of_a_mask_is_its_cross_entropy() {
        let tensor = |values: &[f32]| Tensor::new(values, &Device::Cpu).unwrap();
        let loss = |logits: &[f32], mask: &[f32]| {
            let loss = mask_loss(&tensor(logits), &tensor(mask)).unwrap();
            loss.to_scalar::<f32>().unwrap()
        };
        assert!((loss(&[0.0, 0.0], &[0.0, 1.0]) - 2f32.ln()).abs() < 1e-6);
        assert!((loss(&[1.0], &[1.0]) + probability(1.0).ln()).abs() < 1e-6);
        assert_eq!(loss(&[200.0, -200.0], &[1.0, 0.0]), 0.0);
        assert_eq!(loss(&[200.0], &[0.0]), 200.0);
    }

    #[test]
    fn the_gradients_of_the_mask_loss_are_right() {
        let mask = Tensor::new(&[[0f32, 1.0, 1.0, 0.0, 1.0]; 3], &Device::Cpu).unwrap();
        assert_gradients(&[noise(&[3, 5], 2)], 1e-2, |inputs| {
            mask_loss(&inputs[0], &mask).map_err(candle_core::Error::wrap)
        });
    }
}
