//! The computation: frames to tensors, through the model, and back to frames. Blocks; runs on the inference thread.

use std::collections::BTreeSet;
use std::sync::Arc;

use candle_core::{Device, Tensor};

use super::conditioning::ConditioningInput;
use super::error::ServingError;
use super::prediction::{Prediction, Rollout, Timing};
use super::task::{Features, Task};
use crate::frame::Frame;
use crate::nn::tensors::with_values;
use crate::nn::{ConditioningTensors, ModelSpec};
use crate::registry::Model;
use crate::registry::calibration::{ContextStatistics, RolloutInContext};
use crate::types::{Action, RobotState};

/// How many frames are decoded together at most. This bounds the memory that many rollouts need.
const DECODED_FRAMES: usize = 1024;

/// Computes the tasks as one batch, without warnings and timing: one matrix product encodes all new frames, and one predicts all rollouts.
/// Errors: `Model` if a task does not fit the model, `Tensor`, `Frame`.
pub(super) fn run(loaded: &Model, tasks: &[&Task]) -> Result<Vec<Prediction>, ServingError> {
    let mut encoded = encode(loaded, tasks)?.into_iter();
    let mut predictions: Vec<Prediction> = tasks
        .iter()
        .map(|task| Prediction {
            manifest: Arc::clone(&loaded.manifest),
            features: encoded.by_ref().take(task.frames.len()).collect(),
            rollouts: Vec::with_capacity(task.conditioning_inputs.len()),
            warnings: Vec::new(),
            timing: Timing::default(),
        })
        .collect();
    let (mut windows, mut window_of) = (Vec::new(), Vec::new());
    for (task, prediction) in tasks
        .iter()
        .zip(&predictions)
        .filter(|(task, _)| !task.conditioning_inputs.is_empty())
    {
        window_of.extend(vec![windows.len() as u32; task.conditioning_inputs.len()]);
        windows.push(task.past_features.iter().chain(&prediction.features));
    }
    let conditioning_inputs: Vec<&ConditioningInput> =
        tasks.iter().flat_map(|task| &task.conditioning_inputs).collect();
    if conditioning_inputs.is_empty() {
        return Ok(predictions);
    }
    let values = windows
        .into_iter()
        .flatten()
        .map(AsRef::as_ref)
        .collect::<Vec<&[f32]>>()
        .concat();
    let mut rollouts = predict_windows(loaded, values, &window_of, &conditioning_inputs)?.into_iter();
    for (task, prediction) in tasks.iter().zip(&mut predictions) {
        prediction
            .rollouts
            .extend(rollouts.by_ref().take(task.conditioning_inputs.len()));
    }
    Ok(predictions)
}

/// The features of all the tasks' frames, in order.
fn encode(loaded: &Model, tasks: &[&Task]) -> Result<Vec<Features>, ServingError> {
    let spec = loaded.spec();
    let frames: Vec<&Frame> = tasks.iter().flat_map(|task| &task.frames).collect();
    if frames.is_empty() {
        return Ok(Vec::new());
    }
    let values: Vec<Vec<f32>> = frames.iter().map(|frame| spec.preprocess.forward(frame)).collect();
    let features = Tensor::from_vec(values.concat(), (frames.len(), spec.pixels()), &Device::Cpu)
        .map_err(tensor_error)
        .and_then(|frames| {
            loaded
                .network
                .encode_frames(&frames)
                .map_err(|source| model_error(loaded, source))
        })?;
    with_values(&features, |values| {
        values.chunks_exact(spec.code_len()).map(Features::from).collect()
    })
    .map_err(tensor_error)
}

/// The rollout of each conditioning input. `values` holds the features of all windows, one after the other; `window_of` is the
/// index of the window of each conditioning input. Rollouts of the same number of steps are computed together.
fn predict_windows(
    loaded: &Model,
    values: Vec<f32>,
    window_of: &[u32],
    conditioning_inputs: &[&ConditioningInput],
) -> Result<Vec<Rollout>, ServingError> {
    let spec = loaded.spec();
    let contexts = match &loaded.manifest.calibration {
        Some(_) => ContextStatistics::of_codes(&loaded.network, &values, spec.context)
            .map_err(|source| model_error(loaded, source))?,
        None => Vec::new(),
    };
    let shape = (
        values.len() / (spec.context * spec.code_len()),
        spec.context,
        spec.code_len(),
    );
    let windows = Windows {
        loaded,
        contexts,
        features: Tensor::from_vec(values, shape, &Device::Cpu).map_err(tensor_error)?,
    };
    let mut rollouts = vec![Rollout::default(); conditioning_inputs.len()];
    let steps: BTreeSet<usize> = conditioning_inputs.iter().map(|input| input.steps(spec)).collect();
    for steps in steps {
        let same = |place: &usize| conditioning_inputs[*place].steps(spec) == steps;
        let places: Vec<usize> = (0..conditioning_inputs.len()).filter(same).collect();
        let rows: Vec<(u32, &ConditioningInput)> = places
            .iter()
            .map(|&place| (window_of[place], conditioning_inputs[place]))
            .collect();
        for (place, rollout) in places.into_iter().zip(windows.rollouts(&rows, steps)?) {
            rollouts[place] = rollout;
        }
    }
    Ok(rollouts)
}

