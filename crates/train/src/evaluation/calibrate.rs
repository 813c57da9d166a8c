//! Fits a model's [`Calibration`]: what a training context looks like and which actions and states it has, from the
//! training split; how large the errors are and how they follow from what is known beforehand, from the validation split.

use std::array;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use super::config::EvaluateConfig;
use super::division::Division;
use super::forecast::{Forecast, contexts, forecasts, forecasts_without_inputs};
use super::inference::Inference;
use super::least_squares::{factor, second_moments, solve};
use super::novelty_scale::novelty_scale;
use super::progress::{EvaluationContext, EvaluationProgress};
use super::statistics::{mean_and_deviation, quantile, rounded};
use super::windows::{evenly, window_shape};
use super::{EvaluationError, compatible};
use foreframe_core::registry::calibration::{Calibration, ERROR_INPUTS, StepErrors, ValueRange, pose_features};
use foreframe_core::registry::{self, Model};
use foreframe_data::dataset::sampler::{Split, Splits};
use foreframe_data::dataset::{Dataset, Window};

/// Training windows from which the look of the contexts is learned, at most.
const TRAINING_WINDOWS: usize = 3000;
/// Share of the errors below the band, and above it.
pub(super) const TAIL: f64 = 0.05;
/// Intervals between the stored quantiles of the distance.
const QUANTILE_STEPS: usize = 40;
/// Errors below it count as it, so that their logarithm is finite.
pub(super) const LEAST_ERROR: f64 = 1e-9;
/// An input that varies less never changes.
const LEAST_SPREAD: f64 = 2e-4;
/// Added to the mean squares of the inputs, so that the equations can be solved.
const RIDGE: f64 = 1e-2;

/// Fits the calibration on the training and the validation split. `config` says with which seed the data set is split, how
/// many validation windows are used at most, and what goes through the model at once. Errors: model and data set that do not
/// fit together, no validation trials, `Cancelled`, those of the network.
pub fn calibrate(
    loaded: &Model,
    dataset: &Dataset,
    config: &EvaluateConfig,
    on_progress: &(dyn Fn(EvaluationProgress) + Sync),
) -> Result<Calibration, EvaluationError> {
    config.validate()?;
    compatible::check_inputs(loaded, dataset)?;
    let split_seed = compatible::split_seed(loaded, dataset, config.split_seed)?;
    let splits = Splits::new(dataset, split_seed);
    let shape = window_shape(loaded.spec());
    let windows_of = |split| splits.windows(dataset, split, shape, config.stride);
    let (training, validation) = (windows_of(Split::Train)?, windows_of(Split::Validation)?);
    if training.is_empty() || validation.is_empty() {
        return Err(EvaluationError::NothingHeldOut {
            dataset: dataset.info().name.clone(),
            split_seed: split_seed.0,
        });
    }
    let division = Division::default();
    let evaluation = |split| EvaluationContext {
        inference: Inference { loaded, dataset },
        split,
        config,
        division: &division,
        on_progress,
    };
    let spec = loaded.spec();
    let seen_windows = evenly(&training, TRAINING_WINDOWS);
    let seen = contexts(&evaluation(Split::Train), &seen_windows)?;
    let poses = seen_windows
        .iter()
        .filter_map(|window| pose_features(spec, dataset.state(window.first_frame + spec.context - 1)));
    let range = |used: Option<usize>, values: &dyn Fn(usize) -> Vec<f32>| match used {
        Some(channels) => ranges(&training, shape.frames(), channels, values),
        None => Vec::new(),
    };
    // Of joined data sets, some may have no actions; `steps` is for windows that have.
    let knows_actions = |window: &Window| {
        let action = dataset.action(window.first_frame + spec.context - 1);
        spec.action_inputs().is_none() || action.iter().all(|value| value.is_finite())
    };
    let known: Vec<Window> = validation.iter().copied().filter(knows_actions).collect();
    let validation = evenly(if known.is_empty() { &validation } else { &known }, config.max_windows);
    let mut calibration = Calibration {
        dataset_content_hash: dataset.info().content_hash.clone(),
        windows: validation.len(),
        steps: Vec::new(),
        steps_without_actions: Vec::new(),
        novelty: novelty_scale(&seen, &poses.collect::<Vec<_>>()),
        actions: range(spec.action_inputs(), &|frame| dataset.action(frame).to_vec()),
        states: range(spec.state_inputs(), &|frame| dataset.state(frame).to_vec()),
    };
    let found = forecasts(&evaluation(Split::Validation), &validation, &calibration)?;
    let distances: Vec<f64> = found.iter().map(|forecast| forecast.distance).collect();
    calibration.novelty.quantiles = (0..=QUANTILE_STEPS)
        .map(|step| quantile(distances.clone(), step as f64 / QUANTILE_STEPS as f64) as f32)
        .collect();
    let steps = |found: &[Forecast]| (0..spec.horizon).map(|step| step_errors(found, step)).collect();
    calibration.steps = steps(&found);
    if spec.sees_speeds() && spec.action_inputs().is_some() {
        calibration.steps_without_actions = steps(&forecasts_without_inputs(
            &evaluation(Split::Validation),
            &validation,
            &calibration,
        )?);
    }
    Ok(calibration)
}

/// Calibrates a model that was just trained on this data set and writes the calibration into its manifest, unless it has
/// one. Errors: as [`calibrate`], and those of the model's files.
pub fn calibrate_trained(model_dir: &Path, dataset: &Dataset, cancelled: &AtomicBool) -> Result<(), EvaluationError> {
    let loaded = registry::load(model_dir)?;
    if loaded.manifest.calibration.is_some() {
        return Ok(());
    }
    let config = EvaluateConfig {
        cancelled: Some(cancelled),
        ..EvaluateConfig::default()
    };
    let calibration = calibrate(&loaded, dataset, &config, &|_| {})?;
    Ok(registry::record_calibration(model_dir, calibration)?)
}

