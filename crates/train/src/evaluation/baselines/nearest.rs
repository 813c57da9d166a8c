//! The weighted mean of the frames that follow in the training windows whose inputs, and actions to come, differ least.

mod search;
mod small;

use rayon::prelude::*;

use self::search::{Neighbour, TrainingWindows};
use super::input::BaselineInput;
use crate::evaluation::EvaluationError;
use crate::evaluation::report::NearestSummary;
use crate::evaluation::windows::{evenly, true_frame};
use foreframe_core::frame::quality::mse;
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, Window};

/// Validation windows by which the weights are chosen at most, evenly spread.
const MAX_VALIDATION_WINDOWS: usize = 300;
/// Exponents to choose from. 0 is the plain mean; the greatest is almost the nearest window alone.
const EXPONENTS: [f64; 7] = [0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 32.0];
/// Weights of the actions to choose from.
const ACTION_WEIGHTS: [f64; 6] = [0.0, 0.01, 0.1, 0.3, 1.0, 3.0];

/// The windows that the baseline is made of.
pub(super) struct WindowSets<'a> {
    pub(super) training: &'a [Window],
    pub(super) validation: &'a [Window],
    pub(super) shape: WindowShape,
    /// Training windows that are searched at most.
    pub(super) searched: usize,
    /// What was chosen for the same windows before.
    pub(super) known: Option<NearestSummary>,
}

/// The baseline with its training windows.
pub(super) struct NearestWindows {
    windows: TrainingWindows,
    summary: NearestSummary,
}

impl NearestWindows {
    /// Keeps at most `searched` training windows, evenly spread, and chooses the weights by the MSE on validation windows.
    /// None if there are no training windows. Errors: those of [`Dataset::pixels`].
    pub(super) fn fit(dataset: &Dataset, sets: &WindowSets) -> Result<Option<Self>, EvaluationError> {
        let kept = evenly(sets.training, sets.searched);
        let Some(windows) = TrainingWindows::new(dataset, kept, sets.shape)? else {
            return Ok(None);
        };
        let summary = match sets.known {
            Some(known) => known,
            None => choose(dataset, &windows, sets)?,
        };
        Ok(Some(Self { windows, summary }))
    }

    /// What was searched and chosen.
    pub(super) fn summary(&self) -> NearestSummary {
        self.summary
    }

    /// The weighted mean of the neighbours' frames to predict. Errors: those of [`Dataset::pixels`].
    pub(super) fn predict(
        &self,
        dataset: &Dataset,
        input: &BaselineInput,
        horizon: usize,
    ) -> Result<Vec<Vec<f32>>, EvaluationError> {
        let mut distances = self.windows.pixel_distances(input);
        let weight = self.summary.action_weight;
        let neighbours = self.windows.nearest(dataset, &mut distances, &input.actions, weight)?;
        let weights = weights(&neighbours, self.summary.exponent);
        let first = input.inputs.len();
        let steps = (first..first + horizon).map(|step| Ok(mean(&frames_at(dataset, &neighbours, step)?, &weights)));
        steps.collect()
    }
}

/// Chooses the weights by the MSE on validation windows. Errors: those of [`Dataset::pixels`].
fn choose(dataset: &Dataset, windows: &TrainingWindows, sets: &WindowSets) -> Result<NearestSummary, EvaluationError> {
    let validation = evenly(sets.validation, MAX_VALIDATION_WINDOWS);
    let mut summary = NearestSummary {
        searched: windows.len(),
        available: sets.training.len(),
        validation_windows: validation.len(),
        exponent: 1.0,
        action_weight: 0.0,
    };
    let action_weights = if windows.has_actions() {
        &ACTION_WEIGHTS[..]
    } else {
        &[0.0]
    };
    let errors = validation_errors(dataset, windows, &validation, action_weights)?;
    let mut least = f64::INFINITY;
    for (&action_weight, errors) in action_weights.iter().zip(errors) {
        for (exponent, error) in EXPONENTS.into_iter().zip(errors) {
            // Without a validation window no error is known.
            if error < least && !validation.is_empty() {
                least = error;
                (summary.exponent, summary.action_weight) = (exponent, action_weight);
            }
        }
    }
    Ok(summary)
}

