//! The input of a prediction, and the check that it fits a model.

use super::conditioning::{ConditioningInput, REQUEST_FIELDS, RawConditioning, past_states_used};
use super::error::InputError;
use super::ranges::range_warnings;
use super::task::{Task, check_frames, unused_inputs};
use crate::frame::Frame;
use crate::frame::warp::CameraModel;
use crate::registry::Manifest;
use crate::types::{Action, RobotState};

/// The input of a prediction. A model uses the fields that its conditioning names and ignores the others.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PredictionInput {
    /// The context, oldest first.
    pub frames: Vec<Frame>,
    /// Past actions, oldest first; the last one acts from the last frame on. May be empty. Without a plan, the
    /// last one is held.
    pub actions: Vec<Action>,
    /// The robot's state at the last frame.
    pub state: Option<RobotState>,
    /// The states at the frames before it, oldest first: a model that estimates depth reads from them how the camera has moved.
    /// Empty: it counts as having moved as fast as at the last frame.
    pub past_states: Vec<RobotState>,
    /// The camera, if it is another than the model's. Only a model that estimates depth uses it.
    pub camera: Option<CameraModel>,
    /// The plan: the first action acts from the last frame to the first predicted one.
    pub plan: Option<Vec<Action>>,
    /// Frames to predict; the model's horizon if absent. More are beyond what the model was trained for.
    pub steps: Option<usize>,
}

impl PredictionInput {
    /// Checks that the input fits the model. Errors name the field, its value and the expected value.
    pub fn check(&self, manifest: &Manifest) -> Result<(), InputError> {
        self.checked(manifest).map(drop)
    }

    /// The conditioning input, if the whole input fits the model.
    fn checked(&self, manifest: &Manifest) -> Result<ConditioningInput, InputError> {
        check_frames(&self.frames, manifest)?;
        past_states_used(self.past_states.clone(), manifest)?;
        if self.actions.len() > self.frames.len() {
            return Err(InputError::ActionCount {
                found: self.actions.len(),
                frames: self.frames.len(),
            });
        }
        self.conditioning(manifest)
    }

    /// The conditioning input of the prediction. Errors name the field, its value and the expected value.
    #[doc(hidden)]
    pub fn conditioning(&self, manifest: &Manifest) -> Result<ConditioningInput, InputError> {
        let raw = RawConditioning {
            past: &self.actions,
            plan: self.plan.as_deref(),
            state: self.state.as_ref(),
            steps: self.steps,
        };
        ConditioningInput::new(raw, &REQUEST_FIELDS, manifest)
    }

    /// What in the input the model does not use, and what is out of the range that it saw in training, if the manifest has
    /// ranges. Errors: as [`PredictionInput::check`].
    pub fn warnings(&self, manifest: &Manifest) -> Result<Vec<String>, InputError> {
        let mut warnings = self.unused(manifest);
        warnings.extend(range_warnings(manifest, &[self.conditioning(manifest)?]));
        Ok(warnings)
    }

    /// What in the input the model does not use.
    fn unused(&self, manifest: &Manifest) -> Vec<String> {
        let actions = (!self.actions.is_empty()).then_some("actions");
        let plan = self.plan.is_some().then_some("plan");
        let fields: Vec<&str> = actions.into_iter().chain(plan).collect();
        unused_inputs(self.camera.is_some(), &fields, manifest)
    }

    /// The input as a task with one rollout. Errors: as [`PredictionInput::check`].
    #[doc(hidden)]
    pub fn into_task(self, manifest: &Manifest) -> Result<Task, InputError> {
        Ok(Task {
            conditioning_inputs: vec![self.checked(manifest)?],
            warnings: self.unused(manifest),
            past_states: past_states_used(self.past_states, manifest)?,
            camera: self.camera,
            frames: self.frames,
            ..Task::default()
        })
    }
}
