//! Predictions with what is known of them before the truth is: for the calibration of their errors, and for its test.

use serde::{Deserialize, Serialize};

use super::EvaluationError;
use super::compatible::has_states_of;
use super::inference::ActionSource;
use super::progress::{EvaluationContext, EvaluationStage};
use foreframe_core::registry::Model;
use foreframe_core::registry::calibration::{
    Calibration, ContextStatistics, ERROR_INPUTS, ExpectedError, RolloutInContext,
};
use foreframe_data::dataset::Window;

/// A predicted window, what was known of it, and its true errors.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Forecast {
    /// How far frames, state and actions are from the training data.
    pub(super) distance: f64,
    /// The same with the pose counted from the trial's start, as an odometry does it; none if the model reads no pose.
    pub(super) distance_from_start: Option<f64>,
    /// What the expected error is computed from, for each step.
    pub(super) inputs: Vec<[f64; ERROR_INPUTS]>,
    /// Mean squared error of each step, intensities 0…1.
    pub(super) errors: Vec<f64>,
    /// What the model's calibration expects, if it has one.
    pub(super) expected: Vec<ExpectedError>,
}

/// Predicts the windows. Errors: those of the network, `Cancelled`.
pub(super) fn forecasts(
    evaluation: &EvaluationContext,
    windows: &[Window],
    calibration: &Calibration,
) -> Result<Vec<Forecast>, EvaluationError> {
    evaluation.in_divided_batches(evaluation.pass(EvaluationStage::Calibration), windows, |batch| {
        forecast_batch(evaluation, batch, calibration, ActionSource::Recorded)
    })
}

/// The same without states and actions, for a model that can do without. Errors: as [`forecasts`].
pub(super) fn forecasts_without_inputs(
    evaluation: &EvaluationContext,
    windows: &[Window],
    calibration: &Calibration,
) -> Result<Vec<Forecast>, EvaluationError> {
    evaluation.in_batches(EvaluationStage::Calibration, windows, |batch| {
        forecast_batch(evaluation, batch, calibration, ActionSource::NoInputs)
    })
}

/// The contexts of the windows, without predicting. Errors: as [`forecasts`].
pub(super) fn contexts(
    evaluation: &EvaluationContext,
    windows: &[Window],
) -> Result<Vec<ContextStatistics>, EvaluationError> {
    let inference = evaluation.inference;
    // The last two frames, or the only one.
    let ends = inference.spec().context.saturating_sub(2)..inference.spec().context;
    evaluation.in_batches(EvaluationStage::Calibration, windows, |batch| {
        let codes = inference.encode(&inference.frames(batch, ends.clone())?)?;
        let network = &inference.loaded.network;
        Ok(ContextStatistics::of_codes(network, &codes, ends.len())?)
    })
}

fn forecast_batch(
    evaluation: &EvaluationContext,
    windows: &[Window],
    calibration: &Calibration,
    source: ActionSource,
) -> Result<Vec<Forecast>, EvaluationError> {
    let (inference, spec) = (evaluation.inference, evaluation.inference.spec());
    let Model { manifest, network, .. } = inference.loaded;
    let (pixels, length) = (spec.pixels(), spec.code_len());
    let predicted = inference.predict(windows, source)?;
    let contexts = ContextStatistics::of_codes(network, &predicted.seen, spec.context)?;
    let actions_each = predicted.actions.len() / windows.len();
    let mut found = Vec::with_capacity(windows.len());
    for (index, (&window, context)) in windows.iter().zip(contexts).enumerate() {
        let seen = &predicted.seen[index * spec.context * length..][..spec.context * length];
        let code = |back: usize| &seen[(spec.context - back.min(spec.context)) * length..][..length];
        let values = &predicted.frames[index * spec.horizon * pixels..][..spec.horizon * pixels];
        let rollout = RolloutInContext {
            spec,
            context: &context,
            seen: [code(1), code(2)],
            codes: &predicted.codes[index * spec.horizon * length..][..spec.horizon * length],
            frames: &inference.camera_frames(values)?,
            actions: &predicted.actions[index * actions_each..][..actions_each],
        };
        let expected = |calibration: &Calibration| rollout.expected_errors(calibration);
        let has_states = has_states_of(spec, inference.dataset);
        let distance =
            |state: &[f32]| calibration.distance(spec, &context, has_states.then_some(state), rollout.actions);
        let dataset = inference.dataset;
        let start = dataset.state(dataset.episodes()[window.episode].first_frame);
        let last = dataset.state(window.first_frame + spec.context - 1);
        found.push(Forecast {
            distance: distance(last),
            distance_from_start: spec.counted_from(start, last).map(|state| distance(&state)),
            inputs: rollout.error_inputs(&calibration.novelty),
            expected: manifest.calibration.as_ref().map(expected).unwrap_or_default(),
            errors: inference.step_errors(window, values)?,
        });
    }
    Ok(found)
}
