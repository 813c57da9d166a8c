//! Makes batches of frames and windows as tensors.

use candle_core::{Device, Tensor};
use rayon::prelude::*;

use super::TrainError;
use super::augment::{ACTION, Augmentation, Hidden, STATE, WindowChange};
use super::config::Target;
use foreframe_core::frame::preprocess::Preprocess;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::nn::ConditioningTensors;
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, Window};

/// A data set's frames, converted to the model's value range.
pub(super) struct FrameSource<'a> {
    dataset: &'a Dataset,
    preprocess: Preprocess,
    target: Preprocess,
    augmentation: Augmentation,
    reads_masks: bool,
    /// What counts where the data set does not know its camera.
    camera: Option<CameraModel>,
}

/// A window of a batch, and how it is changed.
#[derive(Clone, Copy)]
pub(super) struct DrawnWindow<'a> {
    pub(super) window: &'a Window,
    pub(super) change: WindowChange,
}

impl<'a> DrawnWindow<'a> {
    /// The window as it was recorded.
    pub(super) fn unchanged(window: &'a Window) -> Self {
        Self {
            window,
            change: WindowChange::NONE,
        }
    }

    /// The data set's frame at this place of the window of that shape, as it is played.
    fn frame(&self, place: usize, shape: WindowShape) -> usize {
        let last = shape.frames() - 1;
        self.window.first_frame + if self.change.is_reversed { last - place } else { place }
    }
}

/// One batch of windows.
pub(super) struct WindowBatch {
    /// Context frames as inputs of the encoder, `[B, T, P]`.
    pub(super) inputs: Tensor,
    /// Context frames as targets of the reconstruction, `[B, T, P]`.
    pub(super) input_targets: Tensor,
    /// Future frames as targets of the prediction, `[B, horizon, P]`.
    pub(super) targets: Tensor,
    /// Future frames as inputs of the encoder, `[B, horizon, P]`; only for teacher forcing.
    pub(super) future: Option<Tensor>,
    /// The actions that lead to the future frames, and the state at the last context frame.
    pub(super) condition: ConditioningTensors,
    /// The states at the targets `[B, horizon, S]`, where the data set has states.
    pub(super) future_states: Option<Tensor>,
    /// The state at the last context frame `[B, S]`, also where it is hidden from the network.
    pub(super) measured: Option<Tensor>,
    /// Where movers are in the last context frame and in the targets `[B, 1 + horizon, P]`, where the data set has masks; NaN for
    /// windows of which no masks are known.
    pub(super) movers: Option<Tensor>,
}

impl<'a> FrameSource<'a> {
    pub(super) fn new(
        dataset: &'a Dataset,
        preprocess: Preprocess,
        target: Target,
        augmentation: Augmentation,
    ) -> Self {
        let target = match target {
            Target::Sharp => Preprocess {
                blur_sigma_px: 0.0,
                ..preprocess
            },
            Target::Smoothed => preprocess,
        };
        Self {
            dataset,
            preprocess,
            target,
            augmentation,
            reads_masks: false,
            camera: None,
        }
    }

    /// The same source, whose batches also say where movers are, if the data set has masks.
    pub(super) fn with_masks(self, reads_masks: bool) -> Self {
        Self { reads_masks, ..self }
    }

    /// The same source, with the camera of windows whose data set does not know it.
    pub(super) fn with_camera(self, camera: Option<CameraModel>) -> Self {
        Self { camera, ..self }
    }

