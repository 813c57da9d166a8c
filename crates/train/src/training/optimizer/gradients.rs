//! Gradients as values: computed from a loss, averaged over parts of a batch, and measured.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use std::collections::BTreeMap;

use candle_core::{DType, Tensor};

use super::OptimizerError;
use foreframe_core::nn::Parameters;
use foreframe_core::nn::tensors::with_values;
use foreframe_core::vectorized::vectorized;

/// Gradients of a loss by tensor name, with the loss.
#[derive(Debug)]
pub struct Gradients {
    loss: f64,
    by_name: BTreeMap<String, Tensor>,
}

impl Gradients {
    /// Gradients of the scalar `loss` for all parameters on which it depends. Errors: `LossNotFinite`.
    pub fn of(loss: &Tensor, parameters: &Parameters) -> Result<Self, OptimizerError> {
        let value = loss.to_dtype(DType::F64)?.to_scalar::<f64>()?;
        if !value.is_finite() {
            return Err(OptimizerError::LossNotFinite { value });
        }
        let mut store = loss.backward()?;
        let mut by_name = BTreeMap::new();
        for (name, var) in parameters.iter() {
            if let Some(gradient) = store.remove(var.as_tensor()) {
                by_name.insert(name.to_owned(), gradient.detach().contiguous()?);
            }
        }
        Ok(Self { loss: value, by_name })
    }

    /// The mean of the gradients and losses of equally large parts of a batch, summed in the order given. A part whose loss does not
    /// depend on a tensor has no gradient of it, which counts as 0. Errors: `Join`.
    pub fn mean(parts: Vec<Self>) -> Result<Self, OptimizerError> {
        let weight = 1.0 / parts.len() as f64;
        let mut parts = parts.into_iter();
        let mut joined = parts.next().ok_or(OptimizerError::Join)?;
        for part in parts {
            joined.loss += part.loss;
            for (name, gradient) in part.by_name {
                let sum = match joined.by_name.get(&name) {
                    Some(sum) => (sum + gradient)?,
                    None => gradient,
                };
                joined.by_name.insert(name, sum);
            }
        }
        joined.loss *= weight;
        for sum in joined.by_name.values_mut() {
            *sum = (&*sum * weight)?;
        }
        Ok(joined)
    }

    /// The loss.
    #[must_use]
    pub fn loss(&self) -> f64 {
        self.loss
    }

    /// The gradient of the tensor with this name, if the loss depends on it.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.by_name.get(name)
    }

    /// Euclidean norm over all tensors. Errors: `GradientNotFinite`.
    pub fn norm(&self) -> Result<f64, OptimizerError> {
        let mut sum = 0.0;
        for (name, gradient) in &self.by_name {
            let squares = with_values(gradient, sum_of_squares)?;
            if !squares.is_finite() {
                return Err(OptimizerError::GradientNotFinite { name: name.clone() });
            }
            sum += squares;
        }
        Ok(sum.sqrt())
    }
}

/// Sum of squares: short blocks in f32, the sum of the blocks in f64, so that the rounding error stays small.
fn sum_of_squares(values: &[f32]) -> f64 {
    vectorized(
        #[inline(always)]
        || {
            let mut total = 0.0;
            for block in values.chunks(1024) {
                let mut lanes = [0.0f32; 16];
                let whole = block.chunks_exact(16);
                let rest: f32 = whole.remainder().iter().map(|value| value * value).sum();
                for part in whole {
                    for (lane, value) in lanes.iter_mut().zip(part) {
                        *lane += value * value;
                    }
                }
                total += f64::from(lanes.iter().sum::<f32>() + rest);
            }
            total
        },
    )
}
