//! Divides a data set into training, validation and test parts: by complete trials with a seed, and by time for recordings.

use std::fmt;
use std::ops::Range;

use rand::Rng;
use rand::seq::index;

use super::{Dataset, DatasetError};
use foreframe_core::types::Seed;
use foreframe_sim::TrialParameters;

/// A time step longer than this many median periods is a gap. No window crosses a gap.
const GAP_PERIODS: f64 = 3.0;
/// Recordings are split by complete episodes if there are at least this many, otherwise by time.
const WHOLE_EPISODES: usize = 10;
/// Trials are split in blocks of ten: eight for training, one for validation, one for testing.
const BLOCK: u64 = 10;

/// A part of the data with one purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Split {
    /// For fitting the weights.
    Train,
    /// For selecting weights and settings.
    Validation,
    /// For the final scores: trials that training never uses.
    Test,
    /// Trials with a start/goal pair that training never uses; empty for recordings.
    UnseenPairs,
    /// Trials with a PID gain that training never uses, and with one of its start/goal pairs; empty for recordings.
    UnseenGains,
}

impl Split {
    /// All splits, in the order of declaration.
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

/// The number of frames of a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WindowShape {
    /// Context frames.
    pub context: usize,
    /// Frames to predict.
    pub horizon: usize,
}

impl WindowShape {
    /// Frames of the whole window.
    #[must_use]
    pub fn frames(self) -> usize {
        self.context + self.horizon
    }
}

/// `context + horizon` consecutive frames of one episode: the context, then the frames to predict.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Window {
    /// Position in [`Dataset::episodes`].
    pub episode: usize,
    /// The first context frame, counted over the whole data set.
    pub first_frame: usize,
}

/// Consecutive frames of one episode that belong to one split and contain no gap.
#[derive(Clone, Debug, PartialEq)]
struct EpisodeSegment {
    episode: usize,
    frames: Range<usize>,
}

/// The episodes and segments of each split. Simulated trials are never divided; their split depends only on split seed and
/// trial number, so that trials keep their split when a collection grows. Recordings are split by time, in complete episodes
/// if there are ten or more.
#[derive(Clone, Debug, PartialEq)]
pub struct Splits {
    episodes: [Vec<usize>; Split::ALL.len()],
    segments: [Vec<EpisodeSegment>; Split::ALL.len()],
    /// A longer time step is a gap, in seconds.
    max_step_s: f64,
}

impl Splits {
    /// Splits the data set with this seed.
    #[must_use]
    pub fn new(dataset: &Dataset, split_seed: Seed) -> Self {
        let mut splits = Self {
            episodes: Default::default(),
            segments: Default::default(),
            max_step_s: GAP_PERIODS * median_period_s(dataset),
        };
        let trials: Option<Vec<&TrialParameters>> = dataset
            .episodes()
            .iter()
            .map(|episode| episode.trial.as_ref())
            .collect();
        match trials {
            Some(trials) => {
                for (episode, trial) in dataset.episodes().iter().zip(trials) {
                    let split = match trial {
                        trial if trial.has_held_out_pair() => Split::UnseenPairs,
                        trial if trial.is_held_out() => Split::UnseenGains,
                        trial => split_of(split_seed, trial.trial),
                    };
                    splits.add(dataset, split, episode.index, &episode.frames());
                }
            }
            None if dataset.episodes().len() >= WHOLE_EPISODES => splits.add_whole_episodes(dataset),
            None => splits.add_by_time(dataset),
        }
        splits
    }

    /// Every episode in the test split, for a data set that holds nothing but test data.
    #[must_use]
    pub fn all_for_test(dataset: &Dataset) -> Self {
        let mut splits = Self {
            episodes: Default::default(),
            segments: Default::default(),
            max_step_s: GAP_PERIODS * median_period_s(dataset),
        };
        for episode in dataset.episodes() {
            splits.add(dataset, Split::Test, episode.index, &episode.frames());
        }
        splits
    }

