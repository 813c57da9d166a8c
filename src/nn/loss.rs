//! How far a prediction is from the truth, as one number to make small.

use std::fmt;
use std::str::FromStr;

use candle_core::Tensor;
use serde::{Deserialize, Serialize};

use super::NnError;
use super::spec::named_enum;

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
        let difference = (prediction - truth.detach())?;
        Ok(match self {
            Self::Mse => difference.sqr()?.mean_all()?,
            Self::L1 => difference.abs()?.mean_all()?,
        })
    }
}
