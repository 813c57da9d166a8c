//! The state and the actions under which frames are predicted, and the check that they fit a model.

use super::error::InputError;
use crate::error_text::comma_separated;
use crate::nn::spec::MAX_STEPS;
use crate::nn::{ChannelScale, Conditioning, ModelSpec};
use crate::registry::Manifest;
use crate::types::{Action, ModelName, RobotState};

/// The state at the last frame and the action for each predicted frame, as far as the model takes them. Checked. Of a model that sees
/// how fast the camera drives, both may be missing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ConditioningInput {
    pub(super) actions: Vec<Action>,
    pub(super) state: Option<RobotState>,
    /// Frames to predict; the model's horizon if absent.
    pub(super) steps: Option<usize>,
}

/// Actions and state as the client sent them.
#[derive(Clone, Copy)]
pub struct RawConditioning<'a> {
    /// The past actions; the last one acts from the last frame on.
    pub past: &'a [Action],
    /// The plan; without one, the last past action is held.
    pub plan: Option<&'a [Action]>,
    /// The robot's state at the last frame.
    pub state: Option<&'a RobotState>,
    /// Frames to predict; the model's horizon if absent.
    pub steps: Option<usize>,
}

/// The names of the fields in error messages.
pub struct FieldNames {
    pub(super) past: fn(usize) -> String,
    /// The field of the future actions.
    pub plan: &'static str,
    pub(super) missing: &'static str,
}

/// The fields of a request.
pub(super) const REQUEST_FIELDS: FieldNames = FieldNames {
    past: |index| format!("actions[{index}]"),
    plan: "plan",
    missing: "plan",
};
/// The fields of a stream's frame.
pub const STEP_FIELDS: FieldNames = FieldNames {
    past: |_| "action".to_owned(),
    plan: "plan",
    missing: "action",
};
/// The fields of an observation of openpi's clients.
pub const OBSERVATION_FIELDS: FieldNames = FieldNames {
    plan: "actions",
    ..STEP_FIELDS
};

impl ConditioningInput {
    /// Checks the input and keeps what the model takes. Errors name the field, its value and the expected value.
    pub fn new(raw: RawConditioning<'_>, fields: &FieldNames, manifest: &Manifest) -> Result<Self, InputError> {
        let (model, spec) = (&manifest.name, &manifest.spec);
        let steps = raw.steps.unwrap_or(spec.horizon);
        if !(1..=MAX_STEPS).contains(&steps) {
            return Err(InputError::Steps { found: steps });
        }
        if spec.conditioning == Conditioning::None {
            return Ok(Self {
                steps: raw.steps,
                ..Self::default()
            });
        }
        for (index, action) in raw.past.iter().enumerate() {
            check_length(|| (fields.past)(index), model, action.as_slice(), &spec.actions)?;
        }
        let actions = match (raw.plan, raw.past.last()) {
            _ if spec.action_inputs().is_none() => Vec::new(),
            (Some(actions), _) => {
                check_actions(fields.plan, manifest, steps, actions)?;
                actions.to_vec()
            }
            (None, Some(held)) => vec![held.clone(); steps],
            (None, None) if spec.sees_speeds() => Vec::new(),
            (None, None) => {
                return Err(InputError::Missing {
                    field: fields.missing,
                    model: model.clone(),
                    channels: comma_separated(&spec.actions),
                });
            }
        };
        Ok(Self {
            actions,
            state: check_state(manifest, raw.state.cloned())?,
            steps: raw.steps,
        })
    }

    /// One conditioning input for each plan, all from the same state. Errors call the plans `plans[i]`.
    /// Errors: `Unconditioned` if the model takes no actions, and the errors of the values.
    pub fn of_plans(
        plans: Vec<Vec<Action>>,
        state: Option<RobotState>,
        steps: Option<usize>,
        manifest: &Manifest,
    ) -> Result<Vec<Self>, InputError> {
        if manifest.spec.action_inputs().is_none() {
            let model = manifest.name.clone();
            return Err(InputError::Unconditioned { model });
        }
        let state = check_state(manifest, state)?;
        let expected = steps.unwrap_or(manifest.spec.horizon);
        let conditioning = |(index, actions): (usize, Vec<Action>)| {
            check_actions(&format!("plans[{index}]"), manifest, expected, &actions)?;
            let state = state.clone();
            Ok(Self { actions, state, steps })
        };
        plans.into_iter().enumerate().map(conditioning).collect()
    }

    /// Frames to predict.
    pub(super) fn steps(&self, spec: &ModelSpec) -> usize {
        self.steps.unwrap_or(spec.horizon)
    }
}

/// Checks that there are as many actions as steps and that each action has all channels.
fn check_actions(field: &str, manifest: &Manifest, steps: usize, actions: &[Action]) -> Result<(), InputError> {
    if actions.len() != steps {
        return Err(InputError::PlanLength {
            field: field.to_owned(),
            model: manifest.name.clone(),
            found: actions.len(),
            expected: steps,
        });
    }
    for (index, action) in actions.iter().enumerate() {
        let field = || format!("{field}[{index}]");
        check_length(field, &manifest.name, action.as_slice(), &manifest.spec.actions)?;
    }
    Ok(())
}

/// Checks the state; `None` if the model takes none.
fn check_state(manifest: &Manifest, state: Option<RobotState>) -> Result<Option<RobotState>, InputError> {
    let (model, spec) = (&manifest.name, &manifest.spec);
    if spec.state_inputs().is_none() {
        return Ok(None);
    }
    let Some(state) = state else {
        if spec.sees_speeds() {
            return Ok(None);
        }
        return Err(InputError::Missing {
            field: "state",
            model: model.clone(),
            channels: comma_separated(&spec.states),
        });
    };
    check_length(|| "state".to_owned(), model, state.as_slice(), &spec.states)?;
    Ok(Some(state))
}

/// The states at the context's frames before the last one, if the model reads them; empty if they are not known.
/// Errors: `PastStates`, `Dimension`.
pub(super) fn past_states_used(states: Vec<RobotState>, manifest: &Manifest) -> Result<Vec<RobotState>, InputError> {
    let (model, spec) = (&manifest.name, &manifest.spec);
    if states.is_empty() || !spec.reads_past_states() {
        return Ok(Vec::new());
    }
    if states.len() != spec.context - 1 {
        return Err(InputError::PastStates {
            model: model.clone(),
            found: states.len(),
            expected: spec.context - 1,
        });
    }
    check_states(states, manifest)
}

/// Errors: `Dimension` if a state has not all channels.
pub(super) fn check_states(states: Vec<RobotState>, manifest: &Manifest) -> Result<Vec<RobotState>, InputError> {
    for (index, state) in states.iter().enumerate() {
        let field = || format!("states[{index}]");
        check_length(field, &manifest.name, state.as_slice(), &manifest.spec.states)?;
    }
    Ok(states)
}

fn check_length(
    field: impl Fn() -> String,
    model: &ModelName,
    values: &[f32],
    scales: &[ChannelScale],
) -> Result<(), InputError> {
    if values.len() == scales.len() {
        return Ok(());
    }
    Err(InputError::Dimension {
        field: field(),
        model: model.clone(),
        found: values.len(),
        expected: scales.len(),
        channels: comma_separated(scales),
    })
}
