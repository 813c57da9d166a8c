//! Brightness of the images, frames that repeat the one before, and jumps of the exposure.

use rayon::prelude::*;
use serde::Serialize;

use super::places::{FramePlace, counted, listed, places};
use super::timing::FrameTiming;
use crate::dataset::sampler::median;
use crate::dataset::{Dataset, DatasetError};

/// The largest difference of two pixels, in gray levels, that counts as equal.
const EQUAL_LEVELS: u8 = 1;
/// The least number of equal frames in a row, the first one included, that is called frozen.
const FROZEN_FRAMES: usize = 3;
/// The least jump of the mean brightness, in gray levels.
const JUMP_LEVELS: f64 = 10.0;
/// A jump is also this many times the usual change of the mean brightness.
const JUMP_FACTOR: f64 = 8.0;
/// At a change of the exposure, at least this share of the pixels changes in one direction, and at most the next share in the
/// other. Motion changes both.
const SAME_SHARE: f64 = 0.6;
const OPPOSITE_SHARE: f64 = 0.1;
/// A pixel that differs by more than this has changed.
const CHANGED_LEVELS: i16 = 2;
/// The least correlation of the pixels before and after a jump that shows the same view.
const SAME_VIEW: f64 = 0.8;
/// Warn beyond these.
const DARK_MEAN: f64 = 25.0;
const CLIPPED_SHARE: f64 = 0.25;
/// Parts of the timeline of brightness.
const TIMELINE_PARTS: usize = 480;
const LEVEL_BINS: usize = 32;

/// What the images look like.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ImageSummary {
    /// Mean gray level of all pixels, 0 to 255.
    pub mean_level: f64,
    /// Share of pixels that are black (0), 0 to 1.
    pub black_share: f64,
    /// Share of pixels that are white (255), 0 to 1.
    pub white_share: f64,
    /// All gray levels, in 32 ranges.
    pub level_counts: Vec<u64>,
    /// Mean absolute difference between one frame and the next, in gray levels.
    pub mean_change: f64,
    /// Frames that are equal to the one before.
    pub repeated_frames: Vec<FramePlace>,
    /// Runs of three and more equal frames.
    pub frozen: Vec<FrozenSpan>,
    /// Jumps of the brightness of the whole image.
    pub exposure_jumps: Vec<ExposureJump>,
    /// Least and greatest mean gray level of the frames in equal parts of the data set.
    #[serde(skip)]
    pub timeline: Vec<[f64; 2]>,
}

/// Equal frames, one after another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct FrozenSpan {
    /// The first of them.
    pub first: FramePlace,
    /// How many they are.
    pub frames: usize,
}

/// A jump of the brightness of the whole image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ExposureJump {
    /// The first frame after the jump.
    pub place: FramePlace,
    /// Mean gray level before.
    pub from_level: f64,
    /// Mean gray level after.
    pub to_level: f64,
}

/// One frame, compared with the one before it.
struct FrameChange {
    place: FramePlace,
    level: f64,
    /// None for the first frame of an episode.
    step: Option<LevelStep>,
}

impl FrameChange {
    /// Whether the frame equals the one before.
    fn is_repeated(&self) -> bool {
        self.step.as_ref().is_some_and(|step| step.is_equal)
    }
}

struct LevelStep {
    before: f64,
    mean_change: f64,
    is_equal: bool,
    is_one_way: bool,
}

pub(super) fn of(dataset: &Dataset) -> Result<ImageSummary, DatasetError> {
    let places: Vec<FramePlace> = places(dataset).collect();
    let changes = places.into_par_iter().enumerate();
    let changes: Result<Vec<_>, _> = changes.map(|(index, place)| change(dataset, place, index)).collect();
    let changes = changes?;
    let histogram = level_histogram(dataset)?;
    let pixels = histogram.iter().sum::<u64>().max(1) as f64;
    let steps: Vec<&LevelStep> = changes.iter().filter_map(|change| change.step.as_ref()).collect();
    let total_change: f64 = steps.iter().map(|step| step.mean_change).sum();
    let total_level: f64 = changes.iter().map(|change| change.level).sum();
    let ranges = histogram.chunks(256 / LEVEL_BINS);
    let repeated = changes.iter().filter(|change| change.is_repeated());
    Ok(ImageSummary {
        mean_level: total_level / changes.len().max(1) as f64,
        black_share: histogram[0] as f64 / pixels,
        white_share: histogram[255] as f64 / pixels,
        level_counts: ranges.map(|range| range.iter().sum()).collect(),
        mean_change: total_change / steps.len().max(1) as f64,
        repeated_frames: repeated.map(|change| change.place).collect(),
        frozen: frozen(&changes),
        exposure_jumps: jumps(&changes),
        timeline: timeline(&changes),
    })
}

fn change(dataset: &Dataset, place: FramePlace, index: usize) -> Result<FrameChange, DatasetError> {
    let now = dataset.pixels(index)?;
    let before = (place.frame > 0).then(|| dataset.pixels(index - 1)).transpose()?;
    Ok(FrameChange {
        place,
        level: mean(&now),
        step: before.map(|before| LevelStep::between(&before, &now)),
    })
}

impl LevelStep {
    fn between(before: &[u8], now: &[u8]) -> Self {
        let (mut total, mut brighter, mut darker) = (0u64, 0usize, 0usize);
        for (&now, &before) in now.iter().zip(before) {
            let difference = i16::from(now) - i16::from(before);
            total += u64::from(difference.unsigned_abs());
            brighter += usize::from(difference > CHANGED_LEVELS);
            darker += usize::from(difference < -CHANGED_LEVELS);
        }
        let pixels = now.len().max(1) as f64;
        let share = |count: usize| count as f64 / pixels;
        Self {
            before: mean(before),
            mean_change: total as f64 / pixels,
            is_equal: now.iter().zip(before).all(|(a, b)| a.abs_diff(*b) <= EQUAL_LEVELS),
            is_one_way: share(brighter.max(darker)) >= SAME_SHARE
                && share(brighter.min(darker)) <= OPPOSITE_SHARE
                && correlation(before, now) >= SAME_VIEW,
        }
    }
}

