//! Ranges and histograms of the actions and states.

use serde::Serialize;

use super::histogram::Histogram;
use super::numbers::number;
use crate::dataset::Dataset;
use foreframe_core::nn::spec::MIN_CHANNEL_STD;
use foreframe_core::types::Channel;

const BINS: usize = 40;
/// Warn if one value fills more than this share of the frames.
const MOST_FRAMES: f64 = 0.95;
/// The share of the frames with the least values, and of those with the greatest, that can be outliers. Since `MOST_FRAMES` are not
/// equal, the others have a range.
const OUTER_FRAMES: f64 = 0.02;
/// At least so many on each side, but no more than a tenth of the frames: wrong values seldom come alone.
const LEAST_OUTER_FRAMES: usize = 2;
/// Warn if a value is further from those of the other frames than this many times their range.
const FAR_RANGES: f64 = 5.0;

/// Whether a channel belongs to the action or the state.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ChannelRole {
    /// A component of the action.
    Action,
    /// A component of the state.
    State,
}

impl std::fmt::Display for ChannelRole {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// The values of one channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChannelSummary {
    /// Action or state.
    pub role: ChannelRole,
    /// Its name.
    pub name: String,
    /// Its unit; empty if it has none.
    pub unit: String,
    /// Least value.
    pub min: f64,
    /// Greatest value.
    pub max: f64,
    /// Mean of all frames.
    pub mean: f64,
    /// Standard deviation.
    pub std: f64,
    /// The value that most frames have.
    pub commonest: f64,
    /// Share of the frames with that value, 0 to 1.
    pub commonest_share: f64,
    /// Least value of the frames without the least and the greatest 2 % (at least 2 frames each, or a tenth if that is less).
    pub inner_min: f64,
    /// Greatest value of these frames.
    pub inner_max: f64,
    /// All values.
    pub histogram: Histogram,
}

/// Reads the values of one frame.
type ValuesOfFrame = fn(&Dataset, usize) -> &[f32];

pub(super) fn of(dataset: &Dataset) -> Vec<ChannelSummary> {
    let info = dataset.info();
    let groups: [(ChannelRole, &[Channel], ValuesOfFrame); 2] = [
        (ChannelRole::Action, &info.action_channels, Dataset::action),
        (ChannelRole::State, &info.state_channels, Dataset::state),
    ];
    let summaries = groups.into_iter().flat_map(|(role, channels, of_frame)| {
        channels.iter().enumerate().map(move |(component, channel)| {
            let values = (0..info.frame_count).map(|frame| f64::from(of_frame(dataset, frame)[component]));
            summary(role, channel, values.collect())
        })
    });
    summaries.collect()
}

fn summary(role: ChannelRole, channel: &Channel, mut values: Vec<f64>) -> ChannelSummary {
    let count = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    let histogram = Histogram::of(values.iter().copied(), BINS);
    let (commonest, frames) = commonest(&mut values);
    let outer = (values.len() as f64 * OUTER_FRAMES).ceil() as usize;
    let outer = outer.max(LEAST_OUTER_FRAMES.min(values.len() / 10));
    let inner = values
        .get(outer..values.len().saturating_sub(outer))
        .unwrap_or_default();
    ChannelSummary {
        role,
        name: channel.name.clone(),
        unit: channel.unit.clone(),
        min: histogram.from,
        max: histogram.to,
        mean,
        std: variance.sqrt(),
        commonest,
        commonest_share: frames as f64 / count,
        inner_min: inner.first().copied().unwrap_or(histogram.from),
        inner_max: inner.last().copied().unwrap_or(histogram.to),
        histogram,
    }
}

/// The value that occurs most often, and how often. Sorts the values.
fn commonest(values: &mut [f64]) -> (f64, usize) {
    values.sort_unstable_by(f64::total_cmp);
    let runs = values.chunk_by(|a, b| a == b);
    let longest = runs.max_by_key(|run| run.len());
    longest.map_or((0.0, 0), |run| (run[0], run.len()))
}

pub(super) fn warnings(channels: &[ChannelSummary]) -> Vec<String> {
    let constant: Vec<String> = channels
        .iter()
        .filter(|channel| channel.is_constant())
        .map(|channel| format!("{} \"{}\" ({})", channel.role, channel.name, number(channel.min)))
        .collect();
    let mut warnings = Vec::new();
    if !constant.is_empty() {
        warnings.push(format!(
            "The same value in every frame: {}. It tells the model nothing. Leave such channels out (name the others with \
             --action and --state when you import), or record runs in which they vary.",
            constant.join(", ")
        ));
    }
    warnings.extend(channels.iter().filter_map(ChannelSummary::warning));
    warnings.extend(channels.iter().filter_map(ChannelSummary::scale_warning));
    warnings
}