    /// The data set.
    pub(super) fn dataset(&self) -> &'a Dataset {
        self.dataset
    }

    /// The augmentation of training windows.
    pub(super) fn augmentation(&self) -> &Augmentation {
        &self.augmentation
    }

    /// The frames as inputs of the encoder, `[N, P]`.
    pub(super) fn inputs(&self, frames: &[usize]) -> Result<Tensor, TrainError> {
        self.preprocessed(self.preprocess, &unchanged(frames))
    }

    /// The frames as targets of the decoder, `[N, P]`.
    pub(super) fn targets(&self, frames: &[usize]) -> Result<Tensor, TrainError> {
        self.preprocessed(self.target, &unchanged(frames))
    }

    fn preprocessed(&self, preprocess: Preprocess, frames: &[(usize, WindowChange)]) -> Result<Tensor, TrainError> {
        let info = self.dataset.info();
        let pixels = info.frame_pixels();
        let width = info.frame_width_px as usize;
        let mut values = vec![0.0; frames.len() * pixels];
        values
            .par_chunks_exact_mut(pixels)
            .zip(frames)
            .try_for_each(|(out, &(frame, change))| {
                let mut frame = self.dataset.frame(frame)?;
                if change.are_movers_mirrored {
                    self.augmentation.mirror_movers(frame.pixels_mut(), width);
                }
                out.copy_from_slice(&preprocess.forward(&frame));
                change.apply(out, width, preprocess.invert);
                Ok::<(), TrainError>(())
            })?;
        Ok(Tensor::from_vec(values, (frames.len(), pixels), &Device::Cpu)?)
    }

    /// Whether each pixel of the frames belongs to a mover `[N, P]`, 0 or 1, or NaN for a frame without a mask; `None` without masks.
    fn masks(&self, frames: &[(usize, WindowChange)]) -> Result<Option<Tensor>, TrainError> {
        let info = self.dataset.info();
        if !(info.has_masks && self.reads_masks) {
            return Ok(None);
        }
        let mut values = Vec::with_capacity(frames.len() * info.frame_pixels());
        for &(frame, change) in frames {
            let from = values.len();
            let Some(mask) = self.dataset.mask(frame)? else {
                values.resize(from + info.frame_pixels(), f32::NAN);
                continue;
            };
            values.extend(mask.iter().map(|&robot| f32::from(u8::from(robot != 0))));
            let change = WindowChange { gain: 1.0, ..change };
            change.apply(&mut values[from..], info.frame_width_px as usize, false);
        }
        Ok(Some(Tensor::from_vec(
            values,
            (frames.len(), info.frame_pixels()),
            &Device::Cpu,
        )?))
    }

    /// One batch of windows. `future` is made only if `with_future`.
    pub(super) fn windows(
        &self,
        windows: &[DrawnWindow<'_>],
        shape: WindowShape,
        with_future: bool,
    ) -> Result<WindowBatch, TrainError> {
        let (context, horizon) = (shape.context, shape.horizon);
        let span = |from: usize, length: usize| -> Vec<(usize, WindowChange)> {
            let places = from..from + length;
            windows
                .iter()
                .flat_map(|drawn| places.clone().map(|place| (drawn.frame(place, shape), drawn.change)))
                .collect()
        };
        let inputs = |frames: &[(usize, WindowChange)]| self.preprocessed(self.preprocess, frames);
        let targets = |frames: &[(usize, WindowChange)]| self.preprocessed(self.target, frames);
        let (past, future) = (span(0, context), span(context, horizon));
        // An action acts from its frame to the next one, so the action of the last input leads to the first target. Models with
        // windows that are played backwards take no actions.
        let (acting, last, earlier) = (span(context - 1, horizon), span(context - 1, 1), span(0, context - 1));
        let batched = |frames: Tensor, length: usize| frames.reshape((windows.len(), length, ()));
        let future_inputs = with_future.then(|| inputs(&future)).transpose()?;
        let shown = |hides: fn(Hidden) -> bool, values: Option<Tensor>| without_hidden(windows, hides, values);
        let measured = self.channels(STATE, &last, &[windows.len()])?;
        Ok(WindowBatch {
            inputs: batched(inputs(&past)?, context)?,
            input_targets: batched(targets(&past)?, context)?,
            future: future_inputs.map(|frames| batched(frames, horizon)).transpose()?,
            targets: batched(targets(&future)?, horizon)?,
            condition: ConditioningTensors {
                actions: shown(
                    |hidden| hidden == Hidden::All,
                    self.channels(ACTION, &acting, &[windows.len(), horizon])?,
                )?,
                state: shown(|hidden| hidden != Hidden::Nothing, measured.clone())?,
                past_states: shown(
                    |hidden| hidden != Hidden::Nothing,
                    self.channels(STATE, &earlier, &[windows.len(), context - 1])?,
                )?,
                cameras: self
                    .dataset
                    .cameras(windows.iter().map(|drawn| drawn.window.episode), self.camera),
            },
            future_states: self.channels(STATE, &future, &[windows.len(), horizon])?,
            measured,
            movers: self
                .masks(&span(context - 1, 1 + horizon))?
                .map(|masks| batched(masks, 1 + horizon))
                .transpose()?,
        })
    }

    /// The actions or states of frames as they are in the changed windows, `[B, channels]` or `[B, horizon, channels]`; `None`
    /// where the data set has none.
    fn channels(
        &self,
        kind: usize,
        frames: &[(usize, WindowChange)],
        shape: &[usize],
    ) -> Result<Option<Tensor>, TrainError> {
        let mut values = Vec::new();
        for &(frame, change) in frames {
            let from = values.len();
            values.extend_from_slice(if kind == ACTION {
                self.dataset.action(frame)
            } else {
                self.dataset.state(frame)
            });
            if change.is_frame_mirrored {
                self.augmentation.turn_signs(kind, &mut values[from..]);
            }
        }
        if values.is_empty() {
            return Ok(None);
        }
        let shape = [shape, &[values.len() / frames.len()]].concat();
        Ok(Some(Tensor::from_vec(values, shape, &Device::Cpu)?))
    }
}

