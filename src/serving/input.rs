//! What a prediction takes, and whether it fits a model.

use super::task::{ConditioningInput, REQUEST, RawConditioning, Task};
use crate::frame::Frame;
use crate::nn::ModelSpec;
use crate::types::{Action, RobotState};

/// What does not fit, by the name of the field.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InputError {
    /// Not as many frames as the model's context.
    #[error("frames holds {found} images; model \"{model}\" takes {expected}")]
    FrameCount {
        /// The model's name.
        model: String,
        /// Frames given.
        found: usize,
        /// Frames needed.
        expected: usize,
    },
    /// A frame of another size.
    #[error("{field} is {width}×{height} px; model \"{model}\" takes {model_width}×{model_height}")]
    FrameSize {
        /// The field, with its index.
        field: String,
        /// The model's name.
        model: String,
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
    /// Not as many future actions as the model's horizon.
    #[error("{field} holds {found} actions; model \"{model}\" takes {expected}")]
    FutureActionCount {
        /// The field, with its index.
        field: String,
        /// The model's name.
        model: String,
        /// Actions given.
        found: usize,
        /// Actions needed.
        expected: usize,
    },
    /// A vector of another length.
    #[error("{field} holds {found} numbers; model \"{model}\" takes {expected}: {channels}")]
    Dimension {
        /// The field, with its index.
        field: String,
        /// The model's name.
        model: String,
        /// Numbers given.
        found: usize,
        /// Numbers needed.
        expected: usize,
        /// Their names and units.
        channels: String,
    },
    /// Candidates to tell apart, and a model that is told nothing.
    #[error("model \"{model}\" takes no actions, so every candidate has the same future; ask for one by predict")]
    Unconditioned {
        /// The model's name.
        model: String,
    },
    /// The model needs it and it was not given.
    #[error("{field} is missing; model \"{model}\" takes {channels}")]
    Missing {
        /// The field.
        field: &'static str,
        /// The model's name.
        model: String,
        /// Names and units of the numbers it takes.
        channels: String,
    },
}

/// What a prediction starts from. A model takes what its conditioning says and ignores the rest.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PredictionInput {
    /// The context, oldest first.
    pub frames: Vec<Frame>,
    /// Past actions, oldest first, the last one under way at the last frame; may be empty. The last one is held where
    /// there are no future actions.
    pub actions: Vec<Action>,
    /// What the robot says of itself at the last frame.
    pub state: Option<RobotState>,
    /// The actions to predict under: the first acts from the last frame to the first predicted one.
    pub future_actions: Option<Vec<Action>>,
}

impl PredictionInput {
    /// Whether the model named `model` takes this. Errors name the field, what it is and what it should be.
    pub fn check(&self, model: &str, spec: &ModelSpec) -> Result<(), InputError> {
        self.check_frames(model, spec)?;
        if self.actions.len() > self.frames.len() {
            return Err(InputError::ActionCount {
                found: self.actions.len(),
                frames: self.frames.len(),
            });
        }
        self.premise(model, spec).map(|_| ())
    }

    pub(super) fn check_frames(&self, model: &str, spec: &ModelSpec) -> Result<(), InputError> {
        if self.frames.len() != spec.context {
            return Err(InputError::FrameCount {
                model: model.to_owned(),
                found: self.frames.len(),
                expected: spec.context,
            });
        }
        for (index, frame) in self.frames.iter().enumerate() {
            check_size(
                &format!("frames[{index}]"),
                model,
                spec,
                (frame.width(), frame.height()),
            )?;
        }
        Ok(())
    }

    /// What the future is predicted under. Errors name the field, what it is and what it should be.
    pub(crate) fn premise(&self, model: &str, spec: &ModelSpec) -> Result<ConditioningInput, InputError> {
        let told = RawConditioning {
            past: &self.actions,
            future: self.future_actions.as_deref(),
            state: self.state.as_ref(),
        };
        ConditioningInput::new(told, &REQUEST, model, spec)
    }

    /// All of it as a task of one future. Errors: as [`PredictionInput::check`].
    pub(crate) fn into_task(self, model: &str, spec: &ModelSpec) -> Result<Task, InputError> {
        self.check(model, spec)?;
        Ok(Task {
            premises: vec![self.premise(model, spec)?],
            frames: self.frames,
            ..Task::default()
        })
    }
}

/// Whether the frame in `field`, of that width and height in pixels, is of the model's size.
pub(crate) fn check_size(
    field: &str,
    model: &str,
    spec: &ModelSpec,
    (width, height): (u32, u32),
) -> Result<(), InputError> {
    if (width, height) == (spec.frame_width_px, spec.frame_height_px) {
        return Ok(());
    }
    Err(InputError::FrameSize {
        field: field.to_owned(),
        model: model.to_owned(),
        width,
        height,
        model_width: spec.frame_width_px,
        model_height: spec.frame_height_px,
    })
}
