//! Why a model was not adapted.

use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::types::ModelName;

use crate::evaluation::EvaluationError;
use crate::settings::SettingsError;
use crate::training::TrainError;

/// What was wrong, and what would be right.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AdaptError {
    /// The model needs the channels that it was trained with.
    #[error(
        "{0} does not see how fast a camera drives, so it cannot be adapted to another robot; start from rooms, or from a model that was \
         trained with model.flow.speeds"
    )]
    NotAdaptable(ModelName),
    /// A channel to mirror is not in the recording.
    #[error("the data set has no channel \"{name}\" whose sign could change in a mirror; it has: {known}")]
    NoChannel {
        /// The name that was given.
        name: String,
        /// Those that there are.
        known: String,
    },
    /// A room cannot be remembered without the place in it.
    #[error(
        "data set \"{0}\" has no states x, y, heading_cos and heading_sin, so no room can be remembered: nothing says where the robot is in it"
    )]
    NoPose(String),
    /// A room can be remembered only where actions say how the camera will move in it.
    #[error(
        "data set \"{0}\" has no actions, so no room can be remembered: nothing says where in it the camera will be"
    )]
    NoActions(String),
    /// A setting is fixed by the model to start from, or has a field of its own.
    #[error("{0} cannot be set for an adaptation: {1}")]
    Fixed(&'static str, &'static str),
    /// The validation split has too few windows.
    #[error(
        "the data set \"{0}\" has fewer than two windows for validation: some choose the weights, others judge the adapted model; record more"
    )]
    NothingToJudge(String),
    /// The settings cannot be used.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The training was refused.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// The recording could not be predicted.
    #[error(transparent)]
    Evaluation(#[from] EvaluationError),
}

impl HasErrorKind for AdaptError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::NotAdaptable(_)
            | Self::NoChannel { .. }
            | Self::NoPose(_)
            | Self::NoActions(_)
            | Self::Fixed(..)
            | Self::NothingToJudge(_) => ErrorKind::Usage,
            Self::Settings(error) => error.kind(),
            Self::Train(error) => error.kind(),
            Self::Evaluation(error) => error.kind(),
        }
    }
}
