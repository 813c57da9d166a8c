//! A task for the inference thread, checked before it is queued.

use std::sync::Arc;

use super::conditioning::ConditioningInput;
use super::error::InputError;
use crate::frame::Frame;
use crate::nn::ModelSpec;
use crate::types::ModelName;

/// The features of one frame, `[F]`.
pub type Features = Arc<[f32]>;

/// A unit of work for the inference thread. It carries all the state that it needs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Task {
    /// The features of the frames that were encoded before, oldest first.
    pub(super) past_features: Vec<Features>,
    /// The frames to encode, which follow those.
    pub(super) frames: Vec<Frame>,
    /// One for each rollout; empty while the context is not full.
    pub(super) conditioning_inputs: Vec<ConditioningInput>,
}

impl Task {
    /// One rollout for each conditioning input from the context in `frames`. Errors: those of the frames.
    pub fn rollout(
        frames: Vec<Frame>,
        conditioning_inputs: Vec<ConditioningInput>,
        model: &ModelName,
        spec: &ModelSpec,
    ) -> Result<Self, InputError> {
        check_frames(&frames, model, spec)?;
        Ok(Self {
            frames,
            conditioning_inputs,
            ..Self::default()
        })
    }

    /// Splits off what is computed next: the frames, and the first rollouts up to a limit.
    pub(super) fn next_part(&mut self, limit: usize) -> Self {
        if self.conditioning_inputs.len() <= limit {
            return std::mem::take(self);
        }
        let later = self.conditioning_inputs.split_off(limit);
        Self {
            past_features: self.past_features.clone(),
            frames: std::mem::take(&mut self.frames),
            conditioning_inputs: std::mem::replace(&mut self.conditioning_inputs, later),
        }
    }
}

/// Checks that the frames fill the model's context and have its size.
pub(super) fn check_frames(frames: &[Frame], model: &ModelName, spec: &ModelSpec) -> Result<(), InputError> {
    if frames.len() != spec.context {
        return Err(InputError::FrameCount {
            model: model.clone(),
            found: frames.len(),
            expected: spec.context,
        });
    }
    for (index, frame) in frames.iter().enumerate() {
        check_size(
            &format!("frames[{index}]"),
            model,
            spec,
            (frame.width(), frame.height()),
        )?;
    }
    Ok(())
}

/// Checks that the frame in `field` has the model's width and height in pixels.
pub fn check_size(
    field: &str,
    model: &ModelName,
    spec: &ModelSpec,
    (width, height): (u32, u32),
) -> Result<(), InputError> {
    if (width, height) == (spec.frame_width_px, spec.frame_height_px) {
        return Ok(());
    }
    Err(InputError::FrameSize {
        field: field.to_owned(),
        model: model.clone(),
        width,
        height,
        model_width: spec.frame_width_px,
        model_height: spec.frame_height_px,
    })
}