/// The smallest and largest value of each channel over all frames of the windows.
fn ranges(windows: &[Window], frames: usize, channels: usize, values: &dyn Fn(usize) -> Vec<f32>) -> Vec<ValueRange> {
    let none = ValueRange {
        min: f32::INFINITY,
        max: f32::NEG_INFINITY,
    };
    let mut ranges = vec![none; channels];
    let mut next = 0;
    for window in windows {
        // Windows overlap; each frame is read once.
        for frame in window.first_frame.max(next)..window.first_frame + frames {
            for (range, value) in ranges.iter_mut().zip(values(frame)) {
                range.min = range.min.min(value);
                range.max = range.max.max(value);
            }
            next = frame + 1;
        }
    }
    ranges
}

/// Least squares of the logarithm of the errors of a step, and the factors that its residuals give.
fn step_errors(found: &[Forecast], step: usize) -> StepErrors {
    let errors = || found.iter().map(|forecast| forecast.errors[step].max(LEAST_ERROR));
    let [mean_log, _] = mean_and_deviation(errors().map(f64::ln));
    let statistics: [[f64; 2]; ERROR_INPUTS] =
        array::from_fn(|at| mean_and_deviation(found.iter().map(|forecast| forecast.inputs[step][at])));
    let mean = statistics.map(|[mean, _]| mean);
    // An input that never changes, such as the actions' size without actions, says nothing: its weight is 0.
    let spread = statistics.map(|[_, spread]| if spread > LEAST_SPREAD { spread } else { f64::INFINITY });
    let scaled = |forecast: &Forecast| array::from_fn(|at| (forecast.inputs[step][at] - mean[at]) / spread[at]);
    let rows: Vec<[f64; ERROR_INPUTS]> = found.iter().map(scaled).collect();
    let count = found.len() as f64;
    let mut right_side = vec![0.0; ERROR_INPUTS];
    for (row, error) in rows.iter().zip(errors()) {
        for (sum, value) in right_side.iter_mut().zip(row) {
            *sum += value * (error.ln() - mean_log) / count;
        }
    }
    let factor = factor(&second_moments(&rows), ERROR_INPUTS, RIDGE)
        .expect("mean squares with a ridge that are not positive is a bug");
    let slopes = solve(&factor, right_side);
    let weights: Vec<f64> = slopes
        .iter()
        .zip(spread)
        .map(|(slope, spread)| slope / spread)
        .collect();
    let intercept = mean_log - weights.iter().zip(mean).map(|(w, m)| w * m).sum::<f64>();
    let mut fitted = StepErrors {
        intercept: rounded(intercept),
        weights: weights.into_iter().map(rounded).collect(),
        mean_factor: 1.0,
        low_factor: 1.0,
        high_factor: 1.0,
    };
    let median = |forecast: &Forecast| f64::from(fitted.expected(&forecast.inputs[step]).mse);
    let ratios: Vec<f64> = errors()
        .zip(found)
        .map(|(error, forecast)| error / median(forecast))
        .collect();
    fitted.mean_factor = rounded(ratios.iter().sum::<f64>() / count);
    fitted.low_factor = rounded(quantile(ratios.clone(), TAIL));
    fitted.high_factor = rounded(quantile(ratios, 1.0 - TAIL));
    fitted
}

#[cfg(test)]
mod tests {
    use rand::Rng as _;

    use super::*;
    use foreframe_core::types::Seed;

    /// Errors that follow two of the inputs, times noise.
    fn noisy(count: u64) -> Vec<Forecast> {
        let forecast = |index| {
            let mut rng = Seed(index).rng();
            let mut inputs = [0.5; ERROR_INPUTS];
            inputs[0] = rng.random_range(-2.0..2.0);
            inputs[3] = rng.random_range(-1.0..1.0);
            let noise: f64 = rng.random_range(-0.4..0.4);
            Forecast {
                distance: 0.5,
                distance_from_start: None,
                inputs: vec![inputs],
                errors: vec![(-6.0 + inputs[0] - 0.5 * inputs[3] + noise).exp()],
                expected: Vec::new(),
            }
        };
        (0..count).map(forecast).collect()
    }

    #[test]
    fn errors_are_predicted_from_the_inputs_that_they_follow() {
        let fitted = step_errors(&noisy(2000), 0);
        assert!((fitted.weights[0] - 1.0).abs() < 0.05 && (fitted.weights[3] + 0.5).abs() < 0.05);
        assert!(fitted.weights[1].abs() < 1e-6, "an input that never changes");
        // The noise is even in the logarithm: nine tenths of it lie between ∓0.36.
        assert!((fitted.high_factor.ln() - 0.36).abs() < 0.03, "{fitted:?}");
        assert!((fitted.low_factor.ln() + 0.36).abs() < 0.03, "{fitted:?}");
    }

    #[test]
    fn the_band_holds_for_nine_tenths_of_new_errors() {
        let fitted = step_errors(&noisy(1000), 0);
        let new = noisy(3000).split_off(1000);
        let inside = new.iter().filter(|forecast| {
            let band = fitted.expected(&forecast.inputs[0]);
            (f64::from(band.low)..f64::from(band.high)).contains(&forecast.errors[0])
        });
        let share = inside.count() as f64 / new.len() as f64;
        assert!((share - 0.9).abs() < 0.03, "{share}");
    }
}
