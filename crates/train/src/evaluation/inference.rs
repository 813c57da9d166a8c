//! Windows through a model, batch by batch.

use candle_core::{Device, Tensor};
use rayon::prelude::*;

use super::EvaluationError;
use foreframe_core::frame::preprocess::Preprocess;
use foreframe_core::frame::resize::{Resize, resize};
use foreframe_core::nn::{ConditioningTensors, Feedback, ModelSpec};
use foreframe_core::registry::Model;
use foreframe_data::dataset::{Dataset, Window};

/// Which future actions the model gets.
#[derive(Clone, Copy, Debug)]
pub enum ActionSource<'a> {
    /// Those that were carried out.
    Recorded,
    /// For each window, in the order of the batch, those carried out in another one.
    OfWindows(&'a [Window]),
    /// At every step the action that led to the last frame seen.
    Held,
    /// Zero in every component, in the channels' own units.
    Zero,
}

/// What a model computed from a batch of windows. All frames are `[window][step]`, P values each, one after another, in the
/// model's space and not clamped.
#[derive(Clone, Debug)]
pub struct Predicted {
    /// The predicted frames.
    pub frames: Vec<f32>,
    /// The true frames to come.
    pub truth: Vec<f32>,
    /// The true frames to come through the frame encoder and decoder.
    pub codec: Vec<f32>,
    /// The frames seen as the model reconstructs them; empty if it does not.
    pub reconstructed: Vec<f32>,
}

/// Predicts each window's frames to come. Errors: those of the network, `NotFinite`.
pub fn predict(
    loaded: &Model,
    dataset: &Dataset,
    windows: &[Window],
    source: ActionSource,
) -> Result<Vec<f32>, EvaluationError> {
    let spec = loaded.spec();
    let inputs = model_space(dataset, spec.preprocess, windows, 0..spec.context)?;
    let frames = Tensor::from_vec(inputs, (windows.len(), spec.context, spec.pixels()), &Device::Cpu)?;
    let condition = condition(spec, dataset, windows, source)?;
    let predicted = values(&loaded.network.predict_frames(&frames, &condition)?)?;
    let window_values = spec.horizon * spec.pixels();
    match predicted.iter().position(|value| !value.is_finite()) {
        Some(place) => Err(EvaluationError::NotFinite {
            model: loaded.manifest.name.clone(),
            frame: windows
                .get(place / window_values)
                .map_or(0, |window| window.first_frame),
        }),
        None => Ok(predicted),
    }
}

/// As [`predict`] with the true actions, the true frames to come through the frame encoder and decoder, and the
/// reconstruction of those seen.
pub fn predict_with_ceiling(
    loaded: &Model,
    dataset: &Dataset,
    windows: &[Window],
) -> Result<Predicted, EvaluationError> {
    let spec = loaded.spec();
    let frames = predict(loaded, dataset, windows, ActionSource::Recorded)?;
    let truth = model_space(
        dataset,
        spec.preprocess,
        windows,
        spec.context..spec.context + spec.horizon,
    )?;
    let targets = Tensor::from_slice(&truth, (windows.len() * spec.horizon, spec.pixels()), &Device::Cpu)?;
    let codec = values(&loaded.network.decode_frames(&loaded.network.encode_frames(&targets)?)?)?;
    Ok(Predicted {
        frames,
        truth,
        codec,
        reconstructed: reconstruct(loaded, dataset, windows)?,
    })
}

/// The windows' inputs as the model reconstructs them: `[window][step]`, P values each, in the model's space. Empty if it
/// does not reconstruct.
pub fn reconstruct(loaded: &Model, dataset: &Dataset, windows: &[Window]) -> Result<Vec<f32>, EvaluationError> {
    let (model, spec) = (&loaded.network, loaded.spec());
    let (batch, context) = (windows.len(), spec.context);
    let inputs = model_space(dataset, spec.preprocess, windows, 0..context)?;
    let frames = Tensor::from_vec(inputs, (batch * context, spec.pixels()), &Device::Cpu)?;
    let features = model
        .encode_frames(&frames)?
        .reshape((batch, context, spec.code_len()))?;
    let Some(features) = model.reconstruct(&features)? else {
        return Ok(Vec::new());
    };
    values(&model.decode_frames(&features.reshape((batch * context, spec.code_len()))?)?)
}

/// A batch of windows with the codes behind the frames, one window after another.
pub(super) struct PredictedCodes {
    /// Codes of the frames seen.
    pub(super) seen: Vec<f32>,
    /// Codes of the predicted frames.
    pub(super) codes: Vec<f32>,
    /// The predicted frames in the model's space, not clamped.
    pub(super) frames: Vec<f32>,
    /// The actions in their own units; empty if the model takes none.
    pub(super) actions: Vec<f32>,
}

