//! Ranges and histograms of the actions and states.

use serde::Serialize;

use super::histogram::Histogram;
use super::numbers::number;
use crate::dataset::Dataset;
use foreframe_core::types::Channel;

const BINS: usize = 40;
/// Warn if one value fills more than this share of the frames.
const MOST_FRAMES: f64 = 0.95;
/// Warn if a value is further from the mean than this many standard deviations.
const FAR_DEVIATIONS: f64 = 20.0;

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
        histogram,
    }
}

/// The value that occurs most often, and how often.
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
    warnings
}

impl ChannelSummary {
    /// Whether all frames have the same value.
    #[must_use]
    pub fn is_constant(&self) -> bool {
        self.min == self.max
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
        let farthest = (self.max - self.mean).max(self.mean - self.min);
        (farthest > FAR_DEVIATIONS * self.std).then(|| {
            format!(
                "The {role} \"{name}\" has values from {} to {}, which is up to {:.0} standard deviations from its mean {}. \
                 Such a value is often an error of the sensor; leave out those records before the import.",
                number(self.min),
                number(self.max),
                farthest / self.std,
                number(self.mean)
            )
        })
    }
}
