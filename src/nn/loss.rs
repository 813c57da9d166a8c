//! How far a prediction is from the truth, as one number to make small.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::fmt;
use std::str::FromStr;

use candle_core::{CpuStorage, CustomOp2, DType, Layout, Shape, Tensor};
use pulp::Arch;
use serde::{Deserialize, Serialize};

use super::NnError;
use super::spec::named_enum;
use super::tensors::{slice, with_values};

named_enum!(
    /// The loss that training makes small. The paper found the mean squared error best.
    Loss, "loss", "\"mse\" and \"l1\"", {
        /// Mean of the squared differences.
        Mse = "mse",
        /// Mean of the absolute differences.
        L1 = "l1",
    }
);

impl Loss {
    /// The loss as a scalar tensor; its gradient goes to `prediction` alone. Errors: `Shape` if the two differ in shape.
    pub fn between(self, prediction: &Tensor, truth: &Tensor) -> Result<Tensor, NnError> {
        if prediction.dims() != truth.dims() {
            return Err(NnError::shape(
                "prediction",
                prediction,
                format!("the truth's shape {:?}", truth.dims()),
            ));
        }
        if prediction.dtype() == DType::F32 {
            return Ok(prediction
                .contiguous()?
                .apply_op2(&truth.detach().contiguous()?, self)?);
        }
        let difference = (prediction - truth.detach())?;
        Ok(match self {
            Self::Mse => difference.sqr()?.mean_all()?,
            Self::L1 => difference.abs()?.mean_all()?,
        })
    }
}

/// In f32, one pass forth and one back.
impl CustomOp2 for Loss {
    fn name(&self) -> &'static str {
        "loss"
    }

    fn cpu_fwd(
        &self,
        prediction: &CpuStorage,
        prediction_layout: &Layout,
        truth: &CpuStorage,
        truth_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (prediction, truth) = (slice(prediction, prediction_layout)?, slice(truth, truth_layout)?);
        let count = prediction.len() as f64;
        let sum = match self {
            Self::Mse => sum_of(prediction, truth, |difference| difference * difference),
            Self::L1 => sum_of(prediction, truth, f32::abs),
        };
        Ok((CpuStorage::F32(vec![(sum / count) as f32]), Shape::from(())))
    }

    fn bwd(
        &self,
        prediction: &Tensor,
        truth: &Tensor,
        _loss: &Tensor,
        gradient: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let scale = gradient.to_scalar::<f32>()? / prediction.elem_count() as f32;
        let values = with_values(prediction, |prediction| {
            with_values(truth, |truth| match self {
                Self::Mse => each(prediction, truth, |difference| 2.0 * scale * difference),
                Self::L1 => each(prediction, truth, |difference| {
                    let sign = f32::from(u8::from(difference > 0.0)) - f32::from(u8::from(difference < 0.0));
                    scale * sign
                }),
            })
        })??;
        Ok((
            Some(Tensor::from_vec(values, prediction.dims(), prediction.device())?),
            None,
        ))
    }
}

/// Sum of `term` of each difference, blocks in f32, their sum in f64.
#[inline(always)]
fn sum_of(prediction: &[f32], truth: &[f32], term: impl Fn(f32) -> f32) -> f64 {
    Arch::new().dispatch(
        #[inline(always)]
        || {
            let mut total = 0.0;
            for (prediction, truth) in prediction.chunks(512).zip(truth.chunks(512)) {
                let mut lanes = [0.0f32; 16];
                for (prediction, truth) in prediction.chunks(16).zip(truth.chunks(16)) {
                    for ((lane, prediction), truth) in lanes.iter_mut().zip(prediction).zip(truth) {
                        *lane += term(prediction - truth);
                    }
                }
                total += f64::from(lanes.iter().sum::<f32>());
            }
            total
        },
    )
}

#[inline(always)]
fn each(prediction: &[f32], truth: &[f32], slope: impl Fn(f32) -> f32) -> Vec<f32> {
    Arch::new().dispatch(
        #[inline(always)]
        || {
            prediction
                .iter()
                .zip(truth)
                .map(|(prediction, truth)| slope(prediction - truth))
                .collect()
        },
    )
}
