//! Why no plan can be made.

use crate::error_kind::{ErrorKind, HasErrorKind};
use crate::nn::NnError;
use crate::serving::{InputError, ServingError};
use crate::types::ModelName;

/// Why no plan can be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// There is nothing to choose.
    #[error("model \"{model}\" takes no actions, so there is nothing to plan")]
    NoActions {
        /// The model.
        model: ModelName,
    },
    /// Nothing to reach.
    #[error("goal is empty; give position_m, heading_rad or image")]
    NoGoal,
    /// A goal by pose, for a model whose actions are not speeds.
    #[error(
        "goal.{field} needs actions that are speeds (m/s and rad/s); model \"{model}\" takes others, so give goal.image"
    )]
    NoMotion {
        /// The field of the goal.
        field: &'static str,
        /// The model.
        model: ModelName,
    },
    /// A number of the request that is out of range.
    #[error("{field} is {value}; it must be {range}")]
    OutOfRange {
        /// The field.
        field: String,
        /// Its value.
        value: f64,
        /// What would be right.
        range: String,
    },
    /// A list with an entry for each action channel.
    #[error("{field} has {found} entries; model \"{model}\" has {expected} action channels")]
    Channels {
        /// The field.
        field: String,
        /// Entries given.
        found: usize,
        /// The model.
        model: ModelName,
        /// The model's channels.
        expected: usize,
    },
    /// Nothing says how large actions may be.
    #[error("model \"{model}\" is not calibrated, so the ranges of its actions are not known; give limits")]
    NoLimits {
        /// The model.
        model: ModelName,
    },
    /// A cost that cannot be computed.
    #[error("costs.{cost} cannot be computed: {reason}")]
    CostUnavailable {
        /// The cost.
        cost: &'static str,
        /// Why.
        reason: &'static str,
    },
    /// The context does not fit the model.
    #[error(transparent)]
    Input(#[from] InputError),
    /// A prediction failed.
    #[error(transparent)]
    Prediction(#[from] ServingError),
    /// The motion of the plans could not be computed.
    #[error("the motion of the plans could not be computed")]
    Motion(#[from] NnError),
}

impl HasErrorKind for PlanError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Prediction(error) => error.kind(),
            Self::Motion(_) => ErrorKind::Internal,
            _ => ErrorKind::Usage,
        }
    }
}