/// Values of each window, NaN for the windows that hide them.
fn without_hidden(
    windows: &[DrawnWindow<'_>],
    hides: fn(Hidden) -> bool,
    values: Option<Tensor>,
) -> Result<Option<Tensor>, TrainError> {
    let is_hidden = |drawn: &DrawnWindow| hides(drawn.change.hidden);
    match values {
        Some(values) if windows.iter().any(is_hidden) => {
            let shape = values.shape().clone();
            let mut all = values.flatten_all()?.to_vec1::<f32>()?;
            let each = all.len() / windows.len();
            for (values, _) in all
                .chunks_exact_mut(each)
                .zip(windows)
                .filter(|(_, drawn)| is_hidden(drawn))
            {
                values.fill(f32::NAN);
            }
            Ok(Some(Tensor::from_vec(all, shape, &Device::Cpu)?))
        }
        values => Ok(values),
    }
}

fn unchanged(frames: &[usize]) -> Vec<(usize, WindowChange)> {
    frames.iter().map(|&frame| (frame, WindowChange::NONE)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::TrainConfig;
    use foreframe_core::types::{Channel, Seed};
    use foreframe_data::dataset::{DatasetInfo, EpisodeData};

    /// Four frames of one pixel. Intensity and state of frame n are n / 5.
    fn four_frames() -> Dataset {
        let info = DatasetInfo {
            frame_width_px: 1,
            frame_height_px: 1,
            frame_period_s: 0.1,
            state_channels: vec![Channel::new("place", "m")],
            ..DatasetInfo::default()
        };
        let episode = EpisodeData {
            pixels: vec![0, 51, 102, 153],
            states: vec![0.0, 0.2, 0.4, 0.6],
            timestamps_s: vec![0.0, 0.1, 0.2, 0.3],
            ..EpisodeData::default()
        };
        Dataset::from_episodes(info, vec![episode]).unwrap()
    }

    #[test]
    fn a_reversed_window_is_played_backwards() {
        let (dataset, config) = (four_frames(), TrainConfig::preset("moving-mnist").unwrap());
        let augmentation = Augmentation::new(&config.data, &dataset, &[], Seed(1)).unwrap();
        let source = FrameSource::new(&dataset, config.model.preprocess, Target::Sharp, augmentation);
        let window = Window {
            episode: 0,
            first_frame: 0,
        };
        let shape = WindowShape { context: 3, horizon: 1 };
        let played = |is_reversed| {
            let change = WindowChange {
                is_reversed,
                ..WindowChange::NONE
            };
            let drawn = DrawnWindow {
                window: &window,
                change,
            };
            let batch = source.windows(&[drawn], shape, true).unwrap();
            let tensors = [
                Some(batch.inputs),
                Some(batch.targets),
                batch.future,
                batch.condition.state,
                batch.future_states,
            ];
            tensors.map(|tensor| tensor.unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap())
        };
        let all = |inputs: &[f32], present: f32, next: f32| {
            [inputs, &[next], &[next], &[present], &[next]].map(<[f32]>::to_vec)
        };
        assert_eq!(played(false), all(&[0.0, 0.2, 0.4], 0.4, 0.6));
        assert_eq!(played(true), all(&[0.6, 0.4, 0.2], 0.2, 0.0));
    }
}
