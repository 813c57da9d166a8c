//! What one looks at before training on a data set: counts, rates and gaps (`timing`), ranges of every channel
//! (`channels`), brightness, repeated frames and exposure jumps (`images`), and the delay between actions and the image's
//! motion (`delays`). What is wrong becomes a sentence in [`Inspection::warnings`]; [`page`] draws all of it as HTML.

mod channels;
mod charts;
mod delays;
mod images;
mod page;
mod timing;

use serde::Serialize;

pub use self::channels::{ChannelRole, ChannelSummary};
pub use self::delays::{ActionDelay, LagCorrelation, MotionSignal};
pub use self::images::{ExposureJump, FrozenSpan, ImageSummary};
pub use self::page::page;
pub use self::timing::{FrameTiming, TimeGap};

use crate::dataset::{Dataset, DatasetError, Episode};

/// Pictures of the contact sheet.
const CONTACT_FRAMES: usize = 24;

/// What was found in a data set.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Inspection {
    /// The data set's name.
    pub name: String,
    /// SHA-256 of its content, in hexadecimal.
    pub content_hash: String,
    /// The simulated scenario; none for recordings.
    pub scenario: Option<String>,
    /// Width of every frame in pixels.
    pub frame_width_px: u32,
    /// Height of every frame in pixels.
    pub frame_height_px: u32,
    /// Number of frames.
    pub frame_count: usize,
    /// Number of episodes.
    pub episode_count: usize,
    /// Lengths and times.
    pub timing: FrameTiming,
    /// Every component of the action, then of the state.
    pub channels: Vec<ChannelSummary>,
    /// One for each component of the action.
    pub delays: Vec<ActionDelay>,
    /// Brightness, repeated frames, exposure.
    pub images: ImageSummary,
    /// Frames spread evenly over the data set.
    pub contact_sheet: Vec<FramePlace>,
    /// What is wrong and what to do about it, a few sentences each.
    pub warnings: Vec<String>,
}

/// Where a frame is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct FramePlace {
    /// Position of the episode.
    pub episode: usize,
    /// Frame within the episode, counted from 0.
    pub frame: usize,
}

/// How many values lie in each of equally wide ranges.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Histogram {
    /// Lower end of the first range.
    pub from: f64,
    /// Upper end of the last range.
    pub to: f64,
    /// Values in each range.
    pub counts: Vec<u64>,
}

impl Histogram {
    /// Counts the values in `bins` ranges from the least to the greatest value.
    fn of(values: impl Iterator<Item = f64> + Clone, bins: usize) -> Self {
        let from = values.clone().fold(f64::INFINITY, f64::min);
        let to = values.clone().fold(f64::NEG_INFINITY, f64::max);
        let mut counts = vec![0; bins];
        for value in values {
            let place = (value - from) / (to - from).max(f64::MIN_POSITIVE) * bins as f64;
            if let Some(count) = counts.get_mut((place as usize).min(bins - 1)) {
                *count += 1;
            }
        }
        Self { from, to, counts }
    }
}

/// Looks through a whole data set, on all threads of the current pool. It keeps some tens of bytes of each frame, not its
/// pixels. Errors: those of [`Dataset::pixels`].
pub fn inspect(dataset: &Dataset) -> Result<Inspection, DatasetError> {
    let info = dataset.info();
    let timing = timing::of(dataset);
    let channels = channels::of(dataset);
    let delays = delays::of(dataset)?;
    let images = images::of(dataset)?;
    let warnings = [
        timing.warnings(),
        images.warnings(&timing),
        channels::warnings(&channels),
        delays::warnings(&delays, timing.frame_period_s),
    ];
    Ok(Inspection {
        name: info.name.clone(),
        content_hash: info.content_hash.clone(),
        scenario: info.scenario.clone(),
        frame_width_px: info.frame_width_px,
        frame_height_px: info.frame_height_px,
        frame_count: info.frame_count,
        episode_count: info.episode_count,
        timing,
        channels,
        delays,
        images,
        contact_sheet: contact_sheet(dataset),
        warnings: warnings.concat(),
    })
}

fn contact_sheet(dataset: &Dataset) -> Vec<FramePlace> {
    let frames = dataset.info().frame_count;
    let count = CONTACT_FRAMES.min(frames);
    // The middles of equal parts.
    let chosen = (0..count).map(|index| (2 * index + 1) * frames / (2 * count));
    chosen.filter_map(|frame| place_of(dataset, frame)).collect()
}

fn place_of(dataset: &Dataset, frame: usize) -> Option<FramePlace> {
    let holds_it = |episode: &&Episode| episode.frames().contains(&frame);
    let episode = dataset.episodes().iter().find(holds_it)?;
    Some(FramePlace {
        episode: episode.index,
        frame: frame - episode.first_frame,
    })
}

/// The first places, as in `episode 0 frame 12, episode 3 frame 7 and 4 more`.
fn listed(places: &[FramePlace]) -> String {
    const NAMED: usize = 3;
    let names: Vec<String> = places
        .iter()
        .take(NAMED)
        .map(|place| format!("episode {} frame {}", place.episode, place.frame))
        .collect();
    let more = places.len().saturating_sub(NAMED);
    let rest = if more == 0 {
        String::new()
    } else {
        format!(" and {more} more")
    };
    names.join(", ") + &rest
}

/// A count with its noun, as in `1 frame` or `3 frames`.
fn counted(count: usize, noun: &str) -> String {
    let ending = if count == 1 { "" } else { "s" };
    format!("{count} {noun}{ending}")
}

/// The median; 0 if there is no value.
fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_histogram_counts_every_value_once() {
        let values = [0.0, 0.1, 0.5, 0.99, 1.0];
        let histogram = Histogram::of(values.iter().copied(), 4);
        assert_eq!(histogram.counts, [2, 0, 1, 2]);
        assert_eq!(Histogram::of([3.0, 3.0].into_iter(), 2).counts, [2, 0]);
    }

    #[test]
    fn places_are_listed_with_the_number_of_the_others() {
        let places: Vec<_> = (0..5).map(|frame| FramePlace { episode: 1, frame }).collect();
        assert_eq!(
            listed(&places),
            "episode 1 frame 0, episode 1 frame 1, episode 1 frame 2 and 2 more"
        );
        assert_eq!(listed(&places[..1]), "episode 1 frame 0");
    }
}
