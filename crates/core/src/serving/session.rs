//! The state of a session: the features of the last frames, so that no frame is encoded twice, and the last conditioning
//! input. Pure: it has no clock, socket or weights.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::conditioning::{ConditioningInput, FieldNames, RawConditioning, check_states};
use super::error::InputError;
use super::past_errors::PastErrors;
use super::prediction::Prediction;
use super::task::{Features, Task};
use crate::frame::Frame;
use crate::frame::warp::CameraModel;
use crate::nn::ModelSpec;
use crate::registry::Manifest;
use crate::types::{Action, RobotState};

/// Why an imported session state does not fit the model.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SnapshotError {
    /// More frames than the context.
    #[error("snapshot.features holds {found} frames; the model keeps at most {most}")]
    FrameCount {
        /// Frames given.
        found: usize,
        /// The model's context.
        most: usize,
    },
    /// A frame has the wrong number of features.
    #[error("snapshot.features[{index}] holds {found} numbers; the model's frames have {expected} features")]
    FeatureCount {
        /// Which frame.
        index: usize,
        /// Numbers given.
        found: usize,
        /// The model's features.
        expected: usize,
    },
    /// A value that no frame can produce.
    #[error("snapshot.features[{index}][{place}] is {value}; a feature is -1 to 1")]
    Feature {
        /// Which frame.
        index: usize,
        /// Which feature.
        place: usize,
        /// Its value.
        value: f32,
    },
    /// `next_seq` contradicts the number of frames.
    #[error("snapshot.next_seq is {next_seq}; that contradicts the {frames} frames in snapshot.features")]
    Count {
        /// As given.
        next_seq: u64,
        /// Frames given.
        frames: usize,
    },
    /// More past states than frames before the last one.
    #[error(
        "snapshot.past_states holds {found} states; snapshot.features holds {frames} frames, and the last one's is in snapshot.state"
    )]
    StateCount {
        /// States given.
        found: usize,
        /// Frames given.
        frames: usize,
    },
    /// More past errors than predicted steps, or numbers that no errors give.
    #[error(
        "snapshot.past_errors[{index}] is not possible: the model predicts {horizon} steps; of the two numbers of a step, the second is 0 to \
         10, and the first between -7 and 7 times the second"
    )]
    PastError {
        /// Which one.
        index: usize,
        /// Steps that the model predicts.
        horizon: usize,
    },
    /// The actions or the state do not fit the model.
    #[error("snapshot: {0}")]
    ConditioningInput(#[from] InputError),
}

/// The exported state of a session: what another server needs to continue it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct SessionSnapshot {
    /// The expected sequence number of the next frame.
    pub next_seq: u64,
    /// The features of the last frames, oldest first, -1 to 1; at most as many frames as the model's context.
    pub features: Vec<Vec<f32>>,
    /// The actions of the last conditioning input; empty if the model takes none.
    #[cfg_attr(feature = "schema", schema(value_type = Vec<Vec<f32>>))]
    pub actions: Vec<Action>,
    /// The robot's state at the last frame; absent if the model takes none.
    #[cfg_attr(feature = "schema", schema(value_type = Option<Vec<f32>>))]
    pub state: Option<RobotState>,
    /// The states at the frames before it, oldest first, if the model reads them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(value_type = Vec<Vec<f32>>))]
    pub past_states: Vec<RobotState>,
    /// The camera, if it is another than the model's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraModel>,
    /// How many frames the last prediction had; absent: the model's horizon.
    #[cfg_attr(feature = "schema", schema(minimum = 1, maximum = 256))]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<usize>,
    /// Of each predicted step, how large its errors were so far: the sum of the natural logarithms of the errors over the middles of their
    /// bands, and for how many errors it counts, 0 to 10. Both fade with each new error. Absent if no error is known.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(value_type = Vec<Vec<f32>>))]
    pub past_errors: Vec<[f32; 2]>,
}

/// The state of a session with one model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SessionState {
    next_seq: u64,
    features: VecDeque<Features>,
    /// The states at the frames before the last one, at most one less than the context; kept if the model reads them.
    past_states: VecDeque<RobotState>,
    /// If it is another than the model's.
    camera: Option<CameraModel>,
    /// The last one.
    pub(super) conditioning: ConditioningInput,
    /// Those of its predictions.
    past_errors: PastErrors,
}

