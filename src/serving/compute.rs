//! The computation: frames to tensors, through the model, and back. Blocks; runs on the thread that owns the models.

use std::sync::Arc;

use candle_core::{Device, Tensor};

use super::{PredictionInput, ServingError};
use crate::frame::Frame;
use crate::nn::{Condition, ModelSpec};
use crate::registry::LoadedModel;

/// The predicted frames of each input, in order, computed as one batch. Errors: `Input` if one does not fit the model,
/// `Model`, `Tensor`, `Frame`.
pub fn predict(loaded: &LoadedModel, inputs: &[&PredictionInput]) -> Result<Vec<Vec<Frame>>, ServingError> {
    let (name, spec) = (loaded.manifest.name.as_str(), loaded.model.spec());
    for input in inputs {
        input.check(name, spec)?;
    }
    let frames = frames_tensor(spec, inputs).map_err(tensor_error)?;
    let condition = condition(name, spec, inputs)?;
    let predicted = loaded
        .model
        .predict_frames(&frames, &condition)
        .map_err(|source| ServingError::Model {
            model: name.to_owned(),
            source: Arc::new(source),
        })?;
    let values = predicted.to_vec3::<f32>().map_err(tensor_error)?;
    let frame = |pixels: &Vec<f32>| {
        spec.preprocess
            .frame_from(pixels, spec.frame_width_px, spec.frame_height_px)
            .map_err(|source| ServingError::Frame {
                model: name.to_owned(),
                source,
            })
    };
    values
        .iter()
        .map(|horizon| horizon.iter().map(frame).collect())
        .collect()
}

/// `[B, T, P]` in the model's space.
fn frames_tensor(spec: &ModelSpec, inputs: &[&PredictionInput]) -> candle_core::Result<Tensor> {
    let pixels = spec.frame_width_px as usize * spec.frame_height_px as usize;
    let mut values = Vec::with_capacity(inputs.len() * spec.context * pixels);
    for frame in inputs.iter().flat_map(|input| &input.frames) {
        values.extend(spec.preprocess.forward(frame));
    }
    Tensor::from_vec(values, (inputs.len(), spec.context, pixels), &Device::Cpu)
}

/// Actions `[B, horizon, A]` and state `[B, S]` in raw units, where the model takes them.
fn condition(name: &str, spec: &ModelSpec, inputs: &[&PredictionInput]) -> Result<Condition, ServingError> {
    let (mut actions, mut states) = (Vec::new(), Vec::new());
    for input in inputs {
        for action in input.future_actions(name, spec)?.into_iter().flatten() {
            actions.extend_from_slice(action);
        }
        states.extend_from_slice(input.state(name, spec)?.unwrap_or_default());
    }
    let (batch, device) = (inputs.len(), &Device::Cpu);
    let tensor = |values: Vec<f32>, shape: &[usize]| {
        let given = !values.is_empty();
        given
            .then(|| Tensor::from_vec(values, shape, device).map_err(tensor_error))
            .transpose()
    };
    Ok(Condition {
        actions: tensor(actions, &[batch, spec.horizon, spec.actions.len()])?,
        state: tensor(states, &[batch, spec.states.len()])?,
    })
}

fn tensor_error(source: candle_core::Error) -> ServingError {
    ServingError::Tensor(Arc::new(source))
}