fn mean(pixels: &[u8]) -> f64 {
    pixels.iter().map(|&pixel| u64::from(pixel)).sum::<u64>() as f64 / pixels.len().max(1) as f64
}

/// Pearson's correlation of the pixels of two frames; 0 if one of them is flat.
fn correlation(a: &[u8], b: &[u8]) -> f64 {
    let (mean_a, mean_b) = (mean(a), mean(b));
    let mut sums = [0.0; 3];
    for (&a, &b) in a.iter().zip(b) {
        let (a, b) = (f64::from(a) - mean_a, f64::from(b) - mean_b);
        for (sum, term) in sums.iter_mut().zip([a * b, a * a, b * b]) {
            *sum += term;
        }
    }
    let [product, square_a, square_b] = sums;
    let scale = (square_a * square_b).sqrt();
    if scale < 1e-9 { 0.0 } else { product / scale }
}

fn level_histogram(dataset: &Dataset) -> Result<[u64; 256], DatasetError> {
    let mut histogram = [0; 256];
    for frame in 0..dataset.info().frame_count {
        for &pixel in &*dataset.pixels(frame)? {
            histogram[usize::from(pixel)] += 1;
        }
    }
    Ok(histogram)
}

fn frozen(changes: &[FrameChange]) -> Vec<FrozenSpan> {
    // A frame belongs to the run of the frame before if both are equal.
    let runs = changes.chunk_by(|_, now| now.is_repeated());
    let long = runs.filter(|run| run.len() >= FROZEN_FRAMES);
    long.map(|run| FrozenSpan {
        first: run[0].place,
        frames: run.len(),
    })
    .collect()
}

fn jumps(changes: &[FrameChange]) -> Vec<ExposureJump> {
    let steps = || changes.iter().filter_map(|now| Some((now, now.step.as_ref()?)));
    let jump = |(now, step): (&FrameChange, &LevelStep)| ExposureJump {
        place: now.place,
        from_level: step.before,
        to_level: now.level,
    };
    let mut usual: Vec<f64> = steps().map(jump).map(|jump| jump.size()).collect();
    let least = JUMP_LEVELS.max(JUMP_FACTOR * median(&mut usual).unwrap_or_default());
    let one_way = steps().filter(|(_, step)| step.is_one_way).map(jump);
    one_way.filter(|jump| jump.size() >= least).collect()
}

fn timeline(changes: &[FrameChange]) -> Vec<[f64; 2]> {
    let frames = changes.len().div_ceil(TIMELINE_PARTS).max(1);
    let range = |part: &[FrameChange]| {
        let levels = || part.iter().map(|change| change.level);
        [levels().fold(255.0, f64::min), levels().fold(0.0, f64::max)]
    };
    changes.chunks(frames).map(range).collect()
}

impl ImageSummary {
    pub(super) fn warnings(&self, timing: &FrameTiming) -> Vec<String> {
        let mut warnings = Vec::new();
        if !self.frozen.is_empty() {
            let places: Vec<_> = self.frozen.iter().map(|span| span.first).collect();
            let longest = self.frozen.iter().map(|span| span.frames).max().unwrap_or_default();
            warnings.push(format!(
                "The image is frozen in {}, from {}; the longest has {longest} equal frames ({:.1} s). Either the camera \
                 stopped or nothing moved. A model that trains on many of them learns to repeat the last frame; cut them out \
                 of the recording.",
                counted(self.frozen.len(), "place"),
                listed(&places),
                longest as f64 * timing.frame_period_s
            ));
        }
        let in_frozen: usize = self.frozen.iter().map(|span| span.frames - 1).sum();
        let single = self.repeated_frames.len().saturating_sub(in_frozen);
        if single > 0 {
            warnings.push(format!(
                "{} {} the frame before without being part of a longer standstill. The recorder probably runs faster than \
                 the camera; import with the camera's --rate.",
                counted(single, "frame"),
                if single == 1 { "repeats" } else { "repeat" }
            ));
        }
        if let Some(worst) = self.exposure_jumps.iter().max_by(|a, b| a.size().total_cmp(&b.size())) {
            let places: Vec<_> = self.exposure_jumps.iter().map(|jump| jump.place).collect();
            warnings.push(format!(
                "The exposure jumps {}, at {}; the greatest jump is from gray level {:.0} to {:.0}. Nothing in the past frames \
                 announces a jump, so no model can predict it. Fix the exposure of the camera.",
                counted(places.len(), "time"),
                listed(&places),
                worst.from_level,
                worst.to_level
            ));
        }
        warnings.extend(self.brightness_warnings());
        warnings
    }

    fn brightness_warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.mean_level < DARK_MEAN {
            warnings.push(format!(
                "The images are dark: their mean gray level is {:.0} of 255. Record with more light or a longer exposure.",
                self.mean_level
            ));
        }
        for (share, what, right) in [
            (self.black_share, "black", "a longer"),
            (self.white_share, "white", "a shorter"),
        ] {
            if share > CLIPPED_SHARE {
                warnings.push(format!(
                    "{:.0} % of the pixels are pure {what}, so they show nothing. Record with {right} exposure; bars of \
                     --resize letterbox count as black, too.",
                    100.0 * share
                ));
            }
        }
        warnings
    }
}

impl ExposureJump {
    fn size(&self) -> f64 {
        (self.to_level - self.from_level).abs()
    }
}
