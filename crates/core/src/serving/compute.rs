//! The computation: frames to tensors, through the model, and back to frames. Blocks; runs on the inference thread.

use std::collections::BTreeSet;
use std::sync::Arc;

use candle_core::{DType, Device, Tensor};

use super::conditioning::ConditioningInput;
use super::error::ServingError;
use super::prediction::{Prediction, Rollout, Timing};
use super::task::{Features, Task};
use crate::frame::warp::CameraModel;
use crate::frame::{Frame, FrameError};
use crate::nn::tensors::with_values;
use crate::nn::{ConditioningTensors, ModelSpec, NnError, Occupancy};
use crate::registry::Model;
use crate::registry::calibration::{ContextStatistics, RolloutInContext};
use crate::types::{Action, RobotState};

/// Computes the tasks as one batch, without warnings and timing: one matrix product encodes all new frames, and one predicts all rollouts.
/// Errors: `Model` if a task does not fit the model, `Frame`.
pub(super) fn run(loaded: &Model, tasks: &[&Task]) -> Result<Vec<Prediction>, ServingError> {
    compute(loaded, tasks).map_err(|failure| {
        let model = loaded.manifest.name.clone();
        match failure {
            Failure::Network(source) => ServingError::Model {
                model,
                source: Arc::new(source),
            },
            Failure::Image(source) => ServingError::Frame { model, source },
        }
    })
}

/// Why a model's computation failed.
enum Failure {
    Network(NnError),
    Image(FrameError),
}

impl<E: Into<NnError>> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Network(error.into())
    }
}

/// The index of a window and a conditioning input: what a rollout is predicted from.
type RolloutRow<'a> = (u32, &'a ConditioningInput);

fn compute(loaded: &Model, tasks: &[&Task]) -> Result<Vec<Prediction>, Failure> {
    let mut encoded = encode(loaded, tasks)?.into_iter();
    let (mut predictions, mut windows, mut rows) = (Vec::new(), Vec::new(), Vec::<RolloutRow>::new());
    let mut of_windows: Vec<&Task> = Vec::new();
    for task in tasks {
        let features: Vec<Features> = encoded.by_ref().take(task.frames.len()).collect();
        if !task.conditioning_inputs.is_empty() {
            let window = windows.len() as u32;
            rows.extend(task.conditioning_inputs.iter().map(|input| (window, input)));
            of_windows.push(task);
            windows.push(task.past_features.iter().chain(&features).cloned().collect());
        }
        predictions.push(Prediction {
            manifest: Arc::clone(&loaded.manifest),
            features,
            past_errors: task.past_errors.clone(),
            rollouts: Vec::new(),
            occupancy: None,
            warnings: Vec::new(),
            timing: Timing::default(),
        });
    }
    if !rows.is_empty() {
        let windows = Windows::new(loaded, &windows, of_windows)?;
        let mut rollouts = windows.predict(&rows)?.into_iter();
        let mut window = 0;
        for (task, prediction) in tasks.iter().zip(&mut predictions) {
            if task.sees_occupancy && !task.conditioning_inputs.is_empty() {
                prediction.occupancy = windows.occupancy(window)?;
            }
            window += u32::from(!task.conditioning_inputs.is_empty());
            prediction.rollouts = rollouts.by_ref().take(task.conditioning_inputs.len()).collect();
        }
    }
    for (task, prediction) in tasks.iter().zip(&mut predictions) {
        prediction.follow_past_errors(&task.frames);
    }
    Ok(predictions)
}

/// The features of all the tasks' frames, in order.
fn encode(loaded: &Model, tasks: &[&Task]) -> Result<Vec<Features>, Failure> {
    let spec = loaded.spec();
    let frames = tasks.iter().flat_map(|task| &task.frames);
    let frames = frames.map(|frame| spec.preprocess.forward(frame));
    if spec.keeps_frames() {
        return Ok(frames.map(Features::from).collect());
    }
    let (mut pixels, mut count) = (Vec::new(), 0);
    for frame in frames {
        pixels.extend(frame);
        count += 1;
    }
    if count == 0 {
        return Ok(Vec::new());
    }
    let shape = (count, spec.pixels());
    let features = loaded
        .network
        .encode_frames(&Tensor::from_vec(pixels, shape, &Device::Cpu)?)?;
    Ok(with_values(&features, |values| {
        let of_frames = values.chunks_exact(spec.code_len());
        of_frames.map(|features| Features::from(features.to_vec())).collect()
    })?)
}