    /// Splits complete episodes by time. The last ones, with at least a tenth of all frames, are for testing; the ones before
    /// them, with at least a tenth, for validation; the others for training.
    fn add_whole_episodes(&mut self, dataset: &Dataset) {
        let tenth = dataset.info().frame_count.div_ceil(10);
        let (mut test, mut validation) = (0, 0);
        for episode in dataset.episodes().iter().rev() {
            let split = if test < tenth {
                test += episode.frame_count;
                Split::Test
            } else if validation < tenth {
                validation += episode.frame_count;
                Split::Validation
            } else {
                Split::Train
            };
            self.add(dataset, split, episode.index, &episode.frames());
        }
        for split in Split::ALL {
            self.episodes[split as usize].reverse();
            self.segments[split as usize].sort_by_key(|segment| segment.frames.start);
        }
    }

    /// Splits all frames by time: the first 80 % for training, the next 10 % for validation, the last 10 % for testing.
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
                self.segments[split as usize].push(EpisodeSegment {
                    episode,
                    frames: start..frame,
                });
                start = frame;
            }
        }
    }

    /// Whether there is a gap between the previous frame and this one.
    fn is_gap(&self, dataset: &Dataset, frame: usize) -> bool {
        dataset.timestamp_s(frame) - dataset.timestamp_s(frame - 1) > self.max_step_s
    }

    /// Number of frames to skip at the start of a segment, if the frames just before it belong to another split.
    fn skipped_frames(&self, dataset: &Dataset, segment: &EpisodeSegment, shape: WindowShape) -> usize {
        let start = segment.frames.start;
        let is_first = dataset.episodes()[segment.episode].first_frame == start || self.is_gap(dataset, start);
        if is_first { 0 } else { shape.frames() }
    }

    /// Positions in [`Dataset::episodes`] of the episodes of a split, in increasing order. If recordings are split by time,
    /// one episode can belong to several splits.
    #[must_use]
    pub fn episodes(&self, split: Split) -> &[usize] {
        &self.episodes[split as usize]
    }

    /// Every `stride`-th window of a split, in order; no windows if the split is empty. No window crosses an episode's end or
    /// a gap. If recordings are split by time, the first windows after a boundary are skipped, so that splits do not overlap.
    /// Errors: `Zero` for a stride, context or horizon of 0, `WindowTooLong` if no segment of the split is long enough.
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
        for segment in &self.segments[split as usize] {
            let first = segment.frames.start + self.skipped_frames(dataset, segment, shape);
            let frames = first..segment.frames.end;
            longest = longest.max(frames.len());
            let last = (frames.end + 1).saturating_sub(shape.frames());
            windows.extend((frames.start..last).step_by(stride).map(|first_frame| Window {
                episode: segment.episode,
                first_frame,
            }));
        }
        if windows.is_empty() && !self.segments[split as usize].is_empty() {
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
    /// Errors: as [`Splits::windows`]; `TooFewWindows` if the split has fewer windows.
    #[expect(clippy::too_many_arguments, reason = "the draw depends on all five")]
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
                requested: count,
                split: split.name(),
                available: windows.len(),
            });
        }
        let chosen = index::sample(&mut seed.derive("windows", 0).rng(), windows.len(), count);
        Ok(chosen.iter().map(|index| windows[index]).collect())
    }
}

/// The split of a trial. In each block of ten trials, one is for validation and one for testing, drawn from seed and block.
fn split_of(split_seed: Seed, trial: u64) -> Split {
    let mut rng = split_seed.derive("split", trial / BLOCK).rng();
    let validation = rng.random_range(0..BLOCK);
    let test = (validation + rng.random_range(1..BLOCK)) % BLOCK;
    match trial % BLOCK {
        position if position == validation => Split::Validation,
        position if position == test => Split::Test,
        _ => Split::Train,
    }
}

/// The median time step within episodes, in seconds; the frame period of the description if no episode has two frames.
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
