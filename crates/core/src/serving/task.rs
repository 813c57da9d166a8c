//! A task for the inference thread, checked before it is queued.

use std::sync::Arc;

use super::conditioning::{ConditioningInput, past_states_used};
use super::error::InputError;
use super::past_errors::PastErrors;
use crate::frame::Frame;
use crate::frame::warp::CameraModel;
use crate::nn::ModelSpec;
use crate::registry::Manifest;
use crate::types::RobotState;

/// The features of one frame, `[F]`; for the flow network its pixels, which are not copied.
pub type Features = Arc<Vec<f32>>;

/// A unit of work for the inference thread. It carries all the state that it needs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Task {
    /// The features of the frames that were encoded before, oldest first.
    pub(super) past_features: Vec<Features>,
    /// The frames to encode, which follow those.
    pub(super) frames: Vec<Frame>,
    /// The states at the context's frames before the last one, oldest first; empty where they are not known or not used.
    pub(super) past_states: Vec<RobotState>,
    /// The camera, if it is another than the model's.
    pub(super) camera: Option<CameraModel>,
    /// One for each rollout; empty while the context is not full.
    pub(super) conditioning_inputs: Vec<ConditioningInput>,
    /// What of the input the model does not use.
    pub(super) warnings: Vec<String>,
    /// Whether the answer tells what stands around the robot. It takes the first rollout's state.
    pub(super) sees_occupancy: bool,
    /// The errors of the session so far.
    pub(super) past_errors: PastErrors,
}

impl Task {
    /// One rollout for each conditioning input from the context in `frames`, with the states at its frames before the last
    /// one and the camera, if they are known. Errors: those of the frames and of the states.
    pub fn rollout(
        frames: Vec<Frame>,
        past_states: Vec<RobotState>,
        camera: Option<CameraModel>,
        conditioning_inputs: Vec<ConditioningInput>,
        manifest: &Manifest,
    ) -> Result<Self, InputError> {
        check_frames(&frames, manifest)?;
        Ok(Self {
            past_states: past_states_used(past_states, manifest)?,
            warnings: unused_inputs(camera.is_some(), &[], manifest),
            camera,
            frames,
            conditioning_inputs,
            ..Self::default()
        })
    }

    /// The same context with other rollouts. `sees_occupancy`: the answer tells what stands around the robot, if
    /// the model estimates depth and there is a rollout.
    #[doc(hidden)]
    #[must_use]
    pub fn with_rollouts(&self, conditioning_inputs: Vec<ConditioningInput>, sees_occupancy: bool) -> Self {
        Self {
            conditioning_inputs,
            sees_occupancy,
            ..self.clone()
        }
    }

    /// The same task after a gap: its frame is not the one that was predicted.
    #[doc(hidden)]
    #[must_use]
    pub fn after_gap(mut self) -> Self {
        self.past_errors.skip();
        self
    }

    /// How many rollouts are computed in a part that may have so many of the horizon's length. Longer ones take as many times as long, and
    /// other requests wait for a part.
    pub(super) fn rollouts_of_part(&self, limit: usize, spec: &ModelSpec) -> usize {
        let steps = self.conditioning_inputs.iter().map(|input| input.steps(spec)).max();
        let horizons = steps.unwrap_or(1).div_ceil(spec.horizon.max(1)).max(1);
        (limit / horizons).max(1)
    }

    /// Splits off what is computed next: the frames, and the first rollouts up to a limit.
    pub(super) fn next_part(&mut self, limit: usize) -> Self {
        if self.conditioning_inputs.len() <= limit {
            return std::mem::take(self);
        }
        let later = self.conditioning_inputs.split_off(limit);
        Self {
            past_features: self.past_features.clone(),
            past_states: self.past_states.clone(),
            camera: self.camera,
            frames: std::mem::take(&mut self.frames),
            conditioning_inputs: std::mem::replace(&mut self.conditioning_inputs, later),
            warnings: Vec::new(),
            sees_occupancy: std::mem::take(&mut self.sees_occupancy),
            past_errors: self.past_errors.clone(),
        }
    }
}

/// A warning for a camera, and for each of the fields with actions that are given, if the model does not use it.
#[must_use]
pub fn unused_inputs(has_camera: bool, action_fields: &[&str], manifest: &Manifest) -> Vec<String> {
    let (model, spec) = (&manifest.name, &manifest.spec);
    let mut warnings = Vec::new();
    if has_camera && !spec.flow().is_some_and(|flow| flow.layers.depth) {
        warnings.push(format!(
            "camera is not used: the model \"{model}\" does not estimate depth"
        ));
    }
    if spec.action_inputs().is_none() {
        let unused = |field| format!("{field} is not used: the model \"{model}\" takes no actions");
        warnings.extend(action_fields.iter().map(unused));
    }
    warnings
}

/// Checks that the frames fill the model's context and have its size.
pub(super) fn check_frames(frames: &[Frame], manifest: &Manifest) -> Result<(), InputError> {
    if frames.len() != manifest.spec.context {
        return Err(InputError::FrameCount {
            model: manifest.name.clone(),
            found: frames.len(),
            expected: manifest.spec.context,
        });
    }
    for (index, frame) in frames.iter().enumerate() {
        let field = format!("frames[{index}]");
        check_size(&field, manifest, (frame.width(), frame.height()))?;
    }
    Ok(())
}

/// Checks that the frame in `field` has the model's width and height in pixels.
pub fn check_size(field: &str, manifest: &Manifest, (width, height): (u32, u32)) -> Result<(), InputError> {
    let (model_width, model_height) = (manifest.spec.frame_width_px, manifest.spec.frame_height_px);
    if (width, height) == (model_width, model_height) {
        return Ok(());
    }
    Err(InputError::FrameSize {
        field: field.to_owned(),
        model: manifest.name.clone(),
        width,
        height,
        model_width,
        model_height,
    })
}
