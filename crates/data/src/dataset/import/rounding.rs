//! What is lost where actions and states are stored with 32 bits.

use super::timing::{ImportPlan, PlannedFrame};
use foreframe_core::types::Channel;

/// A note is made if stored numbers are further apart than this share of a channel's range.
const COARSE_SHARE: f64 = 1e-3;

/// A note on each channel whose values are so far from 0 that they are stored coarsely.
pub(super) fn notes(plan: &ImportPlan) -> Vec<String> {
    let records = &plan.recording.records;
    let action = |frame: &PlannedFrame, component: usize| frame.action[component];
    let state = |frame: &PlannedFrame, component: usize| records[frame.record].state[component];
    let of_group = |channels: &[Channel], role: &str, value: &dyn Fn(&PlannedFrame, usize) -> f32| -> Vec<String> {
        let note = |(component, channel): (usize, &Channel)| {
            let values = plan.episodes.iter().flatten().map(|frame| value(frame, component));
            note(role, channel, values)
        };
        channels.iter().enumerate().filter_map(note).collect()
    };
    let recording = &plan.recording;
    let mut notes = of_group(&recording.action_channels, "action", &action);
    notes.extend(of_group(&recording.state_channels, "state", &state));
    notes
}

fn note(role: &str, channel: &Channel, values: impl Iterator<Item = f32>) -> Option<String> {
    let (least, most) = values.fold((f32::INFINITY, f32::NEG_INFINITY), |(least, most), value| {
        (least.min(value), most.max(value))
    });
    let largest = least.abs().max(most.abs());
    let apart = f64::from(largest.next_up()) - f64::from(largest);
    let range = f64::from(most) - f64::from(least);
    (range > 0.0 && apart > COARSE_SHARE * range).then(|| {
        let name = &channel.name;
        format!(
            "the {role} {name:?} is from {least} to {most}; data sets store 32-bit numbers, which are {apart} apart at this size, so \
             smaller changes are lost; subtract an origin near the values before the import"
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_far_from_0_are_noted_where_steps_are_lost() {
        let noted = |first: f64, range: f64| {
            let values = (0..100_u32).map(|frame| (first + range * f64::from(frame) / 99.0) as f32);
            note("state", &Channel::new("north", "m"), values)
        };
        let note = noted(5_400_000.0, 100.0).unwrap();
        assert!(
            note.contains("\"north\" is from 5400000 to 5400100;") && note.contains("are 0.5 apart"),
            "{note}"
        );
        for (first, range) in [
            (0.0, 1.0),
            (400.0, 10.0),
            (5_400_000.0, 2000.0),
            (-1e-9, 1e-9),
            (7.0, 0.0),
        ] {
            assert_eq!(noted(first, range), None, "{first}");
        }
    }
}
