//! What the dense network's predictor gives: a setting, since the paper does not add its output to the last features.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::NnError;
use super::spec::named_enum;

named_enum!(
    /// What the dense network's predictor gives at each step.
    PredictorOutput, "predictor output", "\"residual\" and \"absolute\"", {
        /// The change of the features since the previous frame.
        Residual = "residual",
        /// The features themselves, as in the paper.
        Absolute = "absolute",
    }
);

impl PredictorOutput {
    /// That of specifications that name none.
    pub fn residual() -> Self {
        Self::Residual
    }

    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
    pub(super) fn is_residual(&self) -> bool {
        *self == Self::Residual
    }
}
