//! Windows through a model, batch by batch.

use std::ops::Range;

use candle_core::{Device, Tensor};
use rayon::prelude::*;

use super::EvaluationError;
use super::compatible::{has_actions_of, has_states_of};
use super::windows::true_frame;
use foreframe_core::frame::resize::{Resize, resize};
use foreframe_core::frame::{Frame, quality};
use foreframe_core::nn::{ConditioningTensors, Feedback, ModelSpec};
use foreframe_core::registry::Model;
use foreframe_data::dataset::{Dataset, Window};

/// Which future actions the model gets.
#[derive(Clone, Copy, Debug)]
pub(super) enum ActionSource<'a> {
    /// Those that were carried out.
    Recorded,
    /// For each window, in the order of the batch, those carried out in another one.
    OfWindows(&'a [Window]),
    /// These: of each window, in the order of the batch, step after step, in the channels' own units.
    Given(&'a [f32]),
    /// At every step the action that led to the last frame seen.
    Held,
    /// Zero in every component, in the channels' own units.
    Zero,
    /// None, and no states either: only for models that can do without.
    NoInputs,
}

/// What a model predicted from a batch of windows, one window after another.
pub(super) struct Predicted {
    /// Codes of the frames seen.
    pub(super) seen: Vec<f32>,
    /// Codes of the predicted frames.
    pub(super) codes: Vec<f32>,
    /// The predicted frames in the model's space, not clamped.
    pub(super) frames: Vec<f32>,
    /// The actions in their own units; empty if the model takes none.
    pub(super) actions: Vec<f32>,
}

/// A model on a data set.
#[derive(Clone, Copy)]
pub(super) struct Inference<'a> {
    pub(super) loaded: &'a Model,
    pub(super) dataset: &'a Dataset,
}

