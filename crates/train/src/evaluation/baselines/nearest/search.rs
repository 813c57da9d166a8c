//! The search for the training windows that are nearest to a window.

use rayon::prelude::*;

use super::small::{SmallImages, squared_byte_distance, squared_distance};
use crate::evaluation::EvaluationError;
use crate::evaluation::baselines::input::BaselineInput;
use crate::evaluation::statistics::mean_and_deviation;
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, Window};

/// Training windows that a window's future is made of, at most.
pub(super) const NEIGHBOURS: usize = 8;
/// Windows that are compared pixel by pixel in any case.
const FIRST_CANDIDATES: usize = 64;

/// A training window and its distance: the squared difference of all pixels of the inputs, in gray levels, plus the weighted
/// one of the actions to come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Neighbour {
    pub(super) window: Window,
    pub(super) distance: f64,
}

/// A training window that may be near.
#[derive(Clone, Copy)]
struct CandidateWindow {
    place: usize,
    /// The distance is not less than this.
    bound: f64,
    /// The actions' part of it.
    of_actions: f64,
}

/// What is known of the pixels' part of one window's distance.
#[derive(Clone, Copy)]
struct PixelDistance {
    /// Input frames that were compared pixel by pixel.
    compared_frames: usize,
    /// Their squared difference; before the first, what the small images say. The whole distance is not less.
    squared: f64,
}

/// The pixels of one window's inputs and what is known of their distances to all training windows. Searches with different
/// weights of the actions share it.
pub(super) struct PixelDistances {
    pixels: Vec<Vec<u8>>,
    by_place: Vec<PixelDistance>,
}

/// Training windows, with small images of their inputs.
pub(super) struct TrainingWindows {
    /// In order.
    windows: Vec<Window>,
    shape: WindowShape,
    images: SmallImages,
    /// The small image of each input frame of all windows, in order.
    small: Vec<f32>,
    /// Where in `small` each window's first image is. Those of its other frames follow.
    first_small: Vec<usize>,
    /// 1 / variance of each channel of the actions; 0 for a constant one.
    action_precision: Vec<f32>,
    /// The squared distance of pixels that counts as much as a squared distance of 1 between scaled actions.
    action_unit: f64,
}

impl TrainingWindows {
    /// None if there are no windows; they are in order. Errors: those of [`Dataset::pixels`].
    pub(super) fn new(
        dataset: &Dataset,
        windows: Vec<Window>,
        shape: WindowShape,
    ) -> Result<Option<Self>, EvaluationError> {
        if windows.is_empty() {
            return Ok(None);
        }
        let info = dataset.info();
        let images = SmallImages::new(info.frame_width_px as usize, info.frame_height_px as usize);
        let (mut frames, mut first_small) = (Vec::new(), Vec::with_capacity(windows.len()));
        for window in &windows {
            let inputs = window.first_frame..window.first_frame + shape.context;
            // Windows overlap: only frames after the last one are new.
            let new = frames
                .last()
                .map_or(inputs.start, |last: &usize| inputs.start.max(last + 1));
            first_small.push((frames.len() - (new.min(inputs.end) - inputs.start)) * images.values());
            frames.extend(new..inputs.end);
        }
        let mut small = vec![0.0; frames.len() * images.values()];
        let places = small.par_chunks_exact_mut(images.values()).zip(&frames);
        places.try_for_each(|(small, &frame)| {
            images.shrink(&dataset.pixels(frame)?, small);
            Ok::<(), EvaluationError>(())
        })?;
        let action_precision = action_precision(dataset, &frames);
        let varying = action_precision.iter().filter(|&&precision| precision > 0.0).count();
        let action_values = (varying * shape.horizon).max(1);
        Ok(Some(Self {
            action_unit: shape.context as f64 * variance(&small, images.values()) / action_values as f64,
            windows,
            shape,
            images,
            small,
            first_small,
            action_precision,
        }))
    }

    /// Windows that are searched.
    pub(super) fn len(&self) -> usize {
        self.windows.len()
    }

    /// Their shape.
    pub(super) fn shape(&self) -> WindowShape {
        self.shape
    }

    /// Whether an action differs anywhere.
    pub(super) fn has_actions(&self) -> bool {
        self.action_precision.iter().any(|&precision| precision > 0.0)
    }

    /// What the small images say of the distances of inputs, before any search.
    pub(super) fn pixel_distances(&self, input: &BaselineInput) -> PixelDistances {
        let bytes = |frame: &Vec<f32>| frame.iter().map(|value| (value * 255.0).round() as u8).collect();
        let pixels: Vec<Vec<u8>> = input.inputs.iter().map(bytes).collect();
        let values = self.images.values();
        let mut wanted = vec![0.0; pixels.len() * values];
        for (small, frame) in wanted.chunks_exact_mut(values).zip(&pixels) {
            self.images.shrink(frame, small);
        }
        let distance = |&first: &usize| {
            let small = &self.small[first..first + wanted.len()];
            PixelDistance {
                compared_frames: 0,
                // A little room for rounding.
                squared: (0.999 * f64::from(squared_distance(small, &wanted)) - 1.0).max(0.0),
            }
        };
        let by_place = self.first_small.iter().map(distance).collect();
        PixelDistances { pixels, by_place }
    }

