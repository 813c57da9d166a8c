//! How long the episodes are, and how regular the times of the frames.

use serde::Serialize;

use super::histogram::Histogram;
use super::places::{FramePlace, counted, listed, places};
use crate::dataset::Dataset;
use crate::dataset::sampler::{GAP_PERIODS, WINDOW_FRAMES, median};

/// A step that differs by more than this share of the median step is irregular.
const IRREGULAR_SHARE: f64 = 0.25;
/// Warn if more than this share of the steps is irregular.
const MANY_IRREGULAR: f64 = 0.05;
/// Warn if the median step differs by more than this share of the frame period.
const PERIOD_TOLERANCE: f64 = 0.05;
const STEP_BINS: usize = 40;

/// Lengths of episodes and times of frames.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameTiming {
    /// Seconds from one frame to the next, as the data set states it.
    pub frame_period_s: f64,
    /// Seconds of all episodes together.
    pub total_s: f64,
    /// Frames of the shortest episode.
    pub shortest_episode_frames: usize,
    /// The median number of frames of an episode.
    pub median_episode_frames: usize,
    /// Frames of the longest episode.
    pub longest_episode_frames: usize,
    /// Episodes that are too short for one window of 10 frames.
    pub short_episodes: usize,
    /// Least time from one frame to the next, in seconds.
    pub shortest_step_s: f64,
    /// The median time from one frame to the next, in seconds.
    pub median_step_s: f64,
    /// Greatest time from one frame to the next, in seconds.
    pub longest_step_s: f64,
    /// Steps that differ from the median step by more than a quarter.
    pub irregular_steps: usize,
    /// Number of all steps.
    pub steps: usize,
    /// Steps longer than 3.5 median steps.
    pub gaps: Vec<TimeGap>,
    /// All steps in milliseconds.
    pub step_ms_histogram: Histogram,
}

/// A step in time within an episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TimeGap {
    /// The frame before it.
    pub before: FramePlace,
    /// How long it takes, in seconds.
    pub seconds: f64,
}

pub(super) fn of(dataset: &Dataset) -> FrameTiming {
    let mut lengths: Vec<usize> = dataset.episodes().iter().map(|episode| episode.frame_count).collect();
    lengths.sort_unstable();
    let length = |place: usize| lengths.get(place).copied().unwrap_or_default();
    let steps = steps(dataset);
    let mut seconds: Vec<f64> = steps.iter().map(|step| step.seconds).collect();
    let total_s = seconds.iter().sum();
    let median_step_s = median(&mut seconds).unwrap_or_default();
    let is_gap = |step: &&TimeGap| step.seconds > GAP_PERIODS * median_step_s;
    let is_irregular = |step_s: &&f64| (*step_s - median_step_s).abs() > IRREGULAR_SHARE * median_step_s;
    FrameTiming {
        frame_period_s: dataset.info().frame_period_s,
        total_s,
        shortest_episode_frames: length(0),
        median_episode_frames: length(lengths.len() / 2),
        longest_episode_frames: length(lengths.len().saturating_sub(1)),
        short_episodes: lengths.iter().filter(|&&frames| frames < WINDOW_FRAMES).count(),
        shortest_step_s: seconds.iter().copied().reduce(f64::min).unwrap_or_default(),
        median_step_s,
        longest_step_s: seconds.iter().copied().reduce(f64::max).unwrap_or_default(),
        irregular_steps: seconds.iter().filter(is_irregular).count(),
        steps: steps.len(),
        gaps: steps.iter().filter(is_gap).copied().collect(),
        step_ms_histogram: Histogram::of(seconds.iter().map(|step_s| step_s * 1e3), STEP_BINS),
    }
}

/// Every step from one frame to the next.
fn steps(dataset: &Dataset) -> Vec<TimeGap> {
    let frames = places(dataset).enumerate().filter(|(_, place)| place.frame > 0);
    let steps = frames.map(|(index, place)| TimeGap {
        before: place.before(),
        seconds: dataset.timestamp_s(index) - dataset.timestamp_s(index - 1),
    });
    steps.collect()
}

impl FrameTiming {
    pub(super) fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.short_episodes > 0 {
            warnings.push(format!(
                "{} shorter than {WINDOW_FRAMES} frames. The presets need windows of {WINDOW_FRAMES} frames (5 to see, 5 to \
                 predict), so training does not use them. Record longer runs without interruption.",
                are(self.short_episodes, "episode")
            ));
        }
        if !self.gaps.is_empty() {
            let places: Vec<_> = self.gaps.iter().map(|gap| gap.before).collect();
            warnings.push(format!(
                "{} within an episode, after {}; the longest step takes {:.2} s. Windows never cross a gap, but frames were \
                 lost there. Check the disk and the load of the recorder.",
                are(self.gaps.len(), "gap"),
                listed(&places),
                self.longest_step_s
            ));
        }
        if self.irregular_steps as f64 > MANY_IRREGULAR * self.steps as f64 {
            warnings.push(format!(
                "The rate is irregular: {:.0} % of the steps differ by more than a quarter from the median step of {:.1} ms. \
                 The model takes all steps as equally long. Record at a fixed rate, or import with a lower --rate.",
                100.0 * self.irregular_steps as f64 / self.steps.max(1) as f64,
                self.median_step_s * 1e3
            ));
        }
        if (self.median_step_s - self.frame_period_s).abs() > PERIOD_TOLERANCE * self.frame_period_s && self.steps > 0 {
            warnings.push(format!(
                "The data set states a frame period of {:.1} ms, but the median step is {:.1} ms. Import it again with the \
                 true --rate.",
                self.frame_period_s * 1e3,
                self.median_step_s * 1e3
            ));
        }
        warnings
    }
}

/// `1 episode is` or `3 episodes are`.
fn are(count: usize, noun: &str) -> String {
    format!("{} {}", counted(count, noun), if count == 1 { "is" } else { "are" })
}
