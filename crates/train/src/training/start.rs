//! Fine-tuning: a training that starts from the weights of another model.

use super::TrainError;
use super::plan::TrainingPlan;
use foreframe_core::error_text::comma_separated;
use foreframe_core::nn::Parameters;
use foreframe_core::registry::StoredWeights;
use foreframe_core::types::Seed;

/// Prefix of the names of the tensors that find movers.
const MOVERS_PREFIX: &str = "flow.movers.";

/// The weights of another model; if only this training's network finds movers, what finds them starts at random, and if only
/// the other one does, that is left out.
/// Errors: `OtherNetwork` if they do not fit this training's network, `OtherUnits`.
pub(super) fn parameters(plan: &TrainingPlan<'_>, start: &StoredWeights, seed: Seed) -> Result<Parameters, TrainError> {
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
    let mut tensors = start.parameters.snapshot()?;
    if let (Some(from), Some(to)) = (from.flow(), to.flow())
        && to.layers.movers != from.layers.movers
    {
        tensors.retain(|name, _| !name.starts_with(MOVERS_PREFIX));
        if to.layers.movers {
            let initial = Parameters::initialize(&plan.spec, seed)?.snapshot()?;
            tensors.extend(initial.into_iter().filter(|(name, _)| name.starts_with(MOVERS_PREFIX)));
        }
    }
    Parameters::from_tensors(&plan.spec, tensors).map_err(|source| TrainError::OtherNetwork {
        model: start.manifest.name.clone(),
        source,
    })
}
