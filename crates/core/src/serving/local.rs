//! Predictions on the caller's own thread, for a program that has one camera and one model and needs no [`super::Predictor`].

use std::sync::Arc;

use super::compute;
use super::conditioning::{ConditioningInput, REQUEST_FIELDS, RawConditioning};
use super::error::ServingError;
use super::input::PredictionInput;
use super::prediction::{Prediction, Rollout};
use super::ranges::range_warnings;
use super::session::{SessionSnapshot, SessionState, SnapshotError};
use super::task::{Task, check_size};
use crate::frame::Frame;
use crate::frame::warp::CameraModel;
use crate::registry::Model;
use crate::types::{Action, RobotState};

/// The predicted frames of each input, in order, computed as one batch. Errors: `Input` if one does not fit the model,
/// `Model`, `Frame`.
pub fn predict(loaded: &Model, inputs: &[&PredictionInput]) -> Result<Vec<Rollout>, ServingError> {
    let tasks = inputs
        .iter()
        .map(|input| Ok((*input).clone().into_task(&loaded.manifest)?))
        .collect::<Result<Vec<Task>, ServingError>>()?;
    rollouts(loaded, &tasks)
}

/// Computes one task. Errors: as [`predict`].
#[doc(hidden)]
pub fn compute_task(loaded: &Model, task: &Task) -> Result<Prediction, ServingError> {
    let prediction = compute::run(loaded, &[task])?.pop();
    Ok(prediction.expect("a task without a prediction is a bug"))
}

/// The rollouts of all tasks, in order.
fn rollouts(loaded: &Model, tasks: &[Task]) -> Result<Vec<Rollout>, ServingError> {
    let predictions = compute::run(loaded, &tasks.iter().collect::<Vec<_>>())?.into_iter();
    Ok(predictions.flat_map(|prediction| prediction.rollouts).collect())
}

/// A stream of frames with one model, on the caller's own thread. Each frame is encoded once: the session keeps the features
/// of the last frames.
#[derive(Clone)]
pub struct Session {
    model: Arc<Model>,
    state: SessionState,
}

impl Session {
    /// A session before its first frame.
    #[must_use]
    pub fn new(model: Arc<Model>) -> Self {
        Self {
            model,
            state: SessionState::default(),
        }
    }

    /// Continues an exported session. Errors: what of the snapshot does not fit the model.
    pub fn restore(model: Arc<Model>, snapshot: SessionSnapshot) -> Result<Self, SnapshotError> {
        let state = SessionState::restore(snapshot, &model.manifest)?;
        Ok(Self { model, state })
    }

    /// From now on the frames are this camera's. Only a model that estimates depth uses it; without it, the model's counts.
    pub fn set_camera(&mut self, camera: CameraModel) {
        self.state.set_camera(camera);
    }

    /// Takes the next frame and predicts the frames that follow; `None` until the context is full. `state` is the robot's
    /// state at this frame. `plan` holds one action for each predicted frame; the first acts from this frame to
    /// the first predicted one. A model ignores what it does not take. Errors: `Input` if something does not fit the model,
    /// and what the computation fails with; the session is then as before.
    pub fn step(
        &mut self,
        frame: Frame,
        state: Option<&RobotState>,
        plan: Option<&[Action]>,
    ) -> Result<Option<Rollout>, ServingError> {
        let manifest = &self.model.manifest;
        let raw = RawConditioning {
            past: &[],
            plan,
            state,
            steps: None,
        };
        let conditioning = ConditioningInput::new(raw, &REQUEST_FIELDS, manifest)?;
        check_size("frame", manifest, (frame.width(), frame.height()))?;
        let task = self.state.step(frame, Some(conditioning.clone()), &manifest.spec);
        let mut predictions = compute::run(&self.model, &[&task])?;
        let mut prediction = predictions.pop().expect("a task without a prediction is a bug");
        let seq = self.state.next_seq();
        self.state.advance(seq, &mut prediction, conditioning, &manifest.spec);
        Ok(prediction.rollouts.into_iter().next())
    }

    /// Predicts one rollout for each plan from the last frame and state: one action for each frame to predict, the same
    /// number in all plans. Empty until the context is full. Errors: `Input` if a plan does not fit the model.
    pub fn rollouts(&self, plans: Vec<Vec<Action>>) -> Result<Vec<Rollout>, ServingError> {
        // Also while there is no state to predict from.
        if plans.is_empty() || self.state.frame_count() < self.model.spec().context {
            return Ok(Vec::new());
        }
        let steps = plans.first().map(Vec::len);
        let state = self.state.robot_state().cloned();
        let inputs = ConditioningInput::of_plans(plans, state, steps, &self.model.manifest)?;
        rollouts(&self.model, &[self.state.rollout_task(inputs, self.model.spec())])
    }

    /// What of the last state and actions was out of the range that the model saw in training; nothing if its manifest has
    /// no ranges.
    #[must_use]
    pub fn warnings(&self) -> Vec<String> {
        range_warnings(&self.model.manifest, std::slice::from_ref(&self.state.conditioning))
    }

    /// What another program or server needs to continue the session.
    #[must_use]
    pub fn snapshot(&self) -> SessionSnapshot {
        self.state.snapshot()
    }

