//! What a stream of frames remembers from one to the next: features, so that no frame is encoded twice, and what the last
//! future was predicted under. Knows no clock, no socket and no weights: state goes in and comes out.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::compute::Features;
use super::input::InputError;
use super::task::{ConditioningInput, FieldNames, RawConditioning, Task};
use crate::frame::Frame;
use crate::nn::ModelSpec;
use crate::types::{Action, RobotState};

/// Why a memory is not one of the model's.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MemoryError {
    /// More frames than the context.
    #[error("memory.features holds {found} frames; the model keeps at most {most}")]
    FrameCount {
        /// Frames given.
        found: usize,
        /// The model's context.
        most: usize,
    },
    /// A frame of another length.
    #[error("memory.features[{index}] holds {found} numbers; the model's frames have {expected} features")]
    FeatureCount {
        /// Which frame.
        index: usize,
        /// Numbers given.
        found: usize,
        /// The model's features.
        expected: usize,
    },
    /// What no frame can give.
    #[error("memory.features[{index}][{place}] is {value}; a feature is -1 to 1")]
    Feature {
        /// Which frame.
        index: usize,
        /// Which feature.
        place: usize,
        /// Its value.
        value: f32,
    },
    /// More frames than came, or none although some came.
    #[error("memory.next_seq is {next_seq}; that does not go with {frames} frames in memory.features")]
    Count {
        /// As given.
        next_seq: u64,
        /// Frames given.
        frames: usize,
    },
    /// Actions or state that do not fit.
    #[error("memory: {0}")]
    ConditioningInput(#[from] InputError),
}

/// A session's memory as it travels between servers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SessionMemory {
    /// The number that the next frame shall have.
    pub next_seq: u64,
    /// Of the last frames, oldest first, at most the model's context: the features of each, -1 to 1.
    pub features: Vec<Vec<f32>>,
    /// The actions that the last future was predicted under; empty if the model takes none.
    #[schema(value_type = Vec<Vec<f32>>)]
    pub actions: Vec<Action>,
    /// What the robot said of itself at the last frame; absent if the model takes none.
    #[schema(value_type = Option<Vec<f32>>)]
    pub state: Option<RobotState>,
}

/// What a session of one model remembers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SessionState {
    next_seq: u64,
    features: VecDeque<Features>,
    premise: ConditioningInput,
}

impl SessionState {
    /// From a memory of the model named `model`. Errors name what does not fit.
    pub fn restore(memory: SessionMemory, model: &str, spec: &ModelSpec) -> Result<Self, MemoryError> {
        let frames = memory.features.len();
        if frames > spec.context {
            return Err(MemoryError::FrameCount {
                found: frames,
                most: spec.context,
            });
        }
        if (frames == 0) != (memory.next_seq == 0) || memory.next_seq < frames as u64 {
            return Err(MemoryError::Count {
                next_seq: memory.next_seq,
                frames,
            });
        }
        for (index, features) in memory.features.iter().enumerate() {
            check_features(index, features, spec)?;
        }
        let premise = match frames {
            0 => ConditioningInput::default(),
            _ => ConditioningInput::new(
                RawConditioning {
                    past: &[],
                    future: Some(&memory.actions),
                    state: memory.state.as_ref(),
                },
                &MEMORY,
                model,
                spec,
            )?,
        };
        Ok(Self {
            next_seq: memory.next_seq,
            features: memory.features.into_iter().map(Features::from).collect(),
            premise,
        })
    }

    /// All that is needed to go on elsewhere.
    #[must_use]
    pub fn memory(&self) -> SessionMemory {
        SessionMemory {
            next_seq: self.next_seq,
            features: self.features.iter().map(|features| features.to_vec()).collect(),
            actions: self.premise.actions.clone(),
            state: self.premise.state.clone(),
        }
    }

    /// The number that the next frame shall have.
    #[must_use]
    pub fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// Frames in the context, at most the model's.
    #[must_use]
    pub fn have(&self) -> usize {
        self.features.len()
    }

    /// What the robot said of itself at the last frame, if the model takes it.
    #[must_use]
    pub fn robot_state(&self) -> Option<&RobotState> {
        self.premise.state.as_ref()
    }

    /// What to compute for the next frame: its features and, if it fills the context, its future under the premise.
    #[must_use]
    pub fn step(&self, frame: Frame, premise: Option<ConditioningInput>, spec: &ModelSpec) -> Task {
        let spare = (self.features.len() + 1).saturating_sub(spec.context);
        let known: Vec<Features> = self.features.iter().skip(spare).cloned().collect();
        let is_full = known.len() + 1 == spec.context;
        Task {
            known,
            frames: vec![frame],
            premises: premise.filter(|_| is_full).into_iter().collect(),
        }
    }

    /// Keeps what came of the step of frame `seq`.
    pub fn advance(&mut self, seq: u64, features: Features, premise: ConditioningInput, spec: &ModelSpec) {
        self.features.push_back(features);
        while self.features.len() > spec.context {
            self.features.pop_front();
        }
        self.premise = premise;
        self.next_seq = seq.saturating_add(1);
    }