/// The contexts of a batch.
struct Windows<'a> {
    loaded: &'a Model,
    /// Empty if the model is not calibrated.
    contexts: Vec<ContextStatistics>,
    /// The features of all windows `[windows, context, F]`.
    features: Tensor,
}

impl Windows<'_> {
    /// Rollouts of `steps` frames. A row is the index of a window and a conditioning input.
    fn rollouts(&self, rows: &[(u32, &ConditioningInput)], steps: usize) -> Result<Vec<Rollout>, ServingError> {
        let (loaded, spec) = (self.loaded, self.loaded.spec());
        let (window_of, inputs): (Vec<u32>, Vec<&ConditioningInput>) = rows.iter().copied().unzip();
        let codes = loaded
            .network
            .predict_steps(&self.features, &window_of, &condition(spec, &inputs, steps)?, steps)
            .and_then(|predicted| Ok(predicted.flatten(0, 1)?))
            .map_err(|source| model_error(loaded, source))?;
        let mut frames = decode(loaded, &codes, rows.len() * steps)?.into_iter();
        let frames = rows.iter().map(|_| frames.by_ref().take(steps).collect());
        let frames: Vec<Vec<Frame>> = frames.collect();
        with_values(&self.features, |seen| {
            with_values(&codes, |codes| {
                let codes = codes.chunks_exact(steps * spec.code_len());
                let rollouts = rows.iter().zip(codes).zip(frames);
                rollouts
                    .map(|((row, codes), frames)| self.rollout(*row, seen, codes, frames))
                    .collect()
            })
        })
        .and_then(|rollouts| rollouts)
        .map_err(tensor_error)
    }

    /// A rollout with its expected errors and its novelty. `seen`: the features of all windows.
    fn rollout(
        &self,
        (window, input): (u32, &ConditioningInput),
        seen: &[f32],
        codes: &[f32],
        frames: Vec<Frame>,
    ) -> Rollout {
        let spec = self.loaded.spec();
        let (Some(calibration), Some(context)) =
            (&self.loaded.manifest.calibration, self.contexts.get(window as usize))
        else {
            return Rollout {
                frames,
                ..Rollout::default()
            };
        };
        let code = |back: usize| {
            let place = window as usize * spec.context + spec.context - back.min(spec.context);
            &seen[place * spec.code_len()..(place + 1) * spec.code_len()]
        };
        let actions: Vec<f32> = input.actions.iter().flat_map(Action::as_slice).copied().collect();
        let rollout = RolloutInContext {
            spec,
            context,
            seen: [code(1), code(2)],
            codes,
            frames: &frames,
            actions: &actions,
        };
        Rollout {
            errors: rollout.expected_errors(calibration),
            novelty: Some(calibration.novelty.novelty(context)),
            frames,
        }
    }
}

/// The frames of `total` predicted codes.
fn decode(loaded: &Model, codes: &Tensor, total: usize) -> Result<Vec<Frame>, ServingError> {
    let mut frames = Vec::with_capacity(total);
    for first in (0..total).step_by(DECODED_FRAMES) {
        let part = codes
            .narrow(0, first, DECODED_FRAMES.min(total - first))
            .map_err(tensor_error)?;
        let pixels = loaded
            .network
            .decode_frames(&part)
            .map_err(|source| model_error(loaded, source))?;
        frames.extend(with_values(&pixels, |values| images(loaded, values)).map_err(tensor_error)??);
    }
    Ok(frames)
}

fn images(loaded: &Model, values: &[f32]) -> Result<Vec<Frame>, ServingError> {
    let spec = loaded.spec();
    let frame = |pixels| {
        spec.preprocess
            .frame_from(pixels, spec.frame_width_px, spec.frame_height_px)
    };
    let frames = values.chunks_exact(spec.pixels()).map(frame);
    frames.collect::<Result<_, _>>().map_err(|source| ServingError::Frame {
        model: loaded.manifest.name.clone(),
        source,
    })
}

/// Actions `[N, steps, A]` and states `[N, S]` in physical units, if the model takes them.
fn condition(
    spec: &ModelSpec,
    conditioning_inputs: &[&ConditioningInput],
    steps: usize,
) -> Result<ConditioningTensors, ServingError> {
    let actions = conditioning_inputs
        .iter()
        .flat_map(|conditioning| &conditioning.actions)
        .flat_map(Action::as_slice);
    let states = conditioning_inputs
        .iter()
        .flat_map(|conditioning| &conditioning.state)
        .flat_map(RobotState::as_slice);
    let tensor = |values: Vec<f32>, shape: &[usize]| {
        let given = !values.is_empty();
        given
            .then(|| Tensor::from_vec(values, shape, &Device::Cpu).map_err(tensor_error))
            .transpose()
    };
    Ok(ConditioningTensors {
        actions: tensor(
            actions.copied().collect(),
            &[conditioning_inputs.len(), steps, spec.actions.len()],
        )?,
        state: tensor(
            states.copied().collect(),
            &[conditioning_inputs.len(), spec.states.len()],
        )?,
    })
}

fn model_error(loaded: &Model, source: crate::nn::NnError) -> ServingError {
    ServingError::Model {
        model: loaded.manifest.name.clone(),
        source: Arc::new(source),
    }
}

fn tensor_error(source: candle_core::Error) -> ServingError {
    ServingError::Tensor(Arc::new(source.into()))
}
