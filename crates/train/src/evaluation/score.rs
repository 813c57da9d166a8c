//! Scores of a test set's windows: the model, the baselines and the codec on the same frames.

use rayon::prelude::*;

use super::EvaluationError;
use super::baselines::{BaselineInput, Baselines};
use super::bootstrap::resampled_with;
use super::inference::{Predicted, predict_with_ceiling};
use super::method::Method;
use super::metrics::{FrameScore, TargetFrame, WindowScores};
use super::progress::{EvaluationContext, EvaluationStage};
use foreframe_core::frame::preprocess::scale;
use foreframe_core::frame::quality;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::Model;
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, DatasetError, Window};

/// Scores every window. Errors: those of the network, `NotFinite`.
pub fn score(
    loaded: &Model,
    dataset: &Dataset,
    windows: &[Window],
    baselines: &Baselines,
    watched: &EvaluationContext,
) -> Result<Vec<WindowScores>, EvaluationError> {
    let spec = loaded.spec();
    let mut scores = Vec::with_capacity(windows.len());
    for batch in windows.chunks(watched.batch) {
        let predicted = predict_with_ceiling(loaded, dataset, batch)?;
        let scored: Result<Vec<WindowScores>, EvaluationError> = batch
            .par_iter()
            .enumerate()
            .map(|(place, &window)| score_window(spec, dataset, (place, window), &predicted, baselines))
            .collect();
        scores.extend(scored?);
        watched.report(EvaluationStage::Scores, scores.len(), windows.len())?;
    }
    Ok(scores)
}

fn score_window(
    spec: &ModelSpec,
    dataset: &Dataset,
    (place, window): (usize, Window),
    predicted: &Predicted,
    baselines: &Baselines,
) -> Result<WindowScores, EvaluationError> {
    let (pixels, horizon) = (spec.pixels(), spec.horizon);
    let width = spec.frame_width_px as usize;
    let here = place * horizon * pixels..(place + 1) * horizon * pixels;
    let camera_space = |values: &[f32]| -> Vec<Vec<f32>> {
        let frames = values[here.clone()].chunks_exact(pixels);
        frames.map(|frame| spec.preprocess.inverse(frame)).collect()
    };
    let frame = |step: usize| Ok(scale(&dataset.pixels(window.first_frame + step)?));
    let inputs = (0..spec.context).map(frame).collect::<Result<Vec<_>, DatasetError>>()?;
    let future = spec.context..spec.context + horizon;
    let truth = future.clone().map(frame).collect::<Result<Vec<_>, DatasetError>>()?;
    let mask = |step: usize| dataset.mask(window.first_frame + step);
    let masks = future.map(mask).collect::<Result<Vec<_>, DatasetError>>()?;
    let shape = WindowShape {
        context: spec.context,
        horizon,
    };
    let seen = BaselineInput::of_window(dataset, window, shape, &inputs);
    let frames = baselines
        .methods()
        .iter()
        .map(|&method| {
            let predictions = match method {
                Method::Model => camera_space(&predicted.frames),
                Method::CodecOnly => camera_space(&predicted.codec),
                baseline => baselines.predict(dataset, baseline, &seen, horizon)?,
            };
            let compared = predictions.iter().zip(&truth).zip(&masks);
            let score = compared.map(|((prediction, pixels), mask)| {
                let target = TargetFrame {
                    pixels,
                    mask: mask.as_deref(),
                    width,
                    for_benchmark: baselines.are_of_benchmark(),
                };
                FrameScore::of(prediction, &target)
            });
            Ok(score.collect())
        })
        .collect::<Result<Vec<Vec<FrameScore>>, EvaluationError>>()?;
    let seen_here = place * spec.context * pixels..(place + 1) * spec.context * pixels;
    let reconstructed = predicted
        .reconstructed
        .get(seen_here)
        .unwrap_or_default()
        .chunks_exact(pixels);
    let own = predicted.frames[here.clone()].chunks_exact(pixels);
    let own_truth = predicted.truth[here.clone()].chunks_exact(pixels);
    Ok(WindowScores {
        episode: window.episode,
        first_frame: window.first_frame,
        group: resampled_with(dataset, window, spec.context + spec.horizon),
        frames,
        model_space_mse: own.zip(own_truth).map(|(a, b)| quality::mse(a, b)).collect(),
        reconstruction_mse: reconstructed
            .zip(&inputs)
            .map(|(frame, truth)| quality::mse(&spec.preprocess.inverse(frame), truth))
            .collect(),
    })
}