impl<'a> Inference<'a> {
    /// The model's specification.
    pub(super) fn spec(&self) -> &'a ModelSpec {
        self.loaded.spec()
    }

    /// Predicts each window's frames to come. Errors: those of the network, `NotFinite`.
    pub(super) fn predict(&self, windows: &[Window], source: ActionSource) -> Result<Predicted, EvaluationError> {
        let (network, spec) = (&self.loaded.network, self.spec());
        let seen = self.encode(&self.frames(windows, 0..spec.context)?)?;
        let contexts = Tensor::from_slice(&seen, (windows.len(), spec.context, spec.code_len()), &Device::Cpu)?;
        let condition = self.condition(windows, source)?;
        let codes = network.predict(&contexts, &condition, Feedback::Prediction)?;
        let frames = values(&network.decode_frames(&codes.flatten(0, 1)?)?)?;
        if let Some(place) = frames.iter().position(|value| !value.is_finite()) {
            return Err(EvaluationError::NotFinite {
                model: self.loaded.manifest.name.clone(),
                frame: windows[place / (spec.horizon * spec.pixels())].first_frame,
            });
        }
        Ok(Predicted {
            seen,
            codes: values(&codes)?,
            frames,
            actions: condition.actions.as_ref().map(values).transpose()?.unwrap_or_default(),
        })
    }

    /// Where movers are in each window's last context frame and in the frames to come, as logits; `None` if the model does not tell.
    /// Errors: those of the network.
    pub(super) fn movers(&self, windows: &[Window]) -> Result<Option<Vec<f32>>, EvaluationError> {
        let (context, condition) = (
            self.contexts(windows)?,
            self.condition(windows, ActionSource::Recorded)?,
        );
        let horizon = self.spec().horizon;
        let predicted = self.loaded.network.predict_flow(&context, &condition, horizon)?;
        predicted
            .and_then(|predicted| predicted.movers)
            .as_ref()
            .map(values)
            .transpose()
    }

    /// The depth of each pixel of a window's last context frame, as estimated and before anything is learned, in metres; `None`
    /// if the model estimates none. Errors: those of the network.
    pub(super) fn depths(&self, window: Window) -> Result<Option<[Vec<f32>; 2]>, EvaluationError> {
        let (context, condition) = (
            self.contexts(&[window])?,
            self.condition(&[window], ActionSource::Recorded)?,
        );
        let occupancy = self.loaded.network.occupancy(&context, &condition)?;
        let first = occupancy.and_then(|of_windows| of_windows.into_iter().next());
        Ok(first.map(|occupancy| [occupancy.depths_m, occupancy.first_depths_m]))
    }

    /// The codes of the frames that each window shows, `[windows, context, code]`.
    fn contexts(&self, windows: &[Window]) -> Result<Tensor, EvaluationError> {
        let spec = self.spec();
        let seen = self.encode(&self.frames(windows, 0..spec.context)?)?;
        let shape = (windows.len(), spec.context, spec.code_len());
        Ok(Tensor::from_vec(seen, shape, &Device::Cpu)?)
    }

    /// Frames of windows as the model reconstructs them from the codes of the frames seen, in the model's space. Empty if it
    /// does not reconstruct. Errors: those of the network.
    pub(super) fn reconstruct(&self, seen: &[f32]) -> Result<Vec<f32>, EvaluationError> {
        let (context, code) = (self.spec().context, self.spec().code_len());
        let codes = Tensor::from_slice(seen, (seen.len() / (context * code), context, code), &Device::Cpu)?;
        match self.loaded.network.reconstruct(&codes)? {
            Some(codes) => values(&self.loaded.network.decode_frames(&codes.flatten(0, 1)?)?),
            None => Ok(Vec::new()),
        }
    }

    /// Frames in the model's space through its frame encoder and decoder. Errors: those of the network.
    pub(super) fn through_codec(&self, frames: &[f32]) -> Result<Vec<f32>, EvaluationError> {
        let shape = (frames.len() / self.spec().pixels(), self.spec().code_len());
        let codes = Tensor::from_vec(self.encode(frames)?, shape, &Device::Cpu)?;
        values(&self.loaded.network.decode_frames(&codes)?)
    }

    /// Codes of frames in the model's space, both one after another. Errors: those of the network.
    pub(super) fn encode(&self, frames: &[f32]) -> Result<Vec<f32>, EvaluationError> {
        let pixels = self.spec().pixels();
        let frames = Tensor::from_slice(frames, (frames.len() / pixels, pixels), &Device::Cpu)?;
        values(&self.loaded.network.encode_frames(&frames)?)
    }

    /// Those steps of each window in the model's space, one after another. Frames of another size are cropped and resized.
    pub(super) fn frames(&self, windows: &[Window], steps: Range<usize>) -> Result<Vec<f32>, EvaluationError> {
        let spec = self.spec();
        let (width, height, pixels) = (spec.frame_width_px, spec.frame_height_px, spec.pixels());
        let mut all = vec![0.0; windows.len() * steps.len() * pixels];
        let places = all.par_chunks_exact_mut(pixels).enumerate();
        places.try_for_each(|(index, place)| -> Result<(), EvaluationError> {
            let frame = windows[index / steps.len()].first_frame + steps.start + index % steps.len();
            let frame = resize(&self.dataset.frame(frame)?, width, height, Resize::Crop)?;
            place.copy_from_slice(&spec.preprocess.forward(&frame));
            Ok(())
        })?;
        Ok(all)
    }

    /// Frames as the camera would see them, of values in the model's space. Errors: `Frame` where one is not finite.
    pub(super) fn camera_frames(&self, values: &[f32]) -> Result<Vec<Frame>, EvaluationError> {
        let spec = self.spec();
        let frames = values.chunks_exact(spec.pixels());
        let (width, height) = (spec.frame_width_px, spec.frame_height_px);
        let frames = frames.map(|frame| spec.preprocess.frame_from(frame, width, height));
        Ok(frames.collect::<Result<_, _>>()?)
    }

    /// The mean squared error of each of a window's predicted frames, which are in the model's space; intensities 0…1.
    pub(super) fn step_errors(&self, window: Window, predicted: &[f32]) -> Result<Vec<f64>, EvaluationError> {
        let spec = self.spec();
        let future = window.first_frame + spec.context..;
        let error = |(frame, predicted): (usize, &[f32])| {
            let truth = true_frame(self.dataset, frame)?;
            Ok(quality::mse(&spec.preprocess.inverse(predicted), &truth))
        };
        future.zip(predicted.chunks_exact(spec.pixels())).map(error).collect()
    }

    /// Action k of a window is the one recorded at the frame before its k-th predicted frame. Channels that the data set does not have
    /// are left out: only a model that can do without takes such a data set.
    fn condition(&self, windows: &[Window], source: ActionSource) -> Result<ConditioningTensors, EvaluationError> {
        let (dataset, spec, batch) = (self.dataset, self.spec(), windows.len());
        let last = spec.context - 1;
        let mut condition = ConditioningTensors::none();
        condition.cameras = dataset.cameras(
            windows.iter().map(|window| window.episode),
            spec.flow().and_then(|flow| flow.camera),
        );
        if matches!(source, ActionSource::NoInputs) {
            return Ok(condition);
        }
        if let Some(count) = spec.action_inputs().filter(|_| has_actions_of(spec, dataset)) {
            let mut actions = Vec::with_capacity(batch * spec.horizon * count);
            let acting = match source {
                ActionSource::OfWindows(others) => others,
                ActionSource::Given(given) => {
                    actions.extend_from_slice(given);
                    &[]
                }
                _ => windows,
            };
            for window in acting {
                for step in 0..spec.horizon {
                    let place = match source {
                        ActionSource::Held => last.saturating_sub(1),
                        _ => last + step,
                    };
                    actions.extend_from_slice(dataset.action(window.first_frame + place));
                }
            }
            if matches!(source, ActionSource::Zero) {
                actions.fill(0.0);
            }
            condition.actions = Some(Tensor::from_vec(actions, (batch, spec.horizon, count), &Device::Cpu)?);
        }
        if let Some(count) = spec.state_inputs().filter(|_| has_states_of(spec, dataset)) {
            let states = windows.iter().map(|window| dataset.state(window.first_frame + last));
            let states = states.collect::<Vec<_>>().concat();
            condition.state = Some(Tensor::from_vec(states, (batch, count), &Device::Cpu)?);
            let earlier = windows
                .iter()
                .flat_map(|window| window.first_frame..window.first_frame + last);
            let earlier = earlier.map(|frame| dataset.state(frame)).collect::<Vec<_>>().concat();
            condition.past_states = Some(Tensor::from_vec(earlier, (batch, last, count), &Device::Cpu)?);
        }
        Ok(condition)
    }
}

fn values(tensor: &Tensor) -> Result<Vec<f32>, EvaluationError> {
    Ok(tensor.flatten_all()?.to_vec1::<f32>()?)
}
