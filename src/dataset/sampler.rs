//! Which windows of a data set train, validate and test: a seeded split of whole trials, or of time for recordings.

use std::fmt;
use std::ops::Range;

use rand::Rng;
use rand::seq::index;

use super::{Dataset, DatasetError, Window};
use crate::types::Seed;

/// Timestamps further apart than this many median periods are a gap that no window crosses.
const GAP_PERIODS: f64 = 3.0;
/// Episodes without trial parameters are split whole when there are at least so many.
const WHOLE_EPISODES: usize = 10;
/// Trials are dealt out in blocks of ten: eight train, one validates, one tests.
const BLOCK: u64 = 10;

/// A part of the data with one purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Split {
    /// Weights are fitted to it.
    Train,
    /// Models and settings are selected on it.
    Validation,
    /// Scored once, for the published numbers: trials that training never saw.
    Test,
    /// Trials whose start/goal pair training never saw, whatever their gain; empty for recordings.
    UnseenPairs,
    /// Trials whose controller gain training never saw, with a start/goal pair that it saw; empty for recordings.
    UnseenGains,
}

impl Split {
    /// Every split, in the order of their declaration.
    pub const ALL: [Self; 5] = [
        Self::Train,
        Self::Validation,
        Self::Test,
        Self::UnseenPairs,
        Self::UnseenGains,
    ];

    /// `train`, `validation`, `test`, `unseen-pairs` or `unseen-gains`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Validation => "validation",
            Self::Test => "test",
            Self::UnseenPairs => "unseen-pairs",
            Self::UnseenGains => "unseen-gains",
        }
    }
}

impl fmt::Display for Split {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// How many frames a window spans: those seen and those to come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WindowShape {
    /// Frames seen.
    pub context: usize,
    /// Frames to come.
    pub horizon: usize,
}

impl WindowShape {
    /// Frames of the whole window.
    #[must_use]
    pub fn frames(self) -> usize {
        self.context + self.horizon
    }
}

/// A stretch of one episode that belongs to one split and has no gap in it.
#[derive(Clone, Debug, PartialEq)]
struct EpisodeSegment {
    episode: usize,
    frames: Range<usize>,
}

/// Whose data is whose. Simulated trials are split whole, by `(split seed, trial)` alone, so that a larger collection
/// keeps a smaller one's split; recordings by whole episodes where there are ten or more, else by time.
#[derive(Clone, Debug, PartialEq)]
pub struct Splits {
    episodes: [Vec<usize>; Split::ALL.len()],
    runs: [Vec<EpisodeSegment>; Split::ALL.len()],
    /// Timestamps further apart are a gap.
    max_step_s: f64,
}

impl Splits {
    /// The split of this data set by that seed.
    #[must_use]
    pub fn new(dataset: &Dataset, split_seed: Seed) -> Self {
        let mut splits = Self {
            episodes: Default::default(),
            runs: Default::default(),
            max_step_s: GAP_PERIODS * median_period_s(dataset),
        };
        let by_trial = dataset.episodes().iter().all(|episode| episode.trial.is_some());
        if by_trial || dataset.episodes().len() >= WHOLE_EPISODES {
            for episode in dataset.episodes() {
                let split = match &episode.trial {
                    Some(trial) if trial.has_held_out_pair() => Split::UnseenPairs,
                    Some(trial) if trial.is_held_out() => Split::UnseenGains,
                    Some(trial) => split_of(split_seed, trial.trial),
                    None => split_of(split_seed, episode.index as u64),
                };
                splits.add(dataset, split, episode.index, &episode.frames());
            }
        } else {
            splits.add_by_time(dataset);
        }
        splits
    }

    /// Deals all frames out in order: the first 80 % train, the next 10 % validate, the last 10 % test.
    fn add_by_time(&mut self, dataset: &Dataset) {
        let frame_count = dataset.info().frame_count;
        let (validation, test) = (frame_count * 8 / 10, frame_count * 9 / 10);
        for (split, part) in [
            (Split::Train, 0..validation),
            (Split::Validation, validation..test),
            (Split::Test, test..frame_count),
        ] {
            for episode in dataset.episodes() {
                let frames = episode.frames();
                let frames = frames.start.max(part.start)..frames.end.min(part.end);
                if !frames.is_empty() {
                    self.add(dataset, split, episode.index, &frames);
                }
            }
        }
    }

