//! Whether a model's expected errors and its novelty keep what they promise, on windows that neither training nor
//! calibration saw.

use serde::{Deserialize, Serialize};

use super::EvaluationError;
use super::compatible::has_states_of;
use super::forecast::{Forecast, contexts};
use super::metrics::StepCurve;
use super::progress::EvaluationContext;
use super::statistics::quantile;
use super::windows::evenly;
use foreframe_core::registry::calibration::{Calibration, ContextStatistics};
use foreframe_data::dataset::Window;

/// How well the expected errors of a set's windows fit the true ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct UncertaintyScores {
    /// Share of the windows whose error lies in its 90 % band.
    pub coverage: StepCurve,
    /// Mean width of the bands, as an MSE.
    pub width: StepCurve,
    /// Width of the one band that holds for 90 % of this set's windows: what a constant would need.
    pub constant_width: StepCurve,
    /// Correlation of the logarithms of the expected and the true error; a constant has 0.
    pub correlation: StepCurve,
    /// Mean novelty of the windows; 0.5 where they are like the validation split.
    pub novelty: f64,
    /// For models that read a pose in a room: how often a window has a greater novelty when poses are counted from its trial's
    /// start, as an odometry does it (area under the ROC curve).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wrong_origin_auroc: Option<f64>,
}

/// How well novelty tells another data set from the windows of the evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NoveltyScores {
    /// The other data set's title.
    pub dataset: String,
    /// Its windows.
    pub windows: usize,
    /// Mean novelty of its windows.
    pub novelty: f64,
    /// Area under the ROC curve: how often a window of the other data set has a greater novelty than one of the evaluation
    /// (ties count half).
    pub auroc: f64,
}

/// Scores the calibration on these forecasts; also gives their novelty.
pub(super) fn scores(calibration: &Calibration, found: &[Forecast]) -> (UncertaintyScores, Vec<f64>) {
    let novelty_of = |distance| f64::from(calibration.novelty.novelty(distance));
    let novelty: Vec<f64> = found.iter().map(|forecast| novelty_of(forecast.distance)).collect();
    let from_start = found.iter().filter_map(|forecast| forecast.distance_from_start);
    let from_start: Vec<f64> = from_start.map(novelty_of).collect();
    let steps = calibration.steps.len();
    let curve = |of: &dyn Fn(usize) -> f64| StepCurve::new((0..steps).map(of).collect());
    let scores = UncertaintyScores {
        coverage: StepCurve::mean_over(found, steps, |forecast, step| f64::from(is_inside(forecast, step))),
        width: StepCurve::mean_over(found, steps, |forecast, step| {
            f64::from(forecast.expected[step].high - forecast.expected[step].low)
        }),
        constant_width: curve(&|step| {
            let errors: Vec<f64> = found.iter().map(|forecast| forecast.errors[step]).collect();
            quantile(errors.clone(), 0.95) - quantile(errors, 0.05)
        }),
        correlation: curve(&|step| correlation(found, step)),
        novelty: mean(&novelty),
        wrong_origin_auroc: (!from_start.is_empty()).then(|| auroc(&novelty, &from_start)),
    };
    (scores, novelty)
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn is_inside(forecast: &Forecast, step: usize) -> bool {
    let expected = forecast.expected[step];
    (f64::from(expected.low)..=f64::from(expected.high)).contains(&forecast.errors[step])
}

/// The correlation of the logarithms of the expected and the true errors of a step.
fn correlation(found: &[Forecast], step: usize) -> f64 {
    let pair = |forecast: &Forecast| {
        let expected = f64::from(forecast.expected[step].mse);
        (expected.ln(), forecast.errors[step].max(1e-9).ln())
    };
    let pairs: Vec<(f64, f64)> = found.iter().map(pair).collect();
    let count = pairs.len() as f64;
    let (x_mean, y_mean) = pairs
        .iter()
        .fold((0.0, 0.0), |(x, y), pair| (x + pair.0 / count, y + pair.1 / count));
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for (x, y) in pairs {
        xx += (x - x_mean).powi(2);
        xy += (x - x_mean) * (y - y_mean);
        yy += (y - y_mean).powi(2);
    }
    xy / (xx * yy).sqrt().max(f64::MIN_POSITIVE)
}

/// Compares the novelty of the contexts of this data set, which is another one, with that of `own`. Frames of another size
/// are cropped and resized. Errors: those of the network, `NoContext` if no recording is long enough.
pub(super) fn compare(
    evaluation: &EvaluationContext,
    calibration: &Calibration,
    own: &[f64],
) -> Result<NoveltyScores, EvaluationError> {
    let (dataset, context) = (evaluation.inference.dataset, evaluation.inference.spec().context);
    let mut windows = Vec::new();
    for episode in dataset.episodes() {
        let last = (episode.first_frame + episode.frame_count + 1).saturating_sub(context);
        windows.extend((episode.first_frame..last).map(|first_frame| Window {
            episode: episode.index,
            first_frame,
        }));
    }
    if windows.is_empty() {
        return Err(EvaluationError::NoContext {
            dataset: dataset.info().name.clone(),
            context,
        });
    }
    let windows = evenly(&windows, evaluation.config.max_windows);
    let spec = evaluation.inference.spec();
    let has_states = has_states_of(spec, dataset);
    let of_window = |(window, statistics): (&Window, ContextStatistics)| {
        let state = has_states.then(|| dataset.state(window.first_frame + context - 1));
        let distance = calibration.distance(spec, &statistics, state, &[]);
        f64::from(calibration.novelty.novelty(distance))
    };
    let found = contexts(evaluation, &windows)?;
    let novelty: Vec<f64> = windows.iter().zip(found).map(of_window).collect();
    Ok(NoveltyScores {
        dataset: dataset.info().name.clone(),
        windows: windows.len(),
        novelty: mean(&novelty),
        auroc: auroc(own, &novelty),
    })
}

/// How often one of `novel` is greater than one of `known`; ties count half.
fn auroc(known: &[f64], novel: &[f64]) -> f64 {
    let mut sorted = known.to_vec();
    sorted.sort_by(f64::total_cmp);
    let below: usize = novel
        .iter()
        .map(|value| sorted.partition_point(|known| known < value) + sorted.partition_point(|known| known <= value))
        .sum();
    below as f64 / (2 * known.len().max(1) * novel.len().max(1)) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_area_is_one_when_all_are_told_apart_and_half_when_none() {
        assert_eq!(auroc(&[0.1, 0.2], &[0.3, 0.9]), 1.0);
        assert_eq!(auroc(&[0.1, 0.2], &[0.1, 0.2]), 0.5);
        assert_eq!(auroc(&[1.0], &[1.0]), 0.5);
        assert_eq!(auroc(&[0.5], &[0.1]), 0.0);
    }
}
