//! Scores of a test set's windows: the model, the baselines and the codec on the same frames.

use std::ops::Range;
use std::slice::ChunksExact;

use rayon::prelude::*;

use super::EvaluationError;
use super::baselines::{BaselineInput, Baselines};
use super::bootstrap::resampled_with;
use super::inference::{ActionSource, Inference};
use super::method::Method;
use super::metrics::{FrameScore, TargetFrame, WindowScores};
use super::progress::{EvaluationContext, EvaluationStage};
use super::windows::{true_frame, window_shape};
use foreframe_core::frame::quality;
use foreframe_data::dataset::{DatasetError, Window};

/// What the model makes of a batch of windows: frames `[window][step]` in its own space, not clamped.
struct ModelFrames {
    /// The predicted frames.
    predicted: Vec<f32>,
    /// The true frames to come.
    truth: Vec<f32>,
    /// The true frames to come through the frame encoder and decoder.
    codec: Vec<f32>,
    /// The frames seen as the model reconstructs them; empty if it does not.
    reconstructed: Vec<f32>,
}

/// Scores every window. Errors: those of the network, `NotFinite`, `Cancelled`.
pub(super) fn score(
    evaluation: &EvaluationContext,
    windows: &[Window],
    baselines: &Baselines,
) -> Result<Vec<WindowScores>, EvaluationError> {
    let inference = evaluation.inference;
    let future = inference.spec().context..window_shape(inference.spec()).frames();
    evaluation.in_divided_batches(evaluation.pass(EvaluationStage::Scores), windows, |batch| {
        let predicted = inference.predict(batch, ActionSource::Recorded)?;
        let truth = inference.frames(batch, future.clone())?;
        let made = ModelFrames {
            predicted: predicted.frames,
            codec: inference.through_codec(&truth)?,
            truth,
            reconstructed: inference.reconstruct(&predicted.seen)?,
        };
        let numbered = batch.par_iter().copied().enumerate();
        let scored = numbered.map(|window| score_window(inference, window, &made, baselines));
        scored.collect()
    })
}

fn score_window(
    inference: Inference,
    (place, window): (usize, Window),
    made: &ModelFrames,
    baselines: &Baselines,
) -> Result<WindowScores, EvaluationError> {
    let (dataset, spec) = (inference.dataset, inference.spec());
    let (pixels, shape) = (spec.pixels(), window_shape(spec));
    let (past, future) = (0..shape.context, shape.context..shape.frames());
    let frames_at = |steps: Range<usize>| -> Result<Vec<Vec<f32>>, DatasetError> {
        let frames = steps.map(|step| true_frame(dataset, window.first_frame + step));
        frames.collect()
    };
    let (inputs, truth) = (frames_at(past)?, frames_at(future.clone())?);
    let masks = future.map(|step| dataset.mask(window.first_frame + step));
    let masks = masks.collect::<Result<Vec<_>, DatasetError>>()?;
    let camera_space = |values: &[f32], steps: usize| -> Vec<Vec<f32>> {
        let frames = frames_of(values, place, steps * pixels, pixels);
        frames.map(|frame| spec.preprocess.inverse(frame)).collect()
    };
    let seen = BaselineInput::of_window(dataset, window, shape, &inputs);
    let score = |&method: &Method| -> Result<Vec<FrameScore>, EvaluationError> {
        let predictions = match method {
            Method::Model => camera_space(&made.predicted, shape.horizon),
            Method::CodecOnly => camera_space(&made.codec, shape.horizon),
            baseline => baselines.predict(dataset, baseline, &seen, shape.horizon)?,
        };
        let compared = predictions.iter().zip(&truth).zip(&masks);
        let scores = compared.map(|((prediction, pixels), mask)| {
            let target = TargetFrame {
                pixels,
                mask: mask.as_deref(),
                width: spec.frame_width_px as usize,
                for_benchmark: baselines.are_of_benchmark(),
            };
            FrameScore::of(prediction, &target)
        });
        Ok(scores.collect())
    };
    let own = frames_of(&made.predicted, place, shape.horizon * pixels, pixels);
    let own_truth = frames_of(&made.truth, place, shape.horizon * pixels, pixels);
    let reconstructed = camera_space(&made.reconstructed, shape.context);
    Ok(WindowScores {
        episode: window.episode,
        first_frame: window.first_frame,
        group: resampled_with(dataset, window, shape.frames()),
        frames: baselines.methods().iter().map(score).collect::<Result<_, _>>()?,
        model_space_mse: own.zip(own_truth).map(|(a, b)| quality::mse(a, b)).collect(),
        reconstruction_mse: reconstructed
            .iter()
            .zip(&inputs)
            .map(|(a, b)| quality::mse(a, b))
            .collect(),
    })
}

/// The frames of the window at that place in a batch; none where there are no values.
fn frames_of(values: &[f32], place: usize, window_values: usize, pixels: usize) -> ChunksExact<'_, f32> {
    let window = values.chunks_exact(window_values).nth(place);
    window.unwrap_or_default().chunks_exact(pixels)
}
