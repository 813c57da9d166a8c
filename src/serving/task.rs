//! What the thread that owns the models is given to do, checked before it waits.

use super::compute::Features;
use super::input::{InputError, PredictionInput};
use crate::frame::Frame;
use crate::nn::{ChannelScale, Conditioning, ModelSpec};
use crate::types::{Action, RobotState};

/// What a future is predicted under, checked, of what the model takes: an action for each predicted frame, and the state
/// at the last frame seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ConditioningInput {
    pub(super) actions: Vec<Action>,
    pub(super) state: Option<RobotState>,
}

/// Actions and state as they were given.
#[derive(Clone, Copy)]
pub(crate) struct RawConditioning<'a> {
    /// What acted so far, the last of it still under way.
    pub(crate) past: &'a [Action],
    /// What will act; else the last of the past is held.
    pub(crate) future: Option<&'a [Action]>,
    /// What the robot says of itself at the last frame.
    pub(crate) state: Option<&'a RobotState>,
}

/// What errors call the fields.
pub(crate) struct FieldNames {
    pub(super) past: fn(usize) -> String,
    pub(super) future: &'static str,
    pub(super) missing: &'static str,
}

/// The fields of a request.
pub(super) const REQUEST: FieldNames = FieldNames {
    past: |index| format!("actions[{index}]"),
    future: "future_actions",
    missing: "future_actions",
};
/// The fields of a stream's frame.
pub(crate) const STEP: FieldNames = FieldNames {
    past: |_| "action".to_owned(),
    future: "plan",
    missing: "action",
};

impl ConditioningInput {
    /// Of what was told, that which the model takes. Errors name the field, what it is and what it should be.
    pub(crate) fn new(
        told: RawConditioning<'_>,
        fields: &FieldNames,
        model: &str,
        spec: &ModelSpec,
    ) -> Result<Self, InputError> {
        if spec.conditioning == Conditioning::None {
            return Ok(Self::default());
        }
        for (index, action) in told.past.iter().enumerate() {
            check_length(|| (fields.past)(index), model, action.as_slice(), &spec.actions)?;
        }
        let actions = match (told.future, told.past.last()) {
            _ if spec.action_inputs().is_none() => Vec::new(),
            (Some(actions), _) => {
                check_actions(fields.future, model, spec, actions)?;
                actions.to_vec()
            }
            (None, Some(held)) => vec![held.clone(); spec.horizon],
            (None, None) => {
                return Err(InputError::Missing {
                    field: fields.missing,
                    model: model.to_owned(),
                    channels: channels_of(&spec.actions).join(", "),
                });
            }
        };
        Ok(Self {
            actions,
            state: check_state(model, spec, told.state.cloned())?,
        })
    }

    /// One for each of many sequences of future actions, called `candidates[i]` in errors, from the same state.
    /// Errors: `Unconditioned` if the model takes no actions, and those of the values.
    pub(crate) fn candidates(
        candidates: Vec<Vec<Action>>,
        state: Option<RobotState>,
        model: &str,
        spec: &ModelSpec,
    ) -> Result<Vec<Self>, InputError> {
        if spec.action_inputs().is_none() {
            return Err(InputError::Unconditioned {
                model: model.to_owned(),
            });
        }
        let state = check_state(model, spec, state)?;
        let premise = |(index, actions): (usize, Vec<Action>)| {
            check_actions(&format!("candidates[{index}]"), model, spec, &actions)?;
            let state = state.clone();
            Ok(Self { actions, state })
        };
        candidates.into_iter().enumerate().map(premise).collect()
    }
}

/// What the thread that owns the models computes in one go. State goes in and comes out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Task {
    /// Of the frames encoded before, oldest first.
    pub(super) known: Vec<Features>,
    /// The frames that follow those, to be encoded.
    pub(super) frames: Vec<Frame>,
    /// One for each future to predict; none where the context is not full.
    pub(super) premises: Vec<ConditioningInput>,
}

impl Task {
    /// Futures of the context in `frames`, one for each premise. Errors: those of the frames.
    pub(crate) fn futures(
        frames: Vec<Frame>,
        premises: Vec<ConditioningInput>,
        model: &str,
        spec: &ModelSpec,
    ) -> Result<Self, InputError> {
        let input = PredictionInput {
            frames,
            ..PredictionInput::default()
        };
        input.check_frames(model, spec)?;
        Ok(Self {
            frames: input.frames,
            premises,
            ..Self::default()
        })
    }

    /// Takes out what is computed next: the frames, and the first futures up to a limit.
    pub(super) fn next_part(&mut self, limit: usize) -> Self {
        let later = self.premises.split_off(limit.min(self.premises.len()));
        Self {
            known: self.known.clone(),
            frames: std::mem::take(&mut self.frames),
            premises: std::mem::replace(&mut self.premises, later),
        }
    }
}

/// Whether there is an action for each predicted frame, and of each action every number.
fn check_actions(field: &str, model: &str, spec: &ModelSpec, actions: &[Action]) -> Result<(), InputError> {
    if actions.len() != spec.horizon {
        return Err(InputError::FutureActionCount {
            field: field.to_owned(),
            model: model.to_owned(),
            found: actions.len(),
            expected: spec.horizon,
        });
    }
    for (index, action) in actions.iter().enumerate() {
        check_length(|| format!("{field}[{index}]"), model, action.as_slice(), &spec.actions)?;
    }
    Ok(())
}

/// The state, if the model takes one.
fn check_state(model: &str, spec: &ModelSpec, state: Option<RobotState>) -> Result<Option<RobotState>, InputError> {
    if spec.state_inputs().is_none() {
        return Ok(None);
    }
    let Some(state) = state else {
        return Err(InputError::Missing {
            field: "state",
            model: model.to_owned(),
            channels: channels_of(&spec.states).join(", "),
        });
    };
    check_length(|| "state".to_owned(), model, state.as_slice(), &spec.states)?;
    Ok(Some(state))
}

fn check_length(
    field: impl Fn() -> String,
    model: &str,
    values: &[f32],
    scales: &[ChannelScale],
) -> Result<(), InputError> {
    if values.len() == scales.len() {
        return Ok(());
    }
    Err(InputError::Dimension {
        field: field(),
        model: model.to_owned(),
        found: values.len(),
        expected: scales.len(),
        channels: channels_of(scales).join(", "),
    })
}

fn channels_of(scales: &[ChannelScale]) -> Vec<String> {
    scales
        .iter()
        .map(|scale| format!("{} {}", scale.name, scale.unit).trim_end().to_owned())
        .collect()
}
