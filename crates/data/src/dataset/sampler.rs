//! Divides a data set into training, validation and test parts: by complete trials with a seed, and by time for recordings.

use std::ops::Range;

use rand::Rng;
use rand::seq::index;

use super::check::check_counts;
use super::{Dataset, DatasetError, Episode};
use foreframe_core::named_enum;
use foreframe_core::types::Seed;
use foreframe_sim::TrialParameters;

/// A time step longer than this many median periods is a gap. No window crosses a gap. A step of three periods never is one, whatever
/// the last bits of the times are.
pub(crate) const GAP_PERIODS: f64 = 3.5;
/// Recordings are split by complete episodes if there are at least this many, otherwise by time.
const WHOLE_EPISODES: usize = 10;
/// Frames of the windows of all presets: 5 to see and 5 to predict.
pub(crate) const WINDOW_FRAMES: usize = 10;
/// Trials are split in blocks of ten: eight for training, one for validation, one for testing.
const BLOCK: u64 = 10;

named_enum! {
    /// A part of the data with one purpose.
    #[derive(Hash)]
    pub enum Split {
        /// For fitting the weights.
        Train = "train",
        /// For selecting weights and settings.
        Validation = "validation",
        /// For the final scores: trials that training never uses.
        Test = "test",
        /// Trials with a start/goal pair that training never uses; empty for recordings.
        UnseenPairs = "unseen-pairs",
        /// Trials with a PID gain that training never uses, and with one of its start/goal pairs; empty for recordings.
        UnseenGains = "unseen-gains",
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

/// Keeps the windows that lie within the first `seconds` of the frames that the windows cover; 0 keeps all. The windows must be in the order
/// of their frames.
#[must_use]
pub fn first_seconds(windows: Vec<Window>, shape: WindowShape, period_s: f64, seconds: f64) -> Vec<Window> {
    if seconds <= 0.0 {
        return windows;
    }
    let (mut shown, mut next) = (0, 0);
    let lies_inside = move |window: &Window| {
        // Windows overlap; each frame counts once.
        let end = window.first_frame + shape.frames();
        shown += end - next.clamp(window.first_frame, end);
        next = next.max(end);
        shown as f64 * period_s <= seconds * (1.0 + 1e-9)
    };
    windows.into_iter().take_while(lies_inside).collect()
}

/// `context + horizon` consecutive frames of one episode: the context, then the frames to predict.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Window {
    /// Position in [`Dataset::episodes`].
    pub episode: usize,
    /// The first context frame, counted over the whole data set.
    pub first_frame: usize,
}

/// Consecutive frames of one episode that belong to one split.
#[derive(Clone, Debug, PartialEq)]
struct EpisodeSegment {
    episode: usize,
    frames: Range<usize>,
}

impl EpisodeSegment {
    fn whole(episode: &Episode) -> Self {
        Self {
            episode: episode.index,
            frames: episode.frames(),
        }
    }
}

/// The episodes and segments of each split. Simulated trials are never divided; their split depends only on split seed and
/// trial number, so that trials keep their split when a collection grows. Recordings are split by time, in complete episodes
/// if there are ten or more and this leaves enough for training.
#[derive(Clone, Debug, PartialEq)]
pub struct Splits {
    episodes: [Vec<usize>; Split::ALL.len()],
    /// They contain no gap.
    segments: [Vec<EpisodeSegment>; Split::ALL.len()],
    /// A longer time step is a gap, in seconds.
    max_step_s: f64,
}

impl Splits {
    /// Splits the data set with this seed.
    #[must_use]
    pub fn new(dataset: &Dataset, split_seed: Seed) -> Self {
        let parts = dataset.parts().into_iter();
        Self::of(
            dataset,
            parts.flat_map(|part| split_part(&dataset.episodes()[part.episodes], split_seed)),
        )
    }

    /// Every episode in the test split, for a data set that holds nothing but test data.
    #[must_use]
    pub fn all_for_test(dataset: &Dataset) -> Self {
        let whole = dataset.episodes().iter().map(EpisodeSegment::whole);
        Self::of(dataset, whole.map(|whole| (Split::Test, whole)))
    }

    /// The splits that consist of these segments, which are in order. They are cut at gaps.
    fn of(dataset: &Dataset, parts: impl IntoIterator<Item = (Split, EpisodeSegment)>) -> Self {
        let mut splits = Self {
            episodes: Default::default(),
            segments: Default::default(),
            max_step_s: GAP_PERIODS * median_period_s(dataset),
        };
        for (split, EpisodeSegment { episode, frames }) in parts {
            splits.episodes[split as usize].push(episode);
            let mut start = frames.start;
            for frame in frames.start + 1..=frames.end {
                if frame == frames.end || splits.is_gap(dataset, frame) {
                    let frames = start..frame;
                    splits.segments[split as usize].push(EpisodeSegment { episode, frames });
                    start = frame;
                }
            }
        }
        splits
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
    /// Errors: `Usage` for a stride, context or horizon of 0, `WindowTooLong` if no segment of the split is long enough.
    pub fn windows(
        &self,
        dataset: &Dataset,
        split: Split,
        shape: WindowShape,
        stride: usize,
    ) -> Result<Vec<Window>, DatasetError> {
        check_counts(&[
            ("the stride of windows", stride as u64),
            ("the context", shape.context as u64),
            ("the horizon", shape.horizon as u64),
        ])?;
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
                context: shape.context,
                horizon: shape.horizon,
                split: split.name(),
                longest,
            });
        }
        Ok(windows)
    }

    /// `count` different windows of a split, drawn at random, in random order.
    /// Errors: as [`Splits::windows`]; `Usage` if the split has fewer windows.
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
            return Err(DatasetError::Usage(format!(
                "data.windows is {count}, but the {split} split has only {} windows; use a smaller number, use \
                 data.windows=all, or collect more trials",
                windows.len()
            )));
        }
        let chosen = index::sample(&mut seed.derive("windows", 0).rng(), windows.len(), count);
        Ok(chosen.iter().map(|index| windows[index]).collect())
    }
}

