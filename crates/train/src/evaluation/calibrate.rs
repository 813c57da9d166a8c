//! Fits a model's [`Calibration`]: what a training context looks like and which actions and states it has, from the
//! training split; how large the errors are and how they follow from what is known beforehand, from the validation split.

use std::array;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use super::config::EvaluateConfig;
use super::forecast::{Forecast, contexts, forecasts};
use super::inference::Inference;
use super::least_squares::{factor, forward, mean_and_deviation, second_moments, solve};
use super::progress::{EvaluationContext, EvaluationProgress};
use super::windows::{evenly, window_shape};
use super::{EvaluationError, compatible};
use foreframe_core::registry::calibration::{
    APPEARANCE, Calibration, ContextStatistics, ERROR_INPUTS, NoveltyScale, StepErrors, ValueRange,
};
use foreframe_core::registry::{self, Model};
use foreframe_data::dataset::sampler::{Split, Splits};
use foreframe_data::dataset::{Dataset, Window};

/// Training windows from which the look of the contexts is learned, at most.
const TRAINING_WINDOWS: usize = 3000;
/// Share of the errors below the band, and above it.
const TAIL: f64 = 0.05;
/// The quantile to which distances are scaled.
const SCALED_TO: f64 = 0.95;
/// Intervals between the stored quantiles of the distance.
const QUANTILE_STEPS: usize = 40;
/// Errors below it count as it, so that their logarithm is finite.
const LEAST_ERROR: f64 = 1e-9;
/// Added to standard deviations of the statistics: nothing varies less in a real camera.
const LEAST_SPREAD: f64 = 2e-4;
/// Added to correlations, and to the mean squares of the inputs, so that the equations can be solved.
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
    compatible::check(loaded, dataset)?;
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
    let evaluation = |split| EvaluationContext {
        inference: Inference { loaded, dataset },
        split,
        config,
        on_progress,
    };
    let seen = contexts(&evaluation(Split::Train), &evenly(&training, TRAINING_WINDOWS))?;
    let mut novelty = novelty_scale(&seen);
    let validation = evenly(&validation, config.max_windows);
    let found = forecasts(&evaluation(Split::Validation), &validation, &novelty)?;
    let distances = found.iter().map(|forecast| novelty.distance(&forecast.context));
    let distances: Vec<f64> = distances.collect();
    novelty.quantiles = (0..=QUANTILE_STEPS)
        .map(|step| quantile(distances.clone(), step as f64 / QUANTILE_STEPS as f64) as f32)
        .collect();
    let spec = loaded.spec();
    let range = |used: Option<usize>, values: &dyn Fn(usize) -> Vec<f32>| match used {
        Some(channels) => ranges(&training, shape.frames(), channels, values),
        None => Vec::new(),
    };
    Ok(Calibration {
        dataset_content_hash: dataset.info().content_hash.clone(),
        windows: found.len(),
        steps: (0..spec.horizon).map(|step| step_errors(&found, step)).collect(),
        actions: range(spec.action_inputs(), &|frame| dataset.action(frame).to_vec()),
        states: range(spec.state_inputs(), &|frame| dataset.state(frame).to_vec()),
        novelty,
    })
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

/// What the contexts of the training look like. The quantiles are filled in later.
fn novelty_scale(seen: &[ContextStatistics]) -> NoveltyScale {
    let statistics: [[f64; 2]; APPEARANCE] =
        array::from_fn(|at| mean_and_deviation(seen.iter().map(|context| context.appearance[at])));
    let mean = statistics.map(|[mean, _]| mean);
    let spread = statistics.map(|[_, deviation]| deviation + LEAST_SPREAD);
    let scaled = |context: &ContextStatistics| array::from_fn(|at| (context.appearance[at] - mean[at]) / spread[at]);
    let rows: Vec<[f64; APPEARANCE]> = seen.iter().map(scaled).collect();
    let factor = factor(&second_moments(&rows), APPEARANCE, RIDGE)
        .expect("correlations with a ridge that are not positive is a bug");
    // Column by column: the inverse of the factor, over the spread.
    let column = |at: usize| forward(&factor, (0..APPEARANCE).map(|row| f64::from(row == at)).collect());
    let columns: [Vec<f64>; APPEARANCE] = array::from_fn(column);
    let row = |row: usize| (0..=row).map(|at| rounded(columns[at][row] / spread[at])).collect();
    let still: Vec<f64> = seen.iter().map(|context| context.still).collect();
    let still_median = quantile(still.clone(), 0.5);
    let from_median = still.iter().map(|still| (still - still_median).abs()).collect();
    let mut scale = NoveltyScale {
        mean: mean.map(rounded).to_vec(),
        whitening: (0..APPEARANCE).map(row).collect(),
        appearance_scale: 1.0,
        still_median: rounded(still_median),
        still_scale: rounded(quantile(from_median, SCALED_TO).max(LEAST_SPREAD)),
        quantiles: Vec::new(),
    };
    let lengths = seen.iter().map(|context| scale.appearance_distance(context)).collect();
    scale.appearance_scale = rounded(quantile(lengths, SCALED_TO).max(LEAST_SPREAD));
    scale
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

/// The value below which this share of the values lies; between two values in proportion. There is at least one value.
pub(super) fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let place = share * (values.len() - 1) as f64;
    let (below, above) = (place.floor() as usize, place.ceil() as usize);
    values[below] + (values[above] - values[below]) * place.fract()
}

/// Five digits, so that the manifest stays readable.
fn rounded(value: f64) -> f32 {
    format!("{value:.4e}")
        .parse()
        .expect("a formatted number that cannot be read is a bug")
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
                context: ContextStatistics::of(&[0.5; 64], &[0.5; 64], 8),
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

    #[test]
    fn contexts_unlike_those_of_the_training_are_far_away() {
        let textured = |seed: u64, size: f32| {
            let mut rng = Seed(seed).rng();
            let phase: f32 = rng.random_range(0.0..6.0);
            let image: Vec<f32> = (0..256)
                .map(|at| 0.5 + size * (at as f32 * 0.3 + phase).sin())
                .collect();
            let moved: Vec<f32> = image
                .iter()
                .map(|value| value + rng.random_range(-0.05..0.05))
                .collect();
            ContextStatistics::of(&image, &moved, 16)
        };
        let seen: Vec<ContextStatistics> = (0..300).map(|seed| textured(seed, 0.2)).collect();
        let scale = novelty_scale(&seen);
        let far = seen.iter().filter(|context| scale.distance(context) > 1.0).count();
        assert!((15..=30).contains(&far), "{far}");
        assert!(scale.distance(&textured(1000, 0.4)) > 2.0);
    }
}
