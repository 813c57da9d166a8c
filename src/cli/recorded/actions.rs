//! The file of a robot's states and actions.

use std::path::Path;

use serde::Deserialize;

use crate::cli::error::CliError;
use foreframe_core::nn::ModelSpec;
use foreframe_core::serving::PredictionInput;
use foreframe_core::types::{Action, RobotState};

/// One entry for each image of the directory.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::cli) struct ActionsFile {
    #[serde(default)]
    states: Vec<RobotState>,
    actions: Vec<Action>,
}

impl ActionsFile {
    pub(in crate::cli) fn read(path: &Path) -> Result<Self, CliError> {
        let bytes = std::fs::read(path).map_err(|error| CliError::io("read", path, &error))?;
        serde_json::from_slice(&bytes).map_err(|error| {
            CliError::Usage(format!(
                "{} is not an actions file: {error}; it is JSON of finite numbers, \
                 {{\"states\": [[…], …], \"actions\": [[…], …]}}",
                path.display()
            ))
        })
    }

    /// Whether the file holds what the model takes to predict after frame `last`. Errors: `Usage` with what is missing.
    pub(in crate::cli) fn check(&self, path: &Path, last: usize, spec: &ModelSpec) -> Result<(), CliError> {
        self.check_states(path, last, spec)?;
        let needed = last + spec.horizon;
        if spec.action_inputs().is_none() || self.actions.len() >= needed {
            return Ok(());
        }
        let latest = self.actions.len().saturating_sub(spec.horizon);
        let or_earlier = if latest + 1 >= spec.context {
            format!(", or predict after an earlier frame with --at {latest}")
        } else {
            String::new()
        };
        Err(CliError::Usage(format!(
            "{} holds {} actions; predicting {} frames after frame {last} takes {needed}; add the planned actions{or_earlier}",
            path.display(),
            self.actions.len(),
            spec.horizon
        )))
    }

    /// Whether the file holds the state at frame `last`, if the model takes it. Errors: `Usage`.
    pub(in crate::cli) fn check_states(&self, path: &Path, last: usize, spec: &ModelSpec) -> Result<(), CliError> {
        let needs_none = spec.sees_speeds() && self.states.is_empty();
        if spec.state_inputs().is_none() || needs_none || self.states.len() > last {
            return Ok(());
        }
        Err(CliError::Usage(format!(
            "{} holds {} states; the state at frame {last} takes {}",
            path.display(),
            self.states.len(),
            last + 1
        )))
    }

    /// Fills in the states at the context's frames, of which `last` is the last one, and the actions from it on, as far as the
    /// model takes them.
    pub(in crate::cli) fn fill_in(mut self, input: &mut PredictionInput, last: usize, spec: &ModelSpec) {
        self.states.truncate(last + 1);
        input.state = if self.states.len() > last {
            self.states.pop()
        } else {
            None
        };
        if spec.reads_past_states() {
            let spare = self.states.len().saturating_sub(spec.context - 1);
            input.past_states = self.states.split_off(spare);
        }
        let future = self.actions.into_iter().skip(last).take(spec.horizon);
        input.plan = spec.action_inputs().map(|_| future.collect());
    }
}