/// The segments of the episodes of one data set.
fn split_part(episodes: &[Episode], split_seed: Seed) -> Vec<(Split, EpisodeSegment)> {
    let trials: Option<Vec<&TrialParameters>> = episodes.iter().map(|episode| episode.trial.as_ref()).collect();
    let whole = episodes.iter().map(EpisodeSegment::whole);
    match trials {
        Some(trials) => {
            let splits = trials.into_iter().map(|trial| match trial {
                trial if trial.has_held_out_pair() => Split::UnseenPairs,
                trial if trial.is_held_out() => Split::UnseenGains,
                trial => split_of(split_seed, trial.trial),
            });
            splits.zip(whole).collect()
        }
        None if episodes.len() >= WHOLE_EPISODES => {
            let mut splits = [1, WINDOW_FRAMES]
                .map(|least| whole_episodes(episodes, least))
                .into_iter();
            splits
                .find(|split| is_usable(split))
                .unwrap_or_else(|| by_time(episodes))
        }
        None => by_time(episodes),
    }
}

/// Whether half of the frames are for training, and each part can have windows if any episode can.
fn is_usable(parts: &[(Split, EpisodeSegment)]) -> bool {
    let of = |split| {
        parts
            .iter()
            .filter(move |part| part.0 == split)
            .map(|part| part.1.frames.len())
    };
    let longest = |split| of(split).max().unwrap_or_default();
    let splits = [Split::Train, Split::Validation, Split::Test];
    let has_windows = splits.map(|split| longest(split) >= WINDOW_FRAMES);
    let all: usize = splits.into_iter().flat_map(of).sum();
    2 * of(Split::Train).sum::<usize>() >= all && (has_windows == [true; 3] || has_windows == [false; 3])
}

/// The frames of these episodes, which follow one another.
fn frames_of(episodes: &[Episode]) -> Range<usize> {
    let (first, last) = (episodes.first(), episodes.last());
    first.map_or(0, |first| first.first_frame)..last.map_or(0, |last| last.frames().end)
}

/// Splits complete episodes by time. The last ones, with at least a tenth of all frames, are for testing; the ones before
/// them, with at least a tenth, for validation; the others for training. Episodes of less than `least` frames do not count.
fn whole_episodes(episodes: &[Episode], least: usize) -> Vec<(Split, EpisodeSegment)> {
    let tenth = frames_of(episodes).len().div_ceil(10);
    let (mut test, mut validation) = (0, 0);
    let backwards = episodes.iter().rev().map(|episode| {
        let counted = if episode.frame_count < least {
            0
        } else {
            episode.frame_count
        };
        let split = if test < tenth {
            test += counted;
            Split::Test
        } else if validation < tenth {
            validation += counted;
            Split::Validation
        } else {
            Split::Train
        };
        (split, EpisodeSegment::whole(episode))
    });
    let mut parts: Vec<_> = backwards.collect();
    parts.reverse();
    parts
}

/// Splits all frames by time: the first 80 % for training, the next 10 % for validation, the last 10 % for testing.
fn by_time(episodes: &[Episode]) -> Vec<(Split, EpisodeSegment)> {
    let all = frames_of(episodes);
    let (validation, test) = (all.start + all.len() * 8 / 10, all.start + all.len() * 9 / 10);
    let parts = [
        (Split::Train, all.start..validation),
        (Split::Validation, validation..test),
        (Split::Test, test..all.end),
    ];
    let segments = parts.into_iter().flat_map(|(split, part)| {
        let segments = episodes.iter().map(move |whole| EpisodeSegment {
            episode: whole.index,
            frames: whole.frames().start.max(part.start)..whole.frames().end.min(part.end),
        });
        let segments = segments.filter(|segment| !segment.frames.is_empty());
        segments.map(move |segment| (split, segment))
    });
    segments.collect()
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
    let frames = dataset.episodes().iter().flat_map(|episode| episode.frames().skip(1));
    let steps = frames.map(|frame| dataset.timestamp_s(frame) - dataset.timestamp_s(frame - 1));
    median(&mut steps.collect::<Vec<f64>>()).unwrap_or(dataset.info().frame_period_s)
}

/// The median, if there are values.
pub(crate) fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_seconds_count_each_frame_once_and_no_gap() {
        let shape = WindowShape { context: 2, horizon: 1 };
        let window = |first_frame| Window {
            episode: 0,
            first_frame,
        };
        // Frames 0 to 5, and after a gap 10 to 13.
        let all: Vec<Window> = [0, 1, 2, 3, 10, 11].map(window).to_vec();
        let kept = |seconds: f64| first_seconds(all.clone(), shape, 0.1, seconds).len();
        let counts = [0.0, 0.2, 0.3, 0.4, 0.6, 0.8, 0.9, 1.0].map(kept);
        assert_eq!(counts, [6, 0, 1, 2, 4, 4, 5, 6]);
    }
}