/// The contexts of a batch.
struct Windows<'a> {
    loaded: &'a Model,
    /// Empty if the model is not calibrated.
    contexts: Vec<ContextStatistics>,
    /// The features of all windows `[windows, context, F]`.
    features: Tensor,
    /// The task of each window.
    tasks: Vec<&'a Task>,
}

impl<'a> Windows<'a> {
    /// From the features of each window's frames, and its task.
    fn new(loaded: &'a Model, windows: &[Vec<Features>], tasks: Vec<&'a Task>) -> Result<Self, Failure> {
        let spec = loaded.spec();
        let values = windows
            .iter()
            .flatten()
            .map(|features| features.as_slice())
            .collect::<Vec<&[f32]>>()
            .concat();
        let contexts = match &loaded.manifest.calibration {
            Some(_) => ContextStatistics::of_codes(&loaded.network, &values, spec.context)?,
            None => Vec::new(),
        };
        let frames = values.len() / spec.code_len();
        let shape = (frames / spec.context, spec.context, spec.code_len());
        Ok(Self {
            loaded,
            contexts,
            features: Tensor::from_vec(values, shape, &Device::Cpu)?,
            tasks,
        })
    }

    /// The rollout of each row. Rollouts of the same number of steps are computed together.
    fn predict(&self, rows: &[RolloutRow<'_>]) -> Result<Vec<Rollout>, Failure> {
        let spec = self.loaded.spec();
        let mut rollouts = vec![Rollout::default(); rows.len()];
        let steps: BTreeSet<usize> = rows.iter().map(|(_, input)| input.steps(spec)).collect();
        for steps in steps {
            let same = rows.iter().copied().enumerate();
            let same = same.filter(|(_, (_, input))| input.steps(spec) == steps);
            let (places, rows): (Vec<usize>, Vec<RolloutRow<'_>>) = same.unzip();
            for (place, rollout) in places.into_iter().zip(self.rollouts(&rows, steps)?) {
                rollouts[place] = rollout;
            }
        }
        Ok(rollouts)
    }

    /// Rollouts of `steps` frames.
    fn rollouts(&self, rows: &[RolloutRow<'_>], steps: usize) -> Result<Vec<Rollout>, Failure> {
        let spec = self.loaded.spec();
        let (window_of, inputs): (Vec<u32>, Vec<&ConditioningInput>) = rows.iter().copied().unzip();
        let conditioning = ConditioningTensors {
            past_states: self.past_states(&window_of)?,
            cameras: self.cameras(&window_of),
            ..condition(spec, &inputs, steps)?
        };
        let network = &self.loaded.network;
        let codes = network.predict_steps(&self.features, &window_of, &conditioning, steps)?;
        with_values(&self.features, |seen| {
            with_values(&codes, |codes| {
                let mut frames = decode(self.loaded, codes)?.into_iter();
                let codes = codes.chunks_exact(steps * spec.code_len());
                let rollouts = rows.iter().zip(codes);
                let rollouts =
                    rollouts.map(|(row, codes)| self.rollout(*row, seen, codes, frames.by_ref().take(steps).collect()));
                Ok::<_, Failure>(rollouts.collect())
            })
        })??
    }

    /// What stands around the robot at the last frame of a window, and where movers will be while it stops; `None` if the model
    /// estimates no depth.
    fn occupancy(&self, window: u32) -> Result<Option<Occupancy>, Failure> {
        let spec = self.loaded.spec();
        let inputs: Vec<&ConditioningInput> = self.tasks[window as usize].conditioning_inputs.iter().take(1).collect();
        let conditioning = ConditioningTensors {
            actions: spec
                .action_inputs()
                .map(|count| Tensor::zeros((1, spec.horizon, count), DType::F32, &Device::Cpu))
                .transpose()?,
            past_states: self.past_states(&[window])?,
            cameras: self.cameras(&[window]),
            ..condition(spec, &inputs, inputs[0].steps(spec))?
        };
        let features = self.features.narrow(0, window as usize, 1)?.contiguous()?;
        let occupancy = self.loaded.network.occupancy(&features, &conditioning)?;
        Ok(occupancy.and_then(|of_windows| of_windows.into_iter().next()))
    }

    /// The earlier states of the window of each row `[N, context - 1, S]`, NaN where they are not known; `None` if no
    /// window's are.
    fn past_states(&self, window_of: &[u32]) -> Result<Option<Tensor>, Failure> {
        let spec = self.loaded.spec();
        let (frames, channels) = (spec.context - 1, spec.states.len());
        let of_rows = window_of
            .iter()
            .map(|&window| self.tasks[window as usize].past_states.as_slice());
        if of_rows.clone().all(<[RobotState]>::is_empty) {
            return Ok(None);
        }
        let mut values = Vec::with_capacity(window_of.len() * frames * channels);
        for states in of_rows {
            match states {
                [] => values.extend(std::iter::repeat_n(f32::NAN, frames * channels)),
                _ => values.extend(states.iter().flat_map(RobotState::as_slice)),
            }
        }
        Ok(Some(Tensor::from_vec(
            values,
            (window_of.len(), frames, channels),
            &Device::Cpu,
        )?))
    }

    /// The camera of each row; empty where the model's counts.
    fn cameras(&self, window_of: &[u32]) -> Vec<CameraModel> {
        let flow = self.loaded.spec().flow();
        let Some(flow) = flow.filter(|_| self.tasks.iter().any(|task| task.camera.is_some())) else {
            return Vec::new();
        };
        let of_row = |&window: &u32| self.tasks[window as usize].camera.or(flow.camera);
        window_of
            .iter()
            .map(|window| of_row(window).unwrap_or(CameraModel::USUAL))
            .collect()
    }

    /// A rollout with its expected errors and its novelty. `seen`: the features of all windows.
    fn rollout(&self, (window, input): RolloutRow<'_>, seen: &[f32], codes: &[f32], frames: Vec<Frame>) -> Rollout {
        let spec = self.loaded.spec();
        let (calibration, context) = (&self.loaded.manifest.calibration, self.contexts.get(window as usize));
        let (Some(calibration), Some(context)) = (calibration, context) else {
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
        let state = input.state.as_ref().map(RobotState::as_slice);
        let distance = calibration.distance(spec, context, state, &actions);
        Rollout {
            errors: rollout.expected_errors(calibration),
            novelty: Some(calibration.novelty.novelty(distance)),
            frames,
        }
    }
}

/// The frames of predicted codes.
fn decode(loaded: &Model, codes: &[f32]) -> Result<Vec<Frame>, Failure> {
    let spec = loaded.spec();
    let (width, height) = (spec.frame_width_px, spec.frame_height_px);
    let mut frames = Vec::with_capacity(codes.len() / spec.code_len());
    loaded.network.for_each_frame(codes, |values| {
        frames.push(spec.preprocess.frame_from(values, width, height));
    })?;
    let frames: Result<Vec<Frame>, FrameError> = frames.into_iter().collect();
    frames.map_err(Failure::Image)
}

/// Actions `[N, steps, A]` and states `[N, S]` in physical units, if the model takes them; NaN where they are not known.
fn condition(spec: &ModelSpec, inputs: &[&ConditioningInput], steps: usize) -> Result<ConditioningTensors, Failure> {
    let tensor = |used: Option<usize>, rows: Vec<Vec<f32>>, shape: &[usize]| {
        let each: usize = shape[1..].iter().product();
        let filled = rows.into_iter().flat_map(|mut row| {
            row.resize(each, f32::NAN);
            row
        });
        used.map(|_| Tensor::from_vec(filled.collect::<Vec<_>>(), shape, &Device::Cpu))
            .transpose()
    };
    let actions = inputs.iter().map(|input| {
        let actions = input.actions.iter().flat_map(Action::as_slice);
        actions.copied().collect()
    });
    let states = inputs.iter().map(|input| {
        let state = input.state.iter().flat_map(RobotState::as_slice);
        state.copied().collect()
    });
    Ok(ConditioningTensors {
        actions: tensor(
            spec.action_inputs(),
            actions.collect(),
            &[inputs.len(), steps, spec.actions.len()],
        )?,
        state: tensor(
            spec.state_inputs(),
            states.collect(),
            &[inputs.len(), spec.states.len()],
        )?,
        ..ConditioningTensors::none()
    })
}
