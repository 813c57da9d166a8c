//! Fine-tuning: a training that starts from the weights of another model.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};

use super::plan::check_conditioning;
use super::{TrainConfig, TrainError};
use foreframe_core::error_text::comma_separated;
use foreframe_core::nn::{Architecture, ModelSpec, Parameters};
use foreframe_core::registry::{Manifest, StoredWeights};
use foreframe_core::types::Seed;
use foreframe_data::dataset::DatasetInfo;

/// Prefixes of the names of tensors that a network may have and the one before it not.
const OPTIONAL_PREFIXES: [&str; 5] = [
    "flow.movers.",
    "flow.speeds.",
    "flow.motion.",
    "flow.memory.",
    "flow.scene.",
];

/// Checks by the descriptions alone whether a training on a data set can start from a model. Errors: `OtherNetwork`, `OtherUnits`;
/// `Config` if the model takes actions or states that the data set does not have.
pub fn check_start(config: &TrainConfig, dataset: &DatasetInfo, base: &Manifest) -> Result<(), TrainError> {
    let mut spec = config.unscaled_spec(dataset);
    if let (Architecture::Flow(flow), Some(base)) = (&mut spec.architecture, base.spec.flow()) {
        // The cameras of the episodes are not in the description.
        flow.camera = flow.camera.or(base.camera);
    }
    check_conditioning(&dataset.name, &spec)?;
    let start = StoredWeights {
        manifest: base.clone(),
        parameters: Parameters::initialize(&base.spec, config.seed)?,
    };
    parameters(&spec, &start, config.seed).map(drop)
}

/// The weights of another model. What only this training's network has, of movers, speeds, motion and memory, starts as in a new
/// network, and what only the other one has of them is left out. If this network sees how fast the camera drives, states and actions may be others
/// too: the weights of those that both have stay, and those of new ones start at 0.
/// Errors: `OtherNetwork` if they do not fit this training's network, `OtherUnits`.
pub(super) fn parameters(to: &ModelSpec, start: &StoredWeights, seed: Seed) -> Result<Parameters, TrainError> {
    let from = &start.manifest.spec;
    let fits = check_channels(start, to);
    let mut tensors = start.parameters.snapshot()?;
    if to.flow().is_some() && from.flow().is_some() {
        let is_optional = |name: &str| OPTIONAL_PREFIXES.iter().any(|prefix| name.starts_with(prefix));
        let initial = Parameters::initialize(to, seed)?.snapshot()?;
        tensors.retain(|name, _| !is_optional(name) || initial.contains_key(name));
        let is_new = |name: &str| is_optional(name) && !tensors.contains_key(name);
        let new: Vec<_> = initial.into_iter().filter(|(name, _)| is_new(name)).collect();
        tensors.extend(new);
    }
    let (before, after) = (from.rows_of_inputs(), to.rows_of_inputs());
    let rows = |rows: &BTreeMap<String, Vec<String>>| rows.values().map(Vec::len).collect::<Vec<_>>();
    if to.sees_speeds() && (fits.is_err() || rows(&before) != rows(&after)) {
        for (name, wanted) in &after {
            if let (Some(found), Some(tensor)) = (before.get(name), tensors.get_mut(name)) {
                *tensor = rearranged(tensor, found, wanted)?;
            }
        }
    } else {
        fits?;
    }
    Parameters::from_tensors(to, tensors).map_err(|source| TrainError::OtherNetwork {
        model: start.manifest.name.clone(),
        source,
    })
}

/// The rows of a matrix whose rows are `found`, as `wanted`: 0 where there was none.
fn rearranged(matrix: &Tensor, found: &[String], wanted: &[String]) -> Result<Tensor, TrainError> {
    let columns = matrix.dim(1)?;
    let values = matrix.flatten_all()?.to_vec1::<f32>()?;
    let row = |name: &String| {
        let place = found.iter().position(|other| other == name);
        place.map_or_else(
            || vec![0.0; columns],
            |place| values[place * columns..(place + 1) * columns].to_vec(),
        )
    };
    let rows: Vec<f32> = wanted.iter().flat_map(row).collect();
    Ok(Tensor::from_vec(rows, (wanted.len(), columns), &Device::Cpu)?)
}

/// Errors: `OtherUnits` if the channels that this training's network takes are not those of the other one.
fn check_channels(start: &StoredWeights, to: &ModelSpec) -> Result<(), TrainError> {
    let from = &start.manifest.spec;
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
    Ok(())
}