    /// What to compute for the last frame once more; `None` while the context is not full.
    #[must_use]
    pub fn again(&self, spec: &ModelSpec) -> Option<Task> {
        (self.features.len() == spec.context).then(|| self.futures(vec![self.premise.clone()]))
    }

    /// What to compute for the futures that follow the last frame, if the context is full.
    #[must_use]
    pub fn futures(&self, premises: Vec<ConditioningInput>) -> Task {
        Task {
            known: self.features.iter().cloned().collect(),
            frames: Vec::new(),
            premises,
        }
    }
}

const MEMORY: FieldNames = FieldNames {
    past: |_| "actions".to_owned(),
    future: "actions",
    missing: "actions",
};

fn check_features(index: usize, features: &[f32], spec: &ModelSpec) -> Result<(), MemoryError> {
    if features.len() != spec.code_len() {
        return Err(MemoryError::FeatureCount {
            index,
            found: features.len(),
            expected: spec.code_len(),
        });
    }
    // They come out of a hyperbolic tangent, or are a frame's pixels; NaN is in no range.
    match features
        .iter()
        .enumerate()
        .find(|(_, value)| !(-1.0..=1.0).contains(*value))
    {
        Some((place, &value)) => Err(MemoryError::Feature { index, place, value }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::serving::compute;
    use crate::serving::{PredictionInput, predict, test_flow_model, test_model};

    fn frame(seed: u8, width: u32) -> Frame {
        Frame::new(width, 4, (0..4 * width as u8).map(|pixel| (pixel * 7) ^ seed).collect()).unwrap()
    }

    fn action(value: f32) -> Action {
        Action::try_from(vec![value]).unwrap()
    }

    fn premise(value: f32) -> ConditioningInput {
        ConditioningInput {
            actions: vec![action(value); 2],
            state: RobotState::try_from(vec![value]).ok(),
        }
    }

    #[test]
    fn steps_predict_what_whole_windows_do_and_forget_what_is_older() {
        for model in [test_model(), test_flow_model()] {
            check_steps(&model);
        }
    }

    fn check_steps(model: &crate::registry::LoadedModel) {
        let width = model.model.spec().frame_width_px;
        let spec = model.model.spec();
        let (mut state, mut seen) = (SessionState::default(), Vec::new());
        for seq in 0..8u8 {
            let task = state.step(frame(seq, width), Some(premise(f32::from(seq))), spec);
            let computed = compute::run(model, &[&task]).unwrap().remove(0);
            state.advance(
                u64::from(seq),
                computed.features[0].clone(),
                premise(f32::from(seq)),
                spec,
            );
            seen.push(frame(seq, width));
            let Some(start) = seen.len().checked_sub(3) else {
                assert!(computed.futures.is_empty());
                continue;
            };
            let input = PredictionInput {
                frames: seen[start..].to_vec(),
                actions: vec![action(f32::from(seq))],
                state: RobotState::try_from(vec![f32::from(seq)]).ok(),
                future_actions: None,
            };
            assert_eq!(computed.futures, predict(model, &[&input]).unwrap());
            let again = state.again(spec).unwrap();
            assert_eq!(compute::run(model, &[&again]).unwrap()[0].futures, computed.futures);
        }
        assert_eq!((state.next_seq(), state.have()), (8, 3));
    }

    proptest! {
        #[test]
        fn a_memory_is_taken_whole_or_refused(
            next_seq in 0u64..6,
            features in proptest::collection::vec(proptest::collection::vec(-1.2f32..1.2, 4..6), 0..5),
            actions in proptest::collection::vec(-2.0f32..2.0, 0..4),
            state in proptest::option::of(-2.0f32..2.0),
        ) {
            let spec = test_model().model.spec().clone();
            let memory = SessionMemory {
                next_seq,
                features,
                actions: actions.into_iter().map(action).collect(),
                state: state.and_then(|value| RobotState::try_from(vec![value]).ok()),
            };
            let is_sound = memory.features.len() <= 3
                && memory.features.iter().all(|f| f.len() == 5 && f.iter().all(|value| value.abs() <= 1.0))
                && (memory.features.is_empty() == (next_seq == 0) && next_seq >= memory.features.len() as u64)
                && (memory.features.is_empty() || (memory.actions.len() == 2 && memory.state.is_some()));
            match SessionState::restore(memory.clone(), "test", &spec) {
                Ok(restored) => {
                    prop_assert!(is_sound);
                    if next_seq > 0 {
                        prop_assert_eq!(restored.memory(), memory);
                    }
                }
                Err(_) => prop_assert!(!is_sound),
            }
        }
    }

    #[test]
    fn a_memory_with_what_no_frame_gives_is_refused_with_its_place() {
        let spec = test_model().model.spec().clone();
        let mut memory = SessionMemory {
            next_seq: 1,
            features: vec![vec![0.0; 5]],
            actions: vec![action(0.0); 2],
            state: RobotState::try_from(vec![0.0]).ok(),
        };
        memory.features[0][3] = f32::NAN;
        let error = SessionState::restore(memory, "test", &spec).unwrap_err();
        assert_eq!(error.to_string(), "memory.features[0][3] is NaN; a feature is -1 to 1");
    }
}