impl SessionState {
    /// Restores an exported state for the model. Errors name the field that does not fit.
    pub fn restore(snapshot: SessionSnapshot, manifest: &Manifest) -> Result<Self, SnapshotError> {
        let spec = &manifest.spec;
        let frames = snapshot.features.len();
        if frames > spec.context {
            return Err(SnapshotError::FrameCount {
                found: frames,
                most: spec.context,
            });
        }
        if (frames == 0) != (snapshot.next_seq == 0) || snapshot.next_seq < frames as u64 {
            return Err(SnapshotError::Count {
                next_seq: snapshot.next_seq,
                frames,
            });
        }
        for (index, features) in snapshot.features.iter().enumerate() {
            check_features(index, features, spec)?;
        }
        let raw = RawConditioning {
            past: &[],
            plan: (!snapshot.actions.is_empty() || !spec.sees_speeds()).then_some(&*snapshot.actions),
            state: snapshot.state.as_ref(),
            steps: snapshot.steps,
        };
        let conditioning = match frames {
            0 => ConditioningInput::default(),
            _ => ConditioningInput::new(raw, &SNAPSHOT_FIELDS, manifest)?,
        };
        if snapshot.past_states.len() >= frames.max(1) {
            return Err(SnapshotError::StateCount {
                found: snapshot.past_states.len(),
                frames,
            });
        }
        let horizon = spec.horizon;
        let past_errors = PastErrors::restored(&snapshot.past_errors, horizon)
            .map_err(|index| SnapshotError::PastError { index, horizon })?;
        let past_states = if spec.reads_past_states() {
            check_states(snapshot.past_states, manifest)?
        } else {
            Vec::new()
        };
        Ok(Self {
            past_states: past_states.into(),
            camera: snapshot.camera,
            next_seq: snapshot.next_seq,
            features: snapshot.features.into_iter().map(shrunk).collect(),
            conditioning,
            past_errors,
        })
    }

    /// Exports the state, so that another server can continue the session.
    #[must_use]
    pub fn snapshot(&self) -> SessionSnapshot {
        SessionSnapshot {
            next_seq: self.next_seq,
            features: self.features.iter().map(|features| features.to_vec()).collect(),
            actions: self.conditioning.actions.clone(),
            state: self.conditioning.state.clone(),
            past_states: self.past_states.iter().cloned().collect(),
            camera: self.camera,
            steps: self.conditioning.steps,
            past_errors: self.past_errors.numbers(),
        }
    }

    /// From now on the frames are this camera's. Only a model that estimates depth uses it.
    pub fn set_camera(&mut self, camera: CameraModel) {
        self.camera = Some(camera);
    }

    /// The expected sequence number of the next frame.
    #[must_use]
    pub fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// How many frames the context holds now, at most the model's context.
    #[must_use]
    pub fn frame_count(&self) -> usize {
        self.features.len()
    }

    /// The camera, if it is another than the model's.
    #[must_use]
    pub fn camera(&self) -> Option<CameraModel> {
        self.camera
    }

    /// The robot's state at the last frame, if the model takes it.
    #[must_use]
    pub fn robot_state(&self) -> Option<&RobotState> {
        self.conditioning.state.as_ref()
    }

    /// The actions that the last prediction took: the plan that the robot follows now. Empty if the model takes none.
    #[must_use]
    pub fn present_plan(&self) -> &[Action] {
        &self.conditioning.actions
    }

    /// The task for the next frame: encode it and, if it fills the context, predict under the conditioning input.
    #[must_use]
    pub fn step(&self, frame: Frame, conditioning: Option<ConditioningInput>, spec: &ModelSpec) -> Task {
        let spare = (self.features.len() + 1).saturating_sub(spec.context);
        let past_features: Vec<Features> = self.features.iter().skip(spare).cloned().collect();
        let is_full = past_features.len() + 1 == spec.context;
        let past_states = match &self.conditioning.state {
            Some(last) => self.past_states.iter().chain([last]).cloned().collect(),
            // Without the last frame's state, the others would count as those of the frames after theirs.
            None => Vec::new(),
        };
        Task {
            past_features,
            past_states: last_states(past_states, spec),
            camera: self.camera,
            warnings: Vec::new(),
            frames: vec![frame],
            conditioning_inputs: conditioning.filter(|_| is_full).into_iter().collect(),
            sees_occupancy: false,
            past_errors: self.past_errors.clone(),
        }
    }

    /// Takes the result of the step of frame `seq`.
    pub fn advance(
        &mut self,
        seq: u64,
        prediction: &mut Prediction,
        conditioning: ConditioningInput,
        spec: &ModelSpec,
    ) {
        self.features
            .append(&mut std::mem::take(&mut prediction.features).into());
        self.past_errors = std::mem::take(&mut prediction.past_errors);
        while self.features.len() > spec.context {
            self.features.pop_front();
        }
        match self.conditioning.state.take().filter(|_| spec.reads_past_states()) {
            Some(state) => self.past_states.push_back(state),
            // The states before a gap would count as those of other frames.
            None => self.past_states.clear(),
        }
        while self.past_states.len() >= spec.context {
            self.past_states.pop_front();
        }
        self.conditioning = conditioning;
        self.next_seq = seq.saturating_add(1);
    }

