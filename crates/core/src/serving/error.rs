//! Why a prediction failed, and why an input does not fit a model.

use std::sync::Arc;

use crate::error_kind::{ErrorKind, HasErrorKind};
use crate::error_text::comma_separated;
use crate::frame::FrameError;
use crate::nn::NnError;
use crate::types::ModelName;

/// Why a prediction failed.
#[derive(Debug, thiserror::Error)]
pub enum ServingError {
    /// No model of that name is loaded.
    #[error("there is no model \"{name}\"; there are: {}", comma_separated(.available))]
    UnknownModel {
        /// The requested name.
        name: String,
        /// The names of the loaded models.
        available: Vec<ModelName>,
    },
    /// The input does not fit the model.
    #[error(transparent)]
    Input(#[from] InputError),
    /// The queue is full.
    #[error("{capacity} predictions are waiting already; try again in {retry_after_s} s")]
    QueueFull {
        /// How many predictions can wait.
        capacity: usize,
        /// When to try again, in seconds.
        retry_after_s: u64,
    },
    /// The request waited longer than its limit.
    #[error(
        "no prediction within {limit_ms} ms (setting prediction_deadline_ms): the server is overloaded, or the request asks for too many \
         plans or steps"
    )]
    Deadline {
        /// The time limit of a request, in milliseconds.
        limit_ms: u128,
    },
    /// The predictor is stopping, or its thread has ended.
    #[error("the predictor has stopped")]
    Stopped,
    /// The computation panicked. The thread was restarted.
    #[error("the computation of the prediction panicked; the server's log says where")]
    Panicked,
    /// The model's computation failed.
    #[error("model \"{model}\" could not be computed")]
    Model {
        /// The model's name.
        model: ModelName,
        /// What failed.
        #[source]
        source: Arc<NnError>,
    },
    /// The model's output is not an image.
    #[error("the output of model \"{model}\" is not an image")]
    Frame {
        /// The model's name.
        model: ModelName,
        /// What was wrong with it.
        #[source]
        source: FrameError,
    },
    /// The thread that owns the models could not be started.
    #[error("could not start the predictor's thread")]
    Thread(#[source] std::io::Error),
}

impl HasErrorKind for ServingError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::UnknownModel { .. } => ErrorKind::NotFound,
            Self::Input(_) => ErrorKind::Usage,
            Self::QueueFull { .. } | Self::Deadline { .. } | Self::Stopped => ErrorKind::Busy,
            Self::Panicked | Self::Model { .. } | Self::Frame { .. } | Self::Thread(_) => ErrorKind::Internal,
        }
    }
}

/// Why an input does not fit a model. Names the field.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InputError {
    /// The number of frames is not the model's context.
    #[error("frames holds {found} images; model \"{model}\" takes {expected}")]
    FrameCount {
        /// The model's name.
        model: ModelName,
        /// Frames given.
        found: usize,
        /// Frames needed.
        expected: usize,
    },
    /// A frame has another size than the model's.
    #[error("{field} is {width}×{height} px; model \"{model}\" takes {model_width}×{model_height}")]
    FrameSize {
        /// The field, with its index.
        field: String,
        /// The model's name.
        model: ModelName,
        /// Its width in pixels.
        width: u32,
        /// Its height in pixels.
        height: u32,
        /// The model's width in pixels.
        model_width: u32,
        /// The model's height in pixels.
        model_height: u32,
    },
    /// More past actions than frames.
    #[error("actions holds {found} actions; there are {frames} frames, and each has at most one")]
    ActionCount {
        /// Actions given.
        found: usize,
        /// Frames given.
        frames: usize,
    },
    /// The number of past states is not the number of frames before the last one.
    #[error("there are {found} states before the last frame's; model \"{model}\" takes {expected}, one for each frame")]
    PastStates {
        /// The model's name.
        model: ModelName,
        /// States given.
        found: usize,
        /// The model's context without the last frame.
        expected: usize,
    },
    /// The number of actions of a plan is not the number of frames to predict.
    #[error("{field} holds {found} actions; model \"{model}\" takes {expected}")]
    PlanLength {
        /// The field, with its index.
        field: String,
        /// The model's name.
        model: ModelName,
        /// Actions given.
        found: usize,
        /// Actions needed.
        expected: usize,
    },
    /// No or too many frames to predict.
    #[error("steps is {found}; it must be 1 to {most}", most = crate::nn::spec::MAX_STEPS)]
    Steps {
        /// Frames asked for.
        found: usize,
    },
    /// A vector has the wrong length.
    #[error("{field} holds {found} numbers; model \"{model}\" takes {expected}: {channels}")]
    Dimension {
        /// The field, with its index.
        field: String,
        /// The model's name.
        model: ModelName,
        /// Numbers given.
        found: usize,
        /// Numbers needed.
        expected: usize,
        /// Their names and units.
        channels: String,
    },
    /// Plans to compare, but the model takes no actions.
    #[error("model \"{model}\" takes no actions, so all plans give the same prediction; use predict instead")]
    Unconditioned {
        /// The model's name.
        model: ModelName,
    },
    /// A field that the model needs is missing.
    #[error("{field} is missing; model \"{model}\" takes {channels}")]
    Missing {
        /// The field.
        field: &'static str,
        /// The model's name.
        model: ModelName,
        /// Names and units of the numbers it takes.
        channels: String,
    },
}
