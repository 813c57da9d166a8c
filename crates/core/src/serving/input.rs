//! The input of a prediction, and the check that it fits a model.

use super::ranges::range_warnings;
use super::task::{ConditioningInput, REQUEST_FIELDS, RawConditioning, Task};
use crate::frame::Frame;
use crate::nn::ModelSpec;
use crate::registry::Manifest;
use crate::types::{Action, RobotState};

/// Why an input does not fit a model. Names the field.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InputError {
    /// The number of frames is not the model's context.
    #[error("frames holds {found} images; model \"{model}\" takes {expected}")]
    FrameCount {
        /// The model's name.
        model: String,
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
    /// The number of future actions is not the model's horizon.
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
        model: String,
        /// Numbers given.
        found: usize,
        /// Numbers needed.
        expected: usize,
        /// Their names and units.
        channels: String,
    },
    /// Plans to compare, but the model takes no actions.
    #[error("model \"{model}\" takes no actions, so all candidates give the same prediction; use predict instead")]
    Unconditioned {
        /// The model's name.
        model: String,
    },
    /// A field that the model needs is missing.
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

/// The input of a prediction. A model uses the fields that its conditioning names and ignores the others.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PredictionInput {
    /// The context, oldest first.
    pub frames: Vec<Frame>,
    /// Past actions, oldest first; the last one acts from the last frame on. May be empty. Without future actions, the
    /// last one is held.
    pub actions: Vec<Action>,
    /// The robot's state at the last frame.
    pub state: Option<RobotState>,
    /// The plan: the first action acts from the last frame to the first predicted one.
    pub future_actions: Option<Vec<Action>>,
    /// Frames to predict; the model's horizon if absent. More are beyond what the model was trained for.
    pub steps: Option<usize>,
}

impl PredictionInput {
    /// Checks that the input fits the model named `model`. Errors name the field, its value and the expected value.
    pub fn check(&self, model: &str, spec: &ModelSpec) -> Result<(), InputError> {
        self.check_frames(model, spec)?;
        if self.actions.len() > self.frames.len() {
            return Err(InputError::ActionCount {
                found: self.actions.len(),
                frames: self.frames.len(),
            });
        }
        self.conditioning(model, spec).map(|_| ())
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

    /// The conditioning input of the prediction. Errors name the field, its value and the expected value.
    pub fn conditioning(&self, model: &str, spec: &ModelSpec) -> Result<ConditioningInput, InputError> {
        let raw = RawConditioning {
            past: &self.actions,
            future: self.future_actions.as_deref(),
            state: self.state.as_ref(),
            steps: self.steps,
        };
        ConditioningInput::new(raw, &REQUEST_FIELDS, model, spec)
    }

    /// What in the input is out of the range that the model saw in training; nothing if the manifest has no ranges.
    /// Errors: as [`PredictionInput::check`].
    pub fn warnings(&self, manifest: &Manifest) -> Result<Vec<String>, InputError> {
        let conditioning = self.conditioning(&manifest.name, &manifest.spec)?;
        Ok(range_warnings(manifest, &[conditioning]))
    }

    /// The input as a task with one rollout. Errors: as [`PredictionInput::check`].
    pub fn into_task(self, model: &str, spec: &ModelSpec) -> Result<Task, InputError> {
        self.check(model, spec)?;
        Ok(Task {
            conditioning_inputs: vec![self.conditioning(model, spec)?],
            frames: self.frames,
            ..Task::default()
        })
    }
}

/// Checks that the frame in `field` has the model's width and height in pixels.
pub fn check_size(field: &str, model: &str, spec: &ModelSpec, (width, height): (u32, u32)) -> Result<(), InputError> {
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