/// The sum of the MSE over validation windows and steps, for each weight of the actions and each of [`EXPONENTS`]. Errors:
/// those of [`Dataset::pixels`].
fn validation_errors(
    dataset: &Dataset,
    windows: &TrainingWindows,
    validation: &[Window],
    action_weights: &[f64],
) -> Result<Vec<[f64; EXPONENTS.len()]>, EvaluationError> {
    let shape = windows.shape();
    let errors_of = |&window: &Window| -> Result<Vec<[f64; EXPONENTS.len()]>, EvaluationError> {
        let inputs = (0..shape.context).map(|step| true_frame(dataset, window.first_frame + step));
        let inputs = inputs.collect::<Result<Vec<_>, _>>()?;
        let input = BaselineInput::of_window(dataset, window, shape, &inputs);
        let mut distances = windows.pixel_distances(&input);
        let mut by_weight = vec![[0.0; EXPONENTS.len()]; action_weights.len()];
        for (errors, &action_weight) in by_weight.iter_mut().zip(action_weights) {
            let neighbours = windows.nearest(dataset, &mut distances, &input.actions, action_weight)?;
            for step in shape.context..shape.frames() {
                let frames = frames_at(dataset, &neighbours, step)?;
                let truth = true_frame(dataset, window.first_frame + step)?;
                for (error, exponent) in errors.iter_mut().zip(EXPONENTS) {
                    *error += mse(&mean(&frames, &weights(&neighbours, exponent)), &truth);
                }
            }
        }
        Ok(by_weight)
    };
    let by_window = validation.par_iter().map(errors_of).collect::<Result<Vec<_>, _>>()?;
    // Added in one order, so that the same weights are chosen in every run.
    let mut sums = vec![[0.0; EXPONENTS.len()]; action_weights.len()];
    for errors in by_window {
        for (sum, error) in sums.as_flattened_mut().iter_mut().zip(errors.as_flattened()) {
            *sum += error;
        }
    }
    Ok(sums)
}

/// The neighbours' frames at a step of their windows. Errors: those of [`Dataset::pixels`].
fn frames_at(dataset: &Dataset, neighbours: &[Neighbour], step: usize) -> Result<Vec<Vec<f32>>, EvaluationError> {
    let frames = neighbours
        .iter()
        .map(|near| Ok(true_frame(dataset, near.window.first_frame + step)?));
    frames.collect()
}

/// 1 / distance to the power of the exponent, so that the weights add up to 1. A distance is at least 1, the square of one gray
/// level in one pixel.
fn weights(neighbours: &[Neighbour], exponent: f64) -> Vec<f32> {
    let least = neighbours.first().map_or(1.0, |nearest| nearest.distance.max(1.0));
    let relative = neighbours
        .iter()
        .map(|near| (least / near.distance.max(1.0)).powf(exponent));
    let relative: Vec<f64> = relative.collect();
    let sum: f64 = relative.iter().sum();
    relative.into_iter().map(|weight| (weight / sum) as f32).collect()
}

