//! Warnings about actions and states that the model never saw in training.

use super::conditioning::ConditioningInput;
use crate::nn::ChannelScale;
use crate::registry::Manifest;
use crate::registry::calibration::ValueRange;
use crate::types::{Action, RobotState};

/// One warning for each channel with a value out of the range of the training; it names the value that is farthest out.
pub(super) fn range_warnings(manifest: &Manifest, inputs: &[ConditioningInput]) -> Vec<String> {
    let Some(calibration) = &manifest.calibration else {
        return Vec::new();
    };
    let actions = inputs.iter().flat_map(|input| &input.actions);
    let states = inputs.iter().flat_map(|input| &input.state);
    let states: Vec<&[f32]> = states.map(RobotState::as_slice).collect();
    let actions: Vec<&[f32]> = actions.map(Action::as_slice).collect();
    let spec = &manifest.spec;
    // A pose that only says how the camera has moved may have any origin.
    let read = spec.states_that_count();
    let all: Vec<usize> = (0..spec.actions.len()).collect();
    let mut warnings = warnings_of("state", (&spec.states, &read), &calibration.states, &states);
    warnings.extend(warnings_of(
        "action",
        (&spec.actions, &all),
        &calibration.actions,
        &actions,
    ));
    warnings
}

/// The warnings for the channels whose indices are given.
fn warnings_of(
    kind: &str,
    (channels, indices): (&[ChannelScale], &[usize]),
    ranges: &[ValueRange],
    vectors: &[&[f32]],
) -> Vec<String> {
    let mut warnings = Vec::new();
    for &index in indices {
        let (Some(channel), Some(range)) = (channels.get(index), ranges.get(index)) else {
            continue;
        };
        let excess = |value: f32| (range.min - value).max(value - range.max);
        let values = vectors.iter().filter_map(|vector| vector.get(index).copied());
        let farthest = values
            .filter(|value| excess(*value) > 0.0)
            .max_by(|a, b| excess(*a).total_cmp(&excess(*b)));
        if let Some(value) = farthest {
            let (name, unit) = (&channel.name, if channel.unit.is_empty() { "" } else { " " });
            warnings.push(format!(
                "{kind} {name} is {value}{unit}{0}; in training it was {1} to {2}{unit}{0}",
                channel.unit, range.min, range.max
            ));
        }
    }
    warnings
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_warning_names_channel_value_and_range() {
        let channel = ChannelScale {
            name: "linear".to_owned(),
            unit: "m/s".to_owned(),
            mean: 0.0,
            std: 1.0,
        };
        let range = ValueRange { min: 0.0, max: 0.5 };
        let warnings = |values: &[f32]| {
            let vectors: Vec<&[f32]> = values.chunks(1).collect();
            warnings_of("action", (std::slice::from_ref(&channel), &[0]), &[range], &vectors)
        };
        assert_eq!(warnings(&[0.0, 0.5]), Vec::<String>::new());
        assert_eq!(
            warnings(&[0.6, -3.0, 2.0]),
            ["action linear is -3 m/s; in training it was 0 to 0.5 m/s"]
        );
    }
}