    /// The [`NEIGHBOURS`] windows of least distance, the nearest first. They are exactly those: a window is left out only
    /// where its small images are farther than the last of them. Errors: those of [`Dataset::pixels`].
    pub(super) fn nearest(
        &self,
        dataset: &Dataset,
        distances: &mut PixelDistances,
        actions: &[&[f32]],
        action_weight: f64,
    ) -> Result<Vec<Neighbour>, EvaluationError> {
        let mut candidates = self.candidates(dataset, distances, actions, action_weight);
        let mut nearest = Vec::with_capacity(NEIGHBOURS + 1);
        let first = FIRST_CANDIDATES.min(candidates.len());
        candidates.select_nth_unstable_by(first - 1, |one, other| one.bound.total_cmp(&other.bound));
        let rest = candidates.split_off(first);
        self.compare(dataset, distances, candidates, &mut nearest)?;
        let limit = limit(&nearest);
        let rest = rest.into_iter().filter(|candidate| candidate.bound <= limit).collect();
        self.compare(dataset, distances, rest, &mut nearest)?;
        Ok(nearest)
    }

    /// Every window with the least distance that it may have.
    fn candidates(
        &self,
        dataset: &Dataset,
        distances: &PixelDistances,
        actions: &[&[f32]],
        action_weight: f64,
    ) -> Vec<CandidateWindow> {
        let scale = action_weight * self.action_unit;
        let candidate = |(place, pixels): (usize, &PixelDistance)| {
            let of_actions = if scale > 0.0 {
                scale * self.action_distance(dataset, self.windows[place], actions)
            } else {
                0.0
            };
            CandidateWindow {
                place,
                bound: pixels.squared + of_actions,
                of_actions,
            }
        };
        distances.by_place.iter().enumerate().map(candidate).collect()
    }

    /// The squared distance between the actions to come, each channel in its standard deviations.
    fn action_distance(&self, dataset: &Dataset, window: Window, actions: &[&[f32]]) -> f64 {
        let last = window.first_frame + self.shape.context - 1;
        let steps = actions.iter().zip(last..).map(|(wanted, frame)| {
            let channels = wanted.iter().zip(dataset.action(frame)).zip(&self.action_precision);
            channels
                .map(|((a, b), precision)| (a - b).powi(2) * precision)
                .sum::<f32>()
        });
        f64::from(steps.sum::<f32>())
    }

    /// Compares candidates pixel by pixel, until no other can be nearer.
    fn compare(
        &self,
        dataset: &Dataset,
        distances: &mut PixelDistances,
        mut candidates: Vec<CandidateWindow>,
        nearest: &mut Vec<Neighbour>,
    ) -> Result<(), EvaluationError> {
        candidates.sort_by(|one, other| one.bound.total_cmp(&other.bound));
        for candidate in candidates {
            let limit = limit(nearest);
            if candidate.bound > limit {
                break;
            }
            let window = self.windows[candidate.place];
            let known = &mut distances.by_place[candidate.place];
            let frames = distances.pixels.iter().zip(window.first_frame..);
            for (pixels, frame) in frames.skip(known.compared_frames) {
                if known.compared_frames == 0 {
                    known.squared = 0.0;
                }
                known.squared += squared_byte_distance(pixels, &dataset.pixels(frame)?) as f64;
                known.compared_frames += 1;
                if known.squared + candidate.of_actions > limit {
                    break;
                }
            }
            let distance = known.squared + candidate.of_actions;
            let place = nearest
                .partition_point(|other| (other.distance, other.window.first_frame) < (distance, window.first_frame));
            nearest.insert(place, Neighbour { window, distance });
            nearest.truncate(NEIGHBOURS);
        }
        Ok(())
    }
}

/// The distance of the last neighbour, once there are enough of them.
fn limit(nearest: &[Neighbour]) -> f64 {
    nearest.get(NEIGHBOURS - 1).map_or(f64::INFINITY, |last| last.distance)
}

/// 1 / variance of each channel of the actions at these frames; 0 for a constant one.
fn action_precision(dataset: &Dataset, frames: &[usize]) -> Vec<f32> {
    let channels = 0..dataset.info().action_channels.len();
    let precision = channels.map(|channel| {
        let values = frames.iter().map(|&frame| f64::from(dataset.action(frame)[channel]));
        let [_, deviation] = mean_and_deviation(values);
        if deviation > 1e-6 {
            deviation.powi(-2) as f32
        } else {
            0.0
        }
    });
    precision.collect()
}

/// The summed variance of the values of small images.
fn variance(small: &[f32], values: usize) -> f64 {
    let (mut sums, mut squares) = (vec![0.0; values], vec![0.0; values]);
    for image in small.chunks_exact(values) {
        for ((sum, square), &value) in sums.iter_mut().zip(&mut squares).zip(image) {
            *sum += f64::from(value);
            *square += f64::from(value).powi(2);
        }
    }
    let count = (small.len() / values) as f64;
    let variances = sums
        .iter()
        .zip(&squares)
        .map(|(sum, square)| square / count - (sum / count).powi(2));
    variances.map(|variance| variance.max(0.0)).sum()
}