    fn add(&mut self, dataset: &Dataset, split: Split, episode: usize, frames: &Range<usize>) {
        self.episodes[split as usize].push(episode);
        let mut start = frames.start;
        for frame in frames.start + 1..=frames.end {
            if frame == frames.end || self.is_gap(dataset, frame) {
                self.runs[split as usize].push(EpisodeSegment {
                    episode,
                    frames: start..frame,
                });
                start = frame;
            }
        }
    }

    /// Whether too much time passed between that frame and the one before.
    fn is_gap(&self, dataset: &Dataset, frame: usize) -> bool {
        dataset.timestamp_s(frame) - dataset.timestamp_s(frame - 1) > self.max_step_s
    }

    /// Frames at the start of a run to leave out, because those just before belong to another split.
    fn guard(&self, dataset: &Dataset, run: &EpisodeSegment, shape: WindowShape) -> usize {
        let start = run.frames.start;
        let opens = dataset.episodes()[run.episode].first_frame == start || self.is_gap(dataset, start);
        if opens { 0 } else { shape.frames() }
    }

    /// Positions in [`Dataset::episodes`] of the episodes in a split, rising. Where recordings are split by time, an
    /// episode can have a part in more than one split.
    #[must_use]
    pub fn episodes(&self, split: Split) -> &[usize] {
        &self.episodes[split as usize]
    }

    /// Every `stride`-th window of a split, in order; none where the split is empty. No window crosses an episode's end
    /// or a gap in time, and where recordings are split by time the first ones after a boundary are left out.
    /// Errors: `Zero` for a stride, context or horizon of 0, `WindowTooLong` if none fits anywhere in the split.
    pub fn windows(
        &self,
        dataset: &Dataset,
        split: Split,
        shape: WindowShape,
        stride: usize,
    ) -> Result<Vec<Window>, DatasetError> {
        for (what, value) in [
            ("the stride of windows", stride),
            ("the context", shape.context),
            ("the horizon", shape.horizon),
        ] {
            if value == 0 {
                return Err(DatasetError::Zero { what });
            }
        }
        let mut windows = Vec::new();
        let mut longest = 0;
        for run in &self.runs[split as usize] {
            let frames = run.frames.start + self.guard(dataset, run, shape)..run.frames.end;
            longest = longest.max(frames.len());
            let last = (frames.end + 1).saturating_sub(shape.frames());
            windows.extend((frames.start..last).step_by(stride).map(|first_frame| Window {
                episode: run.episode,
                first_frame,
            }));
        }
        if windows.is_empty() && !self.runs[split as usize].is_empty() {
            return Err(DatasetError::WindowTooLong {
                window: shape.frames(),
                context: shape.context,
                horizon: shape.horizon,
                split: split.name(),
                longest,
            });
        }
        Ok(windows)
    }

    /// `count` different windows of a split, drawn at random, in random order.
    /// Errors: as [`Splits::windows`]; `TooFewWindows` if there aren't that many.
    #[expect(clippy::too_many_arguments, reason = "a draw is named by all five")]
    pub fn sample(
        &self,
        dataset: &Dataset,
        split: Split,
        shape: WindowShape,
        count: usize,
        seed: Seed,
    ) -> Result<Vec<Window>, DatasetError> {
        let windows = self.windows(dataset, split, shape, 1)?;
        if count > windows.len() {
            return Err(DatasetError::TooFewWindows {
                asked: count,
                split: split.name(),
                available: windows.len(),
            });
        }
        let chosen = index::sample(&mut seed.derive("windows", 0).rng(), windows.len(), count);
        Ok(chosen.iter().map(|place| windows[place]).collect())
    }
}

/// The split of a trial: within each block of ten trials one validates and one tests, drawn by seed and block.
fn split_of(split_seed: Seed, trial: u64) -> Split {
    let mut rng = split_seed.derive("split", trial / BLOCK).rng();
    let validation = rng.random_range(0..BLOCK);
    let test = (validation + rng.random_range(1..BLOCK)) % BLOCK;
    match trial % BLOCK {
        place if place == validation => Split::Validation,
        place if place == test => Split::Test,
        _ => Split::Train,
    }
}

/// The median step from one timestamp to the next within episodes; the nominal period where no episode has two frames.
fn median_period_s(dataset: &Dataset) -> f64 {
    let mut steps: Vec<f64> = dataset
        .episodes()
        .iter()
        .flat_map(|episode| episode.frames().skip(1))
        .map(|frame| dataset.timestamp_s(frame) - dataset.timestamp_s(frame - 1))
        .collect();
    if steps.is_empty() {
        return dataset.info().frame_period_s;
    }
    let middle = steps.len() / 2;
    *steps.select_nth_unstable_by(middle, f64::total_cmp).1
}
