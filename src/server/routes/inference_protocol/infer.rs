//! An inference: a prediction, or with `plans` a rollout for each plan.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::response::Response;

use super::message::InferRequest;
use super::metadata::{self, NamedModel};
use super::tensor::{Tensor, Values};
use crate::server::config::ServerConfig;
use crate::server::http::multipart::check_count;
use crate::server::http::problem::ApiError;
use crate::server::inference_statistics::InferenceTimes;
use crate::server::request_inputs;
use crate::server::routes::rollouts;
use crate::server::state::App;
use foreframe_core::frame::Frame;
use foreframe_core::registry::{Manifest, Model};
use foreframe_core::serving::{Prediction, PredictionInput, Rollout, Task, Timing};

/// What is to be computed.
struct InferenceTask {
    task: Task,
    /// Whether frames are intensities from 0 to 1, in both directions.
    is_float: bool,
    has_plans: bool,
}

pub(super) async fn infer(
    app: App,
    NamedModel(model): NamedModel,
    request: InferRequest,
) -> Result<Response, ApiError> {
    let (started, manifest) = (Instant::now(), Arc::clone(&model.manifest));
    let answered = answer(&app, &model, request).await;
    let (name, version) = (manifest.name.as_str(), manifest.version);
    match &answered {
        Ok((_, timing)) => {
            let times = InferenceTimes {
                whole: started.elapsed(),
                queue: Duration::from_micros(timing.queue_us),
                compute: Duration::from_micros(timing.compute_us),
            };
            app.inference_statistics.succeeded(name, version, &times);
        }
        Err(_) => app.inference_statistics.failed(name, version, started.elapsed()),
    }
    answered.map(|(response, _)| response)
}

async fn answer(app: &App, model: &Arc<Model>, request: InferRequest) -> Result<(Response, Timing), ApiError> {
    let _place = app.admission.enter()?;
    let (manifest, config) = (Arc::clone(&model.manifest), Arc::clone(&app.config));
    let names: Vec<&str> = metadata::outputs(&manifest).iter().map(|field| field.name).collect();
    request.answer.check(&names, &manifest)?;
    let InferRequest { inputs, steps, answer } = request;
    let known = Arc::clone(&manifest);
    let read = move || InferenceTask::read(inputs, steps, &known, &config);
    let InferenceTask {
        task,
        is_float,
        has_plans,
    } = app.predictions.run(read).await??;
    let prediction = app.predictor().compute(model, task, None).await?;
    let timing = prediction.timing;
    let write = move || {
        let warnings = prediction.warnings.clone();
        answer.respond(&manifest, outputs(prediction, is_float, has_plans), &warnings)
    };
    Ok((app.predictions.run(write).await?, timing))
}

impl InferenceTask {
    fn read(
        mut inputs: BTreeMap<String, Tensor>,
        steps: Option<usize>,
        manifest: &Manifest,
        config: &ServerConfig,
    ) -> Result<Self, ApiError> {
        let frames = inputs.remove("frames");
        let frames = frames.ok_or_else(|| ApiError::Unprocessable("input \"frames\" is missing".to_owned()))?;
        let is_float = matches!(frames.values, Values::Fp32(_));
        let frames = read_frames(frames, manifest, config.max_frames)?;
        let state = inputs.remove("state").map(vector).transpose()?;
        let actions = inputs.remove("actions").map(rows).transpose()?.unwrap_or_default();
        let plan = inputs.remove("plan").map(rows).transpose()?;
        let plans = inputs.remove("plans").map(blocks).transpose()?;
        if let Some(name) = inputs.keys().next() {
            let known: Vec<&str> = metadata::inputs(&manifest.spec)
                .iter()
                .map(|field| field.name)
                .collect();
            return Err(ApiError::Unprocessable(format!(
                "input \"{}\" is unknown; model \"{}\" takes {}",
                name.escape_default(),
                manifest.name,
                known.join(", ")
            )));
        }
        if plan.is_some() && plans.is_some() {
            return Err(ApiError::Unprocessable(
                "plan and plans are both given; give one".to_owned(),
            ));
        }
        let has_plans = plans.is_some();
        let (past_states, state) = request_inputs::states(state, None, frames.len())?;
        let task = if let Some(plans) = plans {
            Task::rollout(
                frames,
                past_states,
                None,
                rollouts::conditioning(plans, steps, state, manifest, config)?,
                manifest,
            )?
        } else {
            request_inputs::check_steps(steps, manifest, config)?;
            let input = PredictionInput {
                frames,
                actions: request_inputs::actions("actions", actions)?,
                state,
                plan: plan.map(|plan| request_inputs::actions("plan", plan)).transpose()?,
                steps,
                ..PredictionInput::default()
            };
            input.into_task(manifest)?
        };
        Ok(Self {
            task,
            is_float,
            has_plans,
        })
    }
}

