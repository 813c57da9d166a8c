//! Predictions on the caller's own thread, for a program that has one camera and one model and needs no [`super::Predictor`].

use super::compute;
use super::conditioning::{ConditioningInput, REQUEST_FIELDS, RawConditioning};
use super::error::{InputError, ServingError};
use super::input::PredictionInput;
use super::prediction::Rollout;
use super::ranges::range_warnings;
use super::session::SessionState;
use super::task::{Task, check_size};
use crate::frame::Frame;
use crate::registry::{LoadedModel, Manifest};
use crate::types::{Action, RobotState};

/// The predicted frames of each input, in order, computed as one batch. Errors: `Input` if one does not fit the model,
/// `Model`, `Tensor`, `Frame`.
pub fn predict(loaded: &LoadedModel, inputs: &[&PredictionInput]) -> Result<Vec<Rollout>, ServingError> {
    let tasks = inputs
        .iter()
        .map(|input| {
            Ok((*input)
                .clone()
                .into_task(&loaded.manifest.name, loaded.network.spec())?)
        })
        .collect::<Result<Vec<Task>, ServingError>>()?;
    let predictions = compute::run(loaded, &tasks.iter().collect::<Vec<_>>())?;
    Ok(predictions
        .into_iter()
        .flat_map(|prediction| prediction.rollouts)
        .collect())
}

impl ConditioningInput {
    /// The conditioning input of one prediction. `future_actions` holds one action for each predicted frame; the first
    /// acts from the last frame to the first predicted one. A model ignores what it does not take. Errors name the field,
    /// its value and the expected value.
    pub fn for_model(
        loaded: &LoadedModel,
        future_actions: Option<&[Action]>,
        state: Option<&RobotState>,
    ) -> Result<Self, InputError> {
        let raw = RawConditioning {
            past: &[],
            future: future_actions,
            state,
            steps: None,
        };
        Self::new(raw, &REQUEST_FIELDS, &loaded.manifest.name, loaded.network.spec())
    }

    /// What is out of the range that the model saw in training; nothing if its manifest has no ranges.
    #[must_use]
    pub fn warnings(&self, manifest: &Manifest) -> Vec<String> {
        range_warnings(manifest, std::slice::from_ref(self))
    }
}

impl SessionState {
    /// Encodes the next frame, keeps its features, and predicts the frames that follow; `None` until the context is full.
    /// Always give a session the same model. Errors: `Input` if the frame has another size than the model's, and what the
    /// computation fails with; the state is then as before.
    pub fn predict_next(
        &mut self,
        loaded: &LoadedModel,
        frame: Frame,
        conditioning: &ConditioningInput,
    ) -> Result<Option<Rollout>, ServingError> {
        let spec = loaded.network.spec();
        check_size("frame", &loaded.manifest.name, spec, (frame.width(), frame.height()))?;
        let task = self.step(frame, Some(conditioning.clone()), spec);
        let mut predictions = compute::run(loaded, &[&task])?;
        let prediction = predictions.pop().expect("a task without a prediction is a bug");
        let seq = self.next_seq();
        for features in prediction.features {
            self.advance(seq, features, conditioning.clone(), spec);
        }
        Ok(prediction.rollouts.into_iter().next())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serving::{test_flow_model, test_model};

    #[test]
    fn a_session_predicts_the_same_as_a_window() {
        let model = test_model();
        let (actions, state) = (
            vec![Action::try_from(vec![0.5]).unwrap(); 2],
            RobotState::try_from(vec![-0.5]).unwrap(),
        );
        let conditioning = ConditioningInput::for_model(&model, Some(&actions), Some(&state)).unwrap();
        let frames: Vec<Frame> = (0..3).map(|i| Frame::new(6, 4, vec![i * 40; 24]).unwrap()).collect();
        let mut session = SessionState::default();
        let mut predicted = None;
        for frame in frames.clone() {
            assert_eq!(predicted, None);
            predicted = session.predict_next(&model, frame, &conditioning).unwrap();
        }
        let input = PredictionInput {
            frames,
            state: Some(state),
            future_actions: Some(actions),
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

    fn check_steps(model: &LoadedModel) {
        let width = model.network.spec().frame_width_px;
        let spec = model.network.spec();
        let (mut state, mut seen) = (SessionState::default(), Vec::new());
        for seq in 0..8u8 {
            let task = state.step(frame(seq, width), Some(conditioning(f32::from(seq))), spec);
            let computed = compute::run(model, &[&task]).unwrap().remove(0);
            state.advance(
                u64::from(seq),
                computed.features[0].clone(),
                conditioning(f32::from(seq)),
                spec,
            );
            seen.push(frame(seq, width));
            let Some(start) = seen.len().checked_sub(3) else {
                assert!(computed.rollouts.is_empty());
                continue;
            };
            let input = PredictionInput {
                frames: seen[start..].to_vec(),
                actions: vec![action(f32::from(seq))],
                state: RobotState::try_from(vec![f32::from(seq)]).ok(),
                future_actions: None,
                steps: None,
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
    fn a_frame_of_another_size_leaves_the_session_unchanged() {
        let (model, mut session) = (test_model(), SessionState::default());
        let frame = Frame::new(5, 4, vec![0; 20]).unwrap();
        let error = session
            .predict_next(&model, frame, &ConditioningInput::default())
            .unwrap_err();
        assert_eq!(error.to_string(), "frame is 5×4 px; model \"test\" takes 6×4");
        assert_eq!(session, SessionState::default());
    }
}
