//! Fine-tuning: a training that starts from the weights of another model.

use super::TrainError;
use super::plan::TrainingPlan;
use foreframe_core::error_text::comma_separated;
use foreframe_core::nn::Parameters;
use foreframe_core::registry::StoredWeights;

/// The weights of another model. Errors: `OtherNetwork` if they do not fit this training's network, `OtherUnits`.
pub(super) fn parameters(plan: &TrainingPlan<'_>, start: &StoredWeights) -> Result<Parameters, TrainError> {
    let (from, to) = (&start.manifest.spec, &plan.spec);
    let used = [
        ("action", to.action_inputs(), &from.actions, &to.actions),
        ("state", to.state_inputs(), &from.states, &to.states),
    ];
    for (kind, inputs, found, expected) in used {
        // Channels may have other names, but a name that stands at another position was surely swapped.
        let is_elsewhere = |name: &str, at: usize| {
            found
                .iter()
                .position(|other| other.name == name)
                .is_some_and(|other| other != at)
        };
        let differ = (found.iter().zip(expected).enumerate())
            .any(|(at, (found, expected))| found.unit != expected.unit || is_elsewhere(&expected.name, at));
        if inputs.is_some() && differ {
            return Err(TrainError::OtherUnits {
                model: start.manifest.name.clone(),
                kind,
                found: comma_separated(found),
                expected: comma_separated(expected),
            });
        }
    }
    let tensors = start.parameters.snapshot()?;
    Parameters::from_tensors(&plan.spec, tensors).map_err(|source| TrainError::OtherNetwork {
        model: start.manifest.name.clone(),
        source,
    })
}
