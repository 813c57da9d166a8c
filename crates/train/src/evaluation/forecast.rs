//! Predictions with what is known of them before the truth is: for the calibration of their errors, and for its test.

use super::EvaluationError;
use super::inference::{self, ActionSource};
use super::progress::{EvaluationContext, EvaluationStage};
use foreframe_core::frame::preprocess::scale;
use foreframe_core::frame::{Frame, quality};
use foreframe_core::registry::Model;
use foreframe_core::registry::calibration::{
    Calibration, ContextStatistics, ERROR_INPUTS, ExpectedError, NoveltyScale, RolloutInContext,
};
use foreframe_data::dataset::{Dataset, Window};

/// A predicted window, what was known of it, and its true errors.
#[derive(Clone, Debug)]
pub(super) struct Forecast {
    /// The last two frames seen.
    pub(super) context: ContextStatistics,
    /// What the expected error is computed from, for each step.
    pub(super) inputs: Vec<[f64; ERROR_INPUTS]>,
    /// Mean squared error of each step, intensities 0…1.
    pub(super) errors: Vec<f64>,
    /// What the model's calibration expects, if it has one.
    pub(super) expected: Vec<ExpectedError>,
}

/// Predicts the windows. Errors: those of the network, `Cancelled`.
pub(super) fn forecasts(
    loaded: &Model,
    dataset: &Dataset,
    windows: &[Window],
    novelty: &NoveltyScale,
    watched: &EvaluationContext,
) -> Result<Vec<Forecast>, EvaluationError> {
    let mut found = Vec::with_capacity(windows.len());
    for batch in windows.chunks(watched.batch) {
        found.extend(forecast_batch(loaded, dataset, batch, novelty)?);
        watched.report(EvaluationStage::Calibration, found.len(), windows.len())?;
    }
    Ok(found)
}

/// The contexts of the windows, without predicting. Errors: as [`forecasts`].
pub(super) fn contexts(
    loaded: &Model,
    dataset: &Dataset,
    windows: &[Window],
    watched: &EvaluationContext,
) -> Result<Vec<ContextStatistics>, EvaluationError> {
    let spec = loaded.spec();
    let mut found = Vec::with_capacity(windows.len());
    for batch in windows.chunks(watched.batch) {
        let ends: Vec<usize> = batch
            .iter()
            .flat_map(|window| ends(window.first_frame, spec.context))
            .collect();
        let frames = inference::resized_frames(dataset, spec, &ends)?;
        let codes = inference::encode(loaded, &frames)?;
        found.extend(ContextStatistics::of_codes(&loaded.network, &codes, 2)?);
        watched.report(EvaluationStage::Calibration, found.len(), windows.len())?;
    }
    Ok(found)
}

/// The last two frames of a context; the same one twice if it has only one.
fn ends(first: usize, context: usize) -> [usize; 2] {
    [first + context.saturating_sub(2), first + context - 1]
}

fn forecast_batch(
    loaded: &Model,
    dataset: &Dataset,
    windows: &[Window],
    novelty: &NoveltyScale,
) -> Result<Vec<Forecast>, EvaluationError> {
    let spec = loaded.spec();
    let (pixels, length) = (spec.pixels(), spec.code_len());
    let predicted = inference::predict_with_codes(loaded, dataset, windows, ActionSource::Recorded)?;
    let contexts = ContextStatistics::of_codes(&loaded.network, &predicted.seen, spec.context)?;
    let actions_each = predicted.actions.len() / windows.len().max(1);
    let mut found = Vec::with_capacity(windows.len());
    for (index, (window, context)) in windows.iter().zip(contexts).enumerate() {
        let seen = &predicted.seen[index * spec.context * length..][..spec.context * length];
        let code = |back: usize| &seen[(spec.context - back.min(spec.context)) * length..][..length];
        let values = &predicted.frames[index * spec.horizon * pixels..][..spec.horizon * pixels];
        let frames = values.chunks_exact(pixels).map(|frame| {
            spec.preprocess
                .frame_from(frame, spec.frame_width_px, spec.frame_height_px)
        });
        let frames = frames.collect::<Result<Vec<Frame>, _>>()?;
        let rollout = RolloutInContext {
            spec,
            context: &context,
            seen: [code(1), code(2)],
            codes: &predicted.codes[index * spec.horizon * length..][..spec.horizon * length],
            frames: &frames,
            actions: &predicted.actions[index * actions_each..][..actions_each],
        };
        let mut errors = Vec::with_capacity(spec.horizon);
        for (step, frame) in values.chunks_exact(pixels).enumerate() {
            let truth = scale(&dataset.pixels(window.first_frame + spec.context + step)?);
            errors.push(quality::mse(&spec.preprocess.inverse(frame), &truth));
        }
        let expected = |calibration: &Calibration| rollout.expected_errors(calibration);
        found.push(Forecast {
            inputs: rollout.error_inputs(novelty),
            expected: loaded.manifest.calibration.as_ref().map(expected).unwrap_or_default(),
            errors,
            context,
        });
    }
    Ok(found)
}