/// The weighted mean of frames.
fn mean(frames: &[Vec<f32>], weights: &[f32]) -> Vec<f32> {
    let mut sum = vec![0.0; frames.first().map_or(0, Vec::len)];
    for (frame, weight) in frames.iter().zip(weights) {
        for (sum, value) in sum.iter_mut().zip(frame) {
            *sum += weight * value;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::evaluation::baselines::input::BaselineInput;
    use foreframe_core::types::{Channel, Seed};
    use foreframe_data::dataset::{DatasetInfo, EpisodeData};

    const SHAPE: WindowShape = WindowShape { context: 2, horizon: 1 };
    const SIDE: usize = 12;

    /// One recording of one-channel frames and actions, and all its windows.
    fn recording(frames: &[Vec<u8>], actions: &[f32]) -> (Dataset, Vec<Window>) {
        let episode = EpisodeData {
            timestamps_s: (0..frames.len()).map(|time| time as f64 * 0.2).collect(),
            pixels: frames.concat(),
            actions: actions.to_vec(),
            ..EpisodeData::default()
        };
        let info = DatasetInfo {
            name: "made-up".to_owned(),
            frame_width_px: SIDE as u32,
            frame_height_px: SIDE as u32,
            frame_period_s: 0.2,
            action_channels: vec![Channel::new("pan", "px")],
            ..DatasetInfo::default()
        };
        let windows = (0..=frames.len() - SHAPE.frames()).map(|first_frame| Window {
            episode: 0,
            first_frame,
        });
        let windows = windows.collect();
        (Dataset::from_episodes(info, vec![episode]).unwrap(), windows)
    }

    /// Frames that differ little as wholes and much in their pixels, so that small images say little.
    fn noise(count: usize) -> Vec<Vec<u8>> {
        let mut rng = Seed(3).rng();
        let frame = |_| (0..SIDE * SIDE).map(|_| rng.random()).collect();
        (0..count).map(frame).collect()
    }

    fn inputs(dataset: &Dataset, window: Window) -> Vec<Vec<f32>> {
        let frames = (0..SHAPE.context).map(|step| true_frame(dataset, window.first_frame + step).unwrap());
        frames.collect()
    }

    /// The squared distance between the pixels of two windows' inputs.
    fn distance(dataset: &Dataset, one: Window, other: Window) -> f64 {
        let frames = (0..SHAPE.context).map(|step| {
            let [one, other] = [one, other].map(|window| dataset.pixels(window.first_frame + step).unwrap());
            let squares = one.iter().zip(&*other).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
            squares.sum::<f64>()
        });
        frames.sum()
    }

    /// The neighbours, whatever the actions.
    fn nearest(search: &TrainingWindows, dataset: &Dataset, input: &BaselineInput) -> Vec<Neighbour> {
        let mut distances = search.pixel_distances(input);
        // A second search finds the same, though it compares fewer pixels.
        let first = search.nearest(dataset, &mut distances, &input.actions, 0.0).unwrap();
        let second = search.nearest(dataset, &mut distances, &input.actions, 0.0).unwrap();
        assert_eq!(first, second);
        first
    }

    #[test]
    fn the_neighbours_are_exactly_those_of_a_full_search() {
        let frames = noise(400);
        let (dataset, windows) = recording(&frames, &vec![0.0; frames.len()]);
        let (training, others) = windows.split_at(300);
        let search = TrainingWindows::new(&dataset, training.to_vec(), SHAPE)
            .unwrap()
            .unwrap();
        for &window in others.iter().step_by(9) {
            let inputs = inputs(&dataset, window);
            let input = BaselineInput::of_window(&dataset, window, SHAPE, &inputs);
            let found = nearest(&search, &dataset, &input);
            let mut expected: Vec<Neighbour> = training
                .iter()
                .map(|&near| Neighbour {
                    window: near,
                    distance: distance(&dataset, near, window),
                })
                .collect();
            expected.sort_by(|one, other| one.distance.total_cmp(&other.distance));
            assert_eq!(found, expected[..8]);
        }
    }

    #[test]
    fn windows_that_are_far_apart_have_their_own_images() {
        let frames = noise(60);
        let (dataset, windows) = recording(&frames, &[0.0; 60]);
        let spread: Vec<Window> = windows.into_iter().step_by(5).collect();
        let search = TrainingWindows::new(&dataset, spread.clone(), SHAPE).unwrap().unwrap();
        for window in spread {
            let inputs = inputs(&dataset, window);
            let input = BaselineInput::of_window(&dataset, window, SHAPE, &inputs);
            let found = nearest(&search, &dataset, &input);
            assert_eq!((found[0].window, found[0].distance), (window, 0.0));
        }
    }

    #[test]
    fn weights_go_from_the_mean_to_the_nearest_alone() {
        let window = Window {
            episode: 0,
            first_frame: 0,
        };
        let neighbours = [100.0, 200.0].map(|distance| Neighbour { window, distance });
        assert_eq!(weights(&neighbours, 0.0), [0.5, 0.5]);
        assert_eq!(weights(&neighbours, 1.0), [2.0 / 3.0, 1.0 / 3.0]);
        assert!(weights(&neighbours, 32.0)[0] > 0.999);
    }

    fn fitted(dataset: &Dataset, windows: &[Window]) -> NearestWindows {
        let half = windows.len() / 2;
        let sets = WindowSets {
            training: &windows[..half],
            validation: &windows[half + SHAPE.frames()..],
            shape: SHAPE,
            searched: usize::MAX,
            known: None,
        };
        NearestWindows::fit(dataset, &sets).unwrap().unwrap()
    }

    #[test]
    fn near_windows_weigh_more_where_everything_repeats() {
        let frames: Vec<Vec<u8>> = noise(40).into_iter().cycle().take(160).collect();
        let (dataset, windows) = recording(&frames, &[0.0; 160]);
        // Two copies of each window are in the training half, and many that are alike only by chance.
        assert!(fitted(&dataset, &windows).summary().exponent >= 0.5);
        let (dataset, windows) = recording(&noise(160), &[0.0; 160]);
        assert_eq!(fitted(&dataset, &windows).summary().exponent, 0.0, "nothing is near");
    }

    #[test]
    fn actions_count_where_the_future_follows_from_them() {
        let mut rng = Seed(8).rng();
        let actions: Vec<f32> = (0..300).map(|_| rng.random()).collect();
        // A frame is as bright as the action before it says; its noise says nothing.
        let frame = |time: usize| -> Vec<u8> {
            let level = if time == 0 { 0.0 } else { actions[time - 1] };
            (0..SIDE * SIDE)
                .map(|_| (level * 200.0) as u8 + rng.random_range(0..50))
                .collect()
        };
        let frames: Vec<Vec<u8>> = (0..300).map(frame).collect();
        let (dataset, windows) = recording(&frames, &actions);
        let summary = fitted(&dataset, &windows).summary();
        assert!(summary.action_weight >= 0.1, "{summary:?}");
        let (dataset, windows) = recording(&frames, &[0.5; 300]);
        assert_eq!(fitted(&dataset, &windows).summary().action_weight, 0.0);
    }
}