/// Frames of the model's size. Other dimensions of length 1 in front are allowed.
fn read_frames(tensor: Tensor, manifest: &Manifest, limit: usize) -> Result<Vec<Frame>, ApiError> {
    let spec = &manifest.spec;
    let (width, height) = (spec.frame_width_px, spec.frame_height_px);
    let expected = [spec.context, height as usize, width as usize];
    let shape = tensor.shape.as_slice();
    let [ones @ .., count, found_height, found_width] = shape else {
        return Err(wrong_frames(&tensor.shape, expected, manifest));
    };
    if [*found_height, *found_width] != expected[1..] || ones.iter().any(|side| *side != 1) {
        return Err(wrong_frames(&tensor.shape, expected, manifest));
    }
    check_count("frames", *count, limit)?;
    let pixels = match tensor.values {
        Values::Uint8(pixels) => pixels,
        Values::Fp32(values) => {
            if let Some(value) = values.iter().find(|value| !(0.0..=1.0).contains(*value)) {
                return Err(ApiError::Unprocessable(format!(
                    "input \"frames\" holds {value}; FP32 is an intensity from 0 to 1"
                )));
            }
            values.into_iter().map(|value| (255.0 * value).round() as u8).collect()
        }
    };
    let frame = |pixels: &[u8]| Frame::new(width, height, pixels.to_vec());
    let frames: Result<_, _> = pixels.chunks_exact(spec.pixels()).map(frame).collect();
    frames.map_err(|error| ApiError::Unprocessable(format!("input \"frames\" is {error}")))
}

fn wrong_frames(found: &[usize], expected: [usize; 3], manifest: &Manifest) -> ApiError {
    ApiError::Unprocessable(format!(
        "input \"frames\" has the shape {found:?}; model \"{}\" takes {expected:?}",
        manifest.name
    ))
}

fn numbers(tensor: Tensor) -> Result<(Vec<usize>, Vec<f32>), ApiError> {
    match tensor.values {
        Values::Fp32(values) => Ok((tensor.shape, values)),
        Values::Uint8(_) => Err(ApiError::Unprocessable(format!(
            "input \"{}\" is UINT8; it must be FP32",
            tensor.name
        ))),
    }
}

fn vector(tensor: Tensor) -> Result<Vec<f32>, ApiError> {
    Ok(numbers(tensor)?.1)
}

/// The last dimension is a row.
fn rows(tensor: Tensor) -> Result<Vec<Vec<f32>>, ApiError> {
    let (shape, values) = numbers(tensor)?;
    let length = shape.last().copied().unwrap_or(0).max(1);
    Ok(values.chunks(length).map(<[f32]>::to_vec).collect())
}

/// The last dimension is a row, the one before it a block.
fn blocks(tensor: Tensor) -> Result<Vec<Vec<Vec<f32>>>, ApiError> {
    let [.., height, _] = tensor.shape.as_slice() else {
        return Err(ApiError::Unprocessable(format!(
            "input \"plans\" has the shape {:?}; it is [plans, steps, actions]",
            tensor.shape
        )));
    };
    let height = (*height).max(1);
    Ok(rows(tensor)?.chunks(height).map(<[Vec<f32>]>::to_vec).collect())
}

fn outputs(prediction: Prediction, is_float: bool, has_plans: bool) -> Vec<Tensor> {
    let (rollouts, spec) = (prediction.rollouts, &prediction.manifest.spec);
    let size = [spec.frame_height_px as usize, spec.frame_width_px as usize];
    let steps = rollouts.first().map_or(0, |rollout| rollout.frames.len());
    let front: Vec<usize> = if has_plans { vec![rollouts.len()] } else { Vec::new() };
    let tensor = |name: &str, shape: &[usize], values: Values| Tensor {
        name: name.to_owned(),
        shape: [front.as_slice(), shape].concat(),
        values,
    };
    let mut tensors = Vec::new();
    let novelty: Vec<f32> = rollouts.iter().filter_map(|rollout| rollout.novelty).collect();
    if !novelty.is_empty() {
        let errors = rollouts[0].errors.len();
        let expected: Vec<f32> = rollouts.iter().flat_map(Rollout::expected_mse).collect();
        let bands: Vec<f32> = rollouts.iter().flat_map(Rollout::mse_bands).flatten().collect();
        tensors.push(tensor("expected_mse", &[errors], Values::Fp32(expected)));
        tensors.push(tensor("mse_band_90", &[errors, 2], Values::Fp32(bands)));
        tensors.push(tensor("novelty", &[1], Values::Fp32(novelty)));
    }
    let frames = rollouts.into_iter().flat_map(|rollout| rollout.frames);
    let pixels: Vec<u8> = frames.flat_map(Frame::into_pixels).collect();
    let values = if is_float {
        Values::Fp32(pixels.into_iter().map(|pixel| f32::from(pixel) / 255.0).collect())
    } else {
        Values::Uint8(pixels)
    };
    tensors.push(tensor("predicted", &[steps, size[0], size[1]], values));
    tensors
}
