//! Loss functions: the difference of a prediction and its target as one number. candle-nn's `mse` is several operations, each
//! with a pass over all pixels and a tensor of its own; here the value takes one pass, with a sum in f64, and so does the gradient.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use candle_core::{Shape, Tensor};
use serde::{Deserialize, Serialize};

use super::error::NnError;
use super::fused::{FusedOperation, Operand, apply};
use super::options::UnknownName;
use super::plain::losses;
use crate::named_enum;
use crate::vectorized::vectorized;

named_enum! {
    /// The loss that training minimizes. The paper found the mean squared error best.
    #[derive(Hash, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "kebab-case")]
    pub enum Loss {
        /// Mean of the squared differences.
        Mse = "mse",
        /// Mean of the absolute differences.
        L1 = "l1",
    }
    else |name| -> UnknownName { UnknownName::new("loss", name, "\"mse\" and \"l1\"") }
}

impl Loss {
    /// The loss as a scalar tensor. Only `prediction` gets a gradient. Errors: `Shape` if the shapes differ.
    pub fn between(self, prediction: &Tensor, target: &Tensor) -> Result<Tensor, NnError> {
        check_same_shape(prediction, target)?;
        if !prediction.device().is_cpu() {
            let target = target.to_device(prediction.device())?.detach();
            return Ok(match self {
                Self::Mse => losses::squared(prediction, &target)?,
                Self::L1 => losses::absolute(prediction, &target)?,
            });
        }
        Ok(apply(self, [prediction, &target.detach()])?)
    }
}

/// Errors: `Shape` if the shapes differ.
pub(super) fn check_same_shape(prediction: &Tensor, target: &Tensor) -> Result<(), NnError> {
    if prediction.dims() == target.dims() {
        return Ok(());
    }
    let expected = format!("the target's shape {:?}", target.dims());
    Err(NnError::shape("prediction", prediction, expected))
}

impl FusedOperation<2> for Loss {
    const NAME: &'static str = "loss";

    fn forward(&self, [prediction, target]: [Operand; 2]) -> candle_core::Result<(Vec<f32>, Shape)> {
        let (prediction, target) = (prediction.values, target.values);
        let sum = match self {
            Self::Mse => sum_of(prediction, target, |difference| difference * difference),
            Self::L1 => sum_of(prediction, target, f32::abs),
        };
        Ok((vec![(sum / prediction.len() as f64) as f32], Shape::from(())))
    }

    fn backward(
        &self,
        [prediction, target]: [Operand; 2],
        _loss: Operand,
        gradient: Operand,
    ) -> candle_core::Result<[Option<Vec<f32>>; 2]> {
        let (prediction, target) = (prediction.values, target.values);
        let scale = gradient.values[0] / prediction.len() as f32;
        let values = match self {
            Self::Mse => slopes(prediction, target, |difference| 2.0 * scale * difference),
            Self::L1 => slopes(prediction, target, |difference| {
                let sign = f32::from(u8::from(difference > 0.0)) - f32::from(u8::from(difference < 0.0));
                scale * sign
            }),
        };
        Ok([Some(values), None])
    }
}

/// Sum of `term` of each difference: blocks in f32, the sum of the blocks in f64.
#[inline(always)]
fn sum_of(prediction: &[f32], target: &[f32], term: impl Fn(f32) -> f32) -> f64 {
    vectorized(
        #[inline(always)]
        || {
            let mut total = 0.0;
            for (prediction, target) in prediction.chunks(512).zip(target.chunks(512)) {
                let mut lanes = [0.0f32; 16];
                for (prediction, target) in prediction.chunks(16).zip(target.chunks(16)) {
                    for ((lane, prediction), target) in lanes.iter_mut().zip(prediction).zip(target) {
                        *lane += term(prediction - target);
                    }
                }
                total += f64::from(lanes.iter().sum::<f32>());
            }
            total
        },
    )
}

/// `slope` of each difference.
#[inline(always)]
fn slopes(prediction: &[f32], target: &[f32], slope: impl Fn(f32) -> f32) -> Vec<f32> {
    let mut values = vec![0.0; prediction.len()];
    vectorized(
        #[inline(always)]
        || {
            for ((value, prediction), target) in values.iter_mut().zip(prediction).zip(target) {
                *value = slope(prediction - target);
            }
        },
    );
    values
}