/// A sentence on each channel of a data set that varies so little that networks see it too small.
#[doc(hidden)]
#[must_use]
pub fn small_channels(dataset: &Dataset) -> Vec<String> {
    of(dataset).iter().filter_map(ChannelSummary::scale_warning).collect()
}

impl ChannelSummary {
    /// Whether all frames have the same value.
    #[must_use]
    pub fn is_constant(&self) -> bool {
        self.min == self.max
    }

    fn scale_warning(&self) -> Option<String> {
        let least = f64::from(MIN_CHANNEL_STD);
        (!self.is_constant() && self.std < least).then(|| {
            format!(
                "The standard deviation of the {} \"{}\" is {}. The networks divide by the deviation, but at least by {}, so \
                 they see this channel {} times too small. Give it in a smaller unit before you import it, such as mm for m.",
                self.role,
                self.name,
                number(self.std),
                MIN_CHANNEL_STD,
                number(least / self.std)
            )
        })
    }

    fn warning(&self) -> Option<String> {
        if self.is_constant() {
            return None;
        }
        let (role, name) = (self.role, &self.name);
        if self.commonest_share > MOST_FRAMES {
            return Some(format!(
                "The {role} \"{name}\" is {} in {:.0} % of the frames. The model sees few examples of anything else; record \
                 more frames in which it varies.",
                number(self.commonest),
                100.0 * self.commonest_share
            ));
        }
        let farthest = (self.max - self.inner_max).max(self.inner_min - self.min);
        let range = self.inner_max - self.inner_min;
        (range > 0.0 && farthest > FAR_RANGES * range).then(|| {
            format!(
                "The {role} \"{name}\" has values from {} to {}, but most are from {} to {}. Such a value is often an error of \
                 the sensor; leave out those records before the import.",
                number(self.min),
                number(self.max),
                number(self.inner_min),
                number(self.inner_max)
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn warned(values: impl IntoIterator<Item = f64>) -> Option<String> {
        summary(
            ChannelRole::Action,
            &Channel::new("turn", ""),
            values.into_iter().collect(),
        )
        .warning()
    }

    #[test]
    fn a_single_outlier_of_a_short_recording_is_found() {
        for frames in [30, 300, 3000] {
            let wave = move |frame: i32| (f64::from(frame) * 0.3).sin();
            assert_eq!(warned((0..frames).map(wave)), None);
            let with_outlier = (0..frames).map(|frame| if frame == 20 { -1000.0 } else { wave(frame) });
            let warning = warned(with_outlier).unwrap();
            assert!(warning.contains(" from -1000 to "), "{warning}");
        }
    }

    #[test]
    fn two_outliers_on_one_side_of_a_short_recording_are_found() {
        for frames in [20, 30, 50, 300] {
            let wave = move |frame: i32| (f64::from(frame) * 0.3).sin();
            let with_outliers = (0..frames).map(|frame| if [7, 12].contains(&frame) { 1000.0 } else { wave(frame) });
            let warning = warned(with_outliers).unwrap();
            assert!(warning.contains(" to 1000, but most are from -"), "{warning}");
        }
    }

    #[test]
    fn a_channel_that_varies_too_little_for_the_networks_is_found() {
        let found = |size: f64| {
            let values = (0..300).map(|frame| size * (f64::from(frame) * 0.3).sin()).collect();
            summary(ChannelRole::Action, &Channel::new("turn", ""), values).scale_warning()
        };
        let warning = found(1e-4).unwrap();
        assert!(
            warning.contains("\"turn\" is 7.1e-5.") && warning.contains("14.1"),
            "{warning}"
        );
        assert_eq!([found(0.0), found(0.01)], [None, None]);
    }

    #[test]
    fn rare_commands_are_no_outliers() {
        let pulses = |one_of: i32, frames: i32| (0..frames).map(move |frame| f64::from(u8::from(frame % one_of == 0)));
        assert_eq!(warned(pulses(10, 400)), None);
        assert_eq!(warned(pulses(15, 3000)), None);
        assert_eq!(warned(pulses(10, 20)), None);
        assert_eq!(warned([0.3; 400]), None);
        assert_eq!(warned([0.0, 0.0, 7.0]), None);
    }
}
