//! Widens the bands of windows without actions, so that they also hold for robots that the training never saw.

use super::EvaluationError;
use super::calibrate::{LEAST_ERROR, TAIL};
use super::compatible;
use super::config::EvaluateConfig;
use super::division::Division;
use super::forecast::{Forecast, forecasts_without_inputs};
use super::inference::Inference;
use super::progress::{EvaluationContext, EvaluationProgress};
use super::statistics::{quantile, rounded};
use super::windows::{evenly, window_shape};
use foreframe_core::registry::Model;
use foreframe_core::registry::calibration::{Calibration, StepErrors};
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::sampler::{Split, Splits};

/// Widens them until they hold on the validation split of a recording whose robot the training never saw. Errors: `Mismatch`,
/// `Seen`, `NothingHeldOut`, `Cancelled`, those of the network.
pub fn widen_for_unseen(
    loaded: &Model,
    unseen: &Dataset,
    config: &EvaluateConfig,
    calibration: &mut Calibration,
    on_progress: &(dyn Fn(EvaluationProgress) + Sync),
) -> Result<(), EvaluationError> {
    compatible::check(loaded, unseen)?;
    if loaded.manifest.dataset.includes(&unseen.info().content_hash) {
        return Err(EvaluationError::Seen {
            model: loaded.manifest.name.clone(),
            dataset: unseen.info().name.clone(),
        });
    }
    let seed = loaded.manifest.dataset.split_seed;
    let splits = Splits::new(unseen, seed);
    let windows = splits.windows(unseen, Split::Validation, window_shape(loaded.spec()), config.stride)?;
    if windows.is_empty() {
        return Err(EvaluationError::NothingHeldOut {
            dataset: unseen.info().name.clone(),
            split_seed: seed.0,
        });
    }
    let division = Division::default();
    let evaluation = EvaluationContext {
        inference: Inference {
            loaded,
            dataset: unseen,
        },
        split: Split::Validation,
        config,
        division: &division,
        on_progress,
    };
    let found = forecasts_without_inputs(&evaluation, &evenly(&windows, config.max_windows), calibration)?;
    for (step, errors) in calibration.steps_without_actions.iter_mut().enumerate() {
        widen(errors, &factors_of(errors, &found, step));
    }
    Ok(())
}

/// Widens them to those of another model's calibration: one that was trained in the same way, but without a robot for which
/// [`widen_for_unseen`] then widened them.
pub fn widen_like(calibration: &mut Calibration, other: &Calibration) {
    let pairs = calibration.steps_without_actions.iter_mut();
    for (errors, other) in pairs.zip(&other.steps_without_actions) {
        widen(errors, other);
    }
}

/// The factors that errors on other data need: those of the step, with its median.
fn factors_of(errors: &StepErrors, found: &[Forecast], step: usize) -> StepErrors {
    let median = StepErrors {
        mean_factor: 1.0,
        ..errors.clone()
    };
    let medians = found
        .iter()
        .map(|forecast| f64::from(median.expected(&forecast.inputs[step]).mse));
    let errors = || found.iter().map(|forecast| forecast.errors[step].max(LEAST_ERROR));
    let ratios: Vec<f64> = errors()
        .zip(medians.clone())
        .map(|(error, median)| error / median)
        .collect();
    StepErrors {
        // Of all errors together: single windows of which almost nothing was expected would rule the mean of the ratios.
        mean_factor: rounded(errors().sum::<f64>() / medians.sum::<f64>()),
        low_factor: rounded(quantile(ratios.clone(), TAIL)),
        high_factor: rounded(quantile(ratios, 1.0 - TAIL)),
        ..median.clone()
    }
}

/// Makes the band hold both, and the expected error the larger one.
fn widen(errors: &mut StepErrors, other: &StepErrors) {
    errors.mean_factor = errors.mean_factor.max(other.mean_factor);
    errors.low_factor = errors.low_factor.min(other.low_factor);
    errors.high_factor = errors.high_factor.max(other.high_factor);
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::registry::calibration::ERROR_INPUTS;

    #[test]
    fn bands_grow_to_hold_larger_errors_and_never_shrink() {
        let own = StepErrors {
            intercept: -6.0,
            weights: [&[1.0][..], &[0.0; ERROR_INPUTS - 1]].concat(),
            mean_factor: 1.1,
            low_factor: 0.5,
            high_factor: 2.0,
        };
        let median = f64::exp(-6.0);
        let forecast = |expected: f64, times: f64| Forecast {
            distance: 1.0,
            distance_from_start: None,
            inputs: vec![[expected.ln(); ERROR_INPUTS]],
            errors: vec![median * expected * times],
            expected: Vec::new(),
        };
        let usual = (0..=100).map(|index| forecast(1.0, 1.0 + f64::from(index) / 20.0));
        // Almost nothing was expected of these three, so they hardly count in the mean.
        let tiny = (0..3).map(|_| forecast(1e-3, 1000.0));
        let found: Vec<Forecast> = usual.chain(tiny).collect();
        let mut widened = own.clone();
        widen(&mut widened, &factors_of(&own, &found, 0));
        let about = |found: f32, expected: f32| (found - expected).abs() < 0.01;
        assert!(
            about(widened.mean_factor, 3.53) && about(widened.high_factor, 5.9),
            "{widened:?}"
        );
        assert_eq!(widened.low_factor, 0.5);
        let before = widened.clone();
        widen(&mut widened, &own);
        assert_eq!(widened, before);
    }
}