    /// The task that repeats the last prediction; `None` while the context is not full.
    #[must_use]
    pub fn repeat_task(&self, spec: &ModelSpec) -> Option<Task> {
        (self.features.len() == spec.context).then(|| self.rollout_task(vec![self.conditioning.clone()], spec))
    }

    /// The task that predicts one rollout for each conditioning input from the last frame. The context must be full.
    #[must_use]
    pub fn rollout_task(&self, conditioning_inputs: Vec<ConditioningInput>, spec: &ModelSpec) -> Task {
        Task {
            past_features: self.features.iter().cloned().collect(),
            past_states: last_states(self.past_states.iter().cloned().collect(), spec),
            camera: self.camera,
            warnings: Vec::new(),
            frames: Vec::new(),
            conditioning_inputs,
            sees_occupancy: false,
            past_errors: self.past_errors.so_far(),
        }
    }
}

const SNAPSHOT_FIELDS: FieldNames = FieldNames {
    past: |_| "actions".to_owned(),
    plan: "actions",
    missing: "actions",
};

/// The last states, one for each of the context's frames before its last one; none if there are fewer.
fn last_states(mut states: Vec<RobotState>, spec: &ModelSpec) -> Vec<RobotState> {
    match states.len().checked_sub(spec.context - 1) {
        Some(spare) if spec.reads_past_states() => states.split_off(spare),
        _ => Vec::new(),
    }
}

fn check_features(index: usize, features: &[f32], spec: &ModelSpec) -> Result<(), SnapshotError> {
    if features.len() != spec.code_len() {
        return Err(SnapshotError::FeatureCount {
            index,
            found: features.len(),
            expected: spec.code_len(),
        });
    }
    // Features are outputs of tanh, or pixels for the flow network; NaN is in no range.
    match features.iter().position(|value| !(-1.0..=1.0).contains(value)) {
        Some(place) => Err(SnapshotError::Feature {
            index,
            place,
            value: features[place],
        }),
        None => Ok(()),
    }
}

/// Features that take no more memory than their numbers: a session keeps them for long.
fn shrunk(mut features: Vec<f32>) -> Features {
    features.shrink_to_fit();
    features.into()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::serving::test_model;

    fn action(value: f32) -> Action {
        Action::try_from(vec![value]).unwrap()
    }

    proptest! {
        #[test]
        fn an_exported_state_is_restored_whole_or_refused(
            next_seq in 0u64..6,
            features in proptest::collection::vec(proptest::collection::vec(-1.2f32..1.2, 4..6), 0..5),
            actions in proptest::collection::vec(-2.0f32..2.0, 0..4),
            state in proptest::option::of(-2.0f32..2.0),
        ) {
            let model = test_model();
            let snapshot = SessionSnapshot {
                next_seq,
                features,
                actions: actions.into_iter().map(action).collect(),
                state: state.and_then(|value| RobotState::try_from(vec![value]).ok()),
                past_states: Vec::new(),
                camera: None,
                steps: None,
                past_errors: Vec::new(),
            };
            let is_sound = snapshot.features.len() <= 3
                && snapshot.features.iter().all(|f| f.len() == 5 && f.iter().all(|value| value.abs() <= 1.0))
                && (snapshot.features.is_empty() == (next_seq == 0) && next_seq >= snapshot.features.len() as u64)
                && (snapshot.features.is_empty() || (snapshot.actions.len() == 2 && snapshot.state.is_some()));
            match SessionState::restore(snapshot.clone(), &model.manifest) {
                Ok(restored) => {
                    prop_assert!(is_sound);
                    if next_seq > 0 {
                        prop_assert_eq!(restored.snapshot(), snapshot);
                    }
                }
                Err(_) => prop_assert!(!is_sound),
            }
        }
    }

    #[test]
    fn a_feature_out_of_range_is_refused_with_its_position() {
        let model = test_model();
        let mut snapshot = SessionSnapshot {
            next_seq: 1,
            features: vec![vec![0.0; 5]],
            actions: vec![action(0.0); 2],
            state: RobotState::try_from(vec![0.0]).ok(),
            past_states: Vec::new(),
            camera: None,
            steps: None,
            past_errors: Vec::new(),
        };
        snapshot.features[0][3] = f32::NAN;
        let error = SessionState::restore(snapshot, &model.manifest).unwrap_err();
        assert_eq!(
            error.to_string(),
            "snapshot.features[0][3] is NaN; a feature is -1 to 1"
        );
    }
}