/// As [`predict`], with the codes. Errors: those of the network.
pub(super) fn predict_with_codes(
    loaded: &Model,
    dataset: &Dataset,
    windows: &[Window],
    source: ActionSource,
) -> Result<PredictedCodes, EvaluationError> {
    let (model, spec) = (&loaded.network, loaded.spec());
    let (batch, code) = (windows.len(), spec.code_len());
    let inputs = model_space(dataset, spec.preprocess, windows, 0..spec.context)?;
    let seen = encode(loaded, &inputs)?;
    let condition = condition(spec, dataset, windows, source)?;
    let contexts = Tensor::from_slice(&seen, (batch, spec.context, code), &Device::Cpu)?;
    let codes = model.predict(&contexts, &condition, Feedback::Prediction)?;
    let frames = model.decode_frames(&codes.reshape((batch * spec.horizon, code))?)?;
    Ok(PredictedCodes {
        seen,
        codes: values(&codes)?,
        frames: values(&frames)?,
        actions: condition.actions.as_ref().map(values).transpose()?.unwrap_or_default(),
    })
}

/// Codes of frames in the model's space, both one after another. Errors: those of the network.
pub(super) fn encode(loaded: &Model, frames: &[f32]) -> Result<Vec<f32>, EvaluationError> {
    let pixels = loaded.spec().pixels();
    let frames = Tensor::from_slice(frames, (frames.len() / pixels, pixels), &Device::Cpu)?;
    values(&loaded.network.encode_frames(&frames)?)
}

/// Frames of a data set of any size in the model's space, one after another. Another size is cropped and resized.
pub(super) fn resized_frames(
    dataset: &Dataset,
    spec: &ModelSpec,
    frames: &[usize],
) -> Result<Vec<f32>, EvaluationError> {
    let mut all = Vec::with_capacity(frames.len() * spec.pixels());
    for &frame in frames {
        let frame = resize(
            &dataset.frame(frame)?,
            spec.frame_width_px,
            spec.frame_height_px,
            Resize::Crop,
        )?;
        all.extend(spec.preprocess.forward(&frame));
    }
    Ok(all)
}

fn values(tensor: &Tensor) -> Result<Vec<f32>, EvaluationError> {
    Ok(tensor.flatten_all()?.to_vec1::<f32>()?)
}

/// Those steps of each window in the model's space.
fn model_space(
    dataset: &Dataset,
    preprocess: Preprocess,
    windows: &[Window],
    steps: std::ops::Range<usize>,
) -> Result<Vec<f32>, EvaluationError> {
    let frames: Vec<usize> = windows
        .iter()
        .flat_map(|window| steps.clone().map(|step| window.first_frame + step))
        .collect();
    let size = dataset.info().frame_pixels();
    let mut all = vec![0.0; frames.len() * size];
    all.par_chunks_mut(size)
        .zip(frames)
        .try_for_each(|(out, frame)| -> Result<(), EvaluationError> {
            out.copy_from_slice(&preprocess.forward(&dataset.frame(frame)?));
            Ok(())
        })?;
    Ok(all)
}

/// Action k of a window is the one recorded at the frame before its k-th predicted frame.
fn condition(
    spec: &ModelSpec,
    dataset: &Dataset,
    windows: &[Window],
    source: ActionSource,
) -> Result<ConditioningTensors, EvaluationError> {
    let batch = windows.len();
    let mut condition = ConditioningTensors::none();
    if let Some(count) = spec.action_inputs() {
        let recorded = |windows: &[Window]| -> Vec<f32> {
            let frames = windows.iter().flat_map(|window| {
                let last = window.first_frame + spec.context - 1;
                last..last + spec.horizon
            });
            frames.flat_map(|frame| dataset.action(frame).iter().copied()).collect()
        };
        let actions = match source {
            ActionSource::Recorded => recorded(windows),
            ActionSource::OfWindows(others) => recorded(others),
            ActionSource::Held => windows
                .iter()
                .flat_map(|window| {
                    let before = window.first_frame + spec.context.saturating_sub(2);
                    dataset.action(before).repeat(spec.horizon)
                })
                .collect(),
            ActionSource::Zero => vec![0.0; batch * spec.horizon * count],
        };
        condition.actions = Some(Tensor::from_vec(actions, (batch, spec.horizon, count), &Device::Cpu)?);
    }
    if let Some(count) = spec.state_inputs() {
        let states: Vec<f32> = windows
            .iter()
            .flat_map(|window| dataset.state(window.first_frame + spec.context - 1).iter().copied())
            .collect();
        condition.state = Some(Tensor::from_vec(states, (batch, count), &Device::Cpu)?);
    }
    Ok(condition)
}
