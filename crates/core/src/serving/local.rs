//! Predictions on the caller's own thread, for a program that has one camera and one model and needs no [`super::Predictor`].

use super::input::check_size;
use super::ranges::range_warnings;
use super::task::{REQUEST_FIELDS, RawConditioning};
use super::{ConditioningInput, InputError, Rollout, ServingError, SessionState, compute};
use crate::frame::Frame;
use crate::registry::{LoadedModel, Manifest};
use crate::types::{Action, RobotState};

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
        Self::new(raw, &REQUEST_FIELDS, &loaded.manifest.name, loaded.model.spec())
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
        let spec = loaded.model.spec();
        check_size("frame", &loaded.manifest.name, spec, (frame.width(), frame.height()))?;
        let task = self.step(frame, Some(conditioning.clone()), spec);
        let mut outputs = compute::run(loaded, &[&task])?;
        let output = outputs.pop().expect("a task without an output is a bug");
        let seq = self.next_seq();
        for features in output.features {
            self.advance(seq, features, conditioning.clone(), spec);
        }
        Ok(output.predictions.into_iter().next())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serving::{PredictionInput, predict, test_model};

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