    /// Its model.
    #[must_use]
    pub fn model(&self) -> &Model {
        &self.model
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serving::{test_depth_model, test_flow_model, test_model};

    #[test]
    fn a_session_predicts_the_same_as_a_window() {
        let model = test_model();
        let (actions, state) = (
            vec![Action::try_from(vec![0.5]).unwrap(); 2],
            RobotState::try_from(vec![-0.5]).unwrap(),
        );
        let frames: Vec<Frame> = (0..3).map(|i| Frame::new(6, 4, vec![i * 40; 24]).unwrap()).collect();
        let mut session = Session::new(Arc::new(model.clone()));
        let mut predicted = None;
        for frame in frames.clone() {
            assert_eq!(predicted, None);
            assert!(session.rollouts(vec![actions.clone()]).unwrap().is_empty());
            predicted = session.step(frame, Some(&state), Some(&actions)).unwrap();
        }
        let again = Session::restore(Arc::new(model.clone()), session.snapshot()).unwrap();
        let shorter = again.rollouts(vec![actions[..1].to_vec(); 2]).unwrap();
        assert_eq!(
            again.rollouts(vec![actions.clone()]).unwrap(),
            predicted.clone().into_iter().collect::<Vec<_>>()
        );
        assert_eq!((shorter.len(), shorter[0].frames.len()), (2, 1));
        let input = PredictionInput {
            frames,
            state: Some(state),
            plan: Some(actions),
            ..PredictionInput::default()
        };
        assert_eq!(predicted.unwrap(), predict(&model, &[&input]).unwrap().remove(0));
    }

    fn frame(seed: u8, width: u32) -> Frame {
        Frame::new(width, 4, (0..4 * width as u8).map(|pixel| (pixel * 7) ^ seed).collect()).unwrap()
    }

    fn action(value: f32) -> Action {
        Action::try_from(vec![value]).unwrap()
    }

    fn conditioning(value: f32) -> ConditioningInput {
        ConditioningInput {
            actions: vec![action(value); 2],
            state: RobotState::try_from(vec![value]).ok(),
            steps: None,
        }
    }

    #[test]
    fn steps_predict_the_same_as_whole_windows() {
        for model in [test_model(), test_flow_model()] {
            check_steps(&model);
        }
    }

    fn check_steps(model: &Model) {
        let width = model.spec().frame_width_px;
        let spec = model.spec();
        let (mut state, mut seen) = (SessionState::default(), Vec::new());
        for seq in 0..8u8 {
            let task = state.step(frame(seq, width), Some(conditioning(f32::from(seq))), spec);
            let mut computed = compute::run(model, &[&task]).unwrap().remove(0);
            state.advance(u64::from(seq), &mut computed, conditioning(f32::from(seq)), spec);
            seen.push(frame(seq, width));
            let Some(start) = seen.len().checked_sub(3) else {
                assert!(computed.rollouts.is_empty());
                continue;
            };
            let input = PredictionInput {
                frames: seen[start..].to_vec(),
                actions: vec![action(f32::from(seq))],
                state: RobotState::try_from(vec![f32::from(seq)]).ok(),
                ..PredictionInput::default()
            };
            assert_eq!(computed.rollouts, predict(model, &[&input]).unwrap());
            let repeated = state.repeat_task(spec).unwrap();
            assert_eq!(
                compute::run(model, &[&repeated]).unwrap()[0].rollouts,
                computed.rollouts
            );
        }
        assert_eq!((state.next_seq(), state.frame_count()), (8, 3));
    }

    #[test]
    fn a_session_keeps_how_the_camera_moved() {
        let model = Arc::new(test_depth_model());
        let state = |seq: u8| RobotState::try_from(vec![0.1 * f32::from(seq * seq), 0.0, 1.0, 0.0]).unwrap();
        let plan = vec![action(0.5); 2];
        let mut session = Session::new(Arc::clone(&model));
        for seq in 0..6u8 {
            // Also after the session moved to another program.
            session = Session::restore(Arc::clone(&model), session.snapshot()).unwrap();
            let predicted = session.step(frame(seq, 8), Some(&state(seq)), Some(&plan)).unwrap();
            let Some(start) = seq.checked_sub(2) else { continue };
            let input = |past_states| PredictionInput {
                frames: (start..=seq).map(|seq| frame(seq, 8)).collect(),
                state: Some(state(seq)),
                past_states,
                plan: Some(plan.clone()),
                ..PredictionInput::default()
            };
            let known = predict(&model, &[&input(vec![state(start), state(seq - 1)])]).unwrap();
            let unknown = predict(&model, &[&input(Vec::new())]).unwrap();
            assert_eq!(predicted.as_ref(), known.first());
            assert_ne!(known, unknown);
            assert_eq!(session.rollouts(vec![plan.clone()]).unwrap(), known);
        }
    }

    #[test]
    fn a_frame_of_another_size_leaves_the_session_unchanged() {
        let mut session = Session::new(Arc::new(test_model()));
        let (state, actions) = (RobotState::try_from(vec![0.0]).unwrap(), vec![action(0.0); 2]);
        let frame = Frame::new(5, 4, vec![0; 20]).unwrap();
        let error = session.step(frame, Some(&state), Some(&actions)).unwrap_err();
        assert_eq!(error.to_string(), "frame is 5×4 px; model \"test\" takes 6×4");
        assert_eq!(session.snapshot(), SessionState::default().snapshot());
    }
}
