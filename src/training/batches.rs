//! Batches of frames and windows as tensors, and the order in which they are drawn.

use candle_core::{Device, Tensor};
use rand::seq::SliceRandom;
use rayon::prelude::*;

use super::TrainError;
use super::config::Target;
use crate::dataset::sampler::WindowShape;
use crate::dataset::{Dataset, Window};
use crate::frame::Frame;
use crate::frame::preprocess::Preprocess;
use crate::nn::ConditioningTensors;
use crate::types::Seed;

/// A data set's frames in the model's space.
pub(super) struct FrameSource<'a> {
    dataset: &'a Dataset,
    preprocess: Preprocess,
    target: Preprocess,
}

/// One batch of windows.
pub(super) struct WindowBatch {
    /// `[B, T, P]`, as the encoder reads them.
    pub(super) inputs: Tensor,
    /// `[B, T, P]`, as the reconstruction is to write them.
    pub(super) input_targets: Tensor,
    /// `[B, horizon, P]`, as the prediction is to write them.
    pub(super) targets: Tensor,
    /// `[B, horizon, P]`, the same as the encoder would read them, if asked for.
    pub(super) future: Option<Tensor>,
    /// The actions that lead to the targets, and the state at the last input.
    pub(super) condition: ConditioningTensors,
    /// The states at the targets `[B, horizon, S]`, where the data set has states.
    pub(super) future_states: Option<Tensor>,
}

impl<'a> FrameSource<'a> {
    pub(super) fn new(dataset: &'a Dataset, preprocess: Preprocess, target: Target) -> Self {
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
        }
    }

    /// The frames as the encoder reads them, `[N, P]`.
    pub(super) fn frames(&self, frames: &[usize]) -> Result<Tensor, TrainError> {
        self.through(self.preprocess, frames)
    }

    /// The frames as the decoder is to write them, `[N, P]`.
    pub(super) fn targets(&self, frames: &[usize]) -> Result<Tensor, TrainError> {
        self.through(self.target, frames)
    }

    fn through(&self, preprocess: Preprocess, frames: &[usize]) -> Result<Tensor, TrainError> {
        let info = self.dataset.info();
        let pixels = info.frame_pixels();
        let mut values = vec![0.0; frames.len() * pixels];
        values
            .par_chunks_exact_mut(pixels)
            .zip(frames)
            .try_for_each(|(out, &frame)| {
                let pixels = self.dataset.pixels(frame).to_vec();
                let frame = Frame::new(info.frame_width_px, info.frame_height_px, pixels)?;
                out.copy_from_slice(&preprocess.forward(&frame));
                Ok::<(), TrainError>(())
            })?;
        Ok(Tensor::from_vec(values, (frames.len(), pixels), &Device::Cpu)?)
    }

    /// The windows' inputs, targets and conditions. The future as the encoder would read it is made only if asked for.
    pub(super) fn windows(
        &self,
        windows: &[&Window],
        shape: WindowShape,
        with_future: bool,
    ) -> Result<WindowBatch, TrainError> {
        let (context, horizon) = (shape.context, shape.horizon);
        let span = |from: usize, length: usize| -> Vec<usize> {
            windows
                .iter()
                .flat_map(|w| w.first_frame + from..w.first_frame + from + length)
                .collect()
        };
        let (seen, to_come) = (span(0, context), span(context, horizon));
        let batched = |frames: Tensor, length: usize| frames.reshape((windows.len(), length, ()));
        Ok(WindowBatch {
            inputs: batched(self.frames(&seen)?, context)?,
            input_targets: batched(self.targets(&seen)?, context)?,
            future: with_future
                .then(|| self.frames(&to_come))
                .transpose()?
                .map(|f| batched(f, horizon))
                .transpose()?,
            targets: batched(self.targets(&to_come)?, horizon)?,
            condition: self.condition(windows, shape)?,
            future_states: self.future_states(windows, shape)?,
        })
    }

    fn future_states(&self, windows: &[&Window], shape: WindowShape) -> Result<Option<Tensor>, TrainError> {
        let states = self.dataset.info().state_channels.len();
        if states == 0 {
            return Ok(None);
        }
        let values: Vec<f32> = windows
            .iter()
            .map(|window| window.first_frame + shape.context)
            .flat_map(|first| (first..first + shape.horizon).flat_map(|frame| self.dataset.state(frame)))
            .copied()
            .collect();
        let shape = (windows.len(), shape.horizon, states);
        Ok(Some(Tensor::from_vec(values, shape, &Device::Cpu)?))
    }

    fn condition(&self, windows: &[&Window], shape: WindowShape) -> Result<ConditioningTensors, TrainError> {
        let (actions, states) = (
            self.dataset.info().action_channels.len(),
            self.dataset.info().state_channels.len(),
        );
        let last_inputs = || windows.iter().map(|window| window.first_frame + shape.context - 1);
        // The action of a frame acts from it to the next, so the first target's is that of the last input.
        let future: Vec<f32> = last_inputs()
            .flat_map(|last| (last..last + shape.horizon).flat_map(|frame| self.dataset.action(frame)))
            .copied()
            .collect();
        let present: Vec<f32> = last_inputs()
            .flat_map(|last| self.dataset.state(last))
            .copied()
            .collect();
        let tensor = |values: Vec<f32>, shape: &[usize]| Tensor::from_vec(values, shape, &Device::Cpu);
        Ok(ConditioningTensors {
            actions: (actions > 0)
                .then(|| tensor(future, &[windows.len(), shape.horizon, actions]))
                .transpose()?,
            state: (states > 0)
                .then(|| tensor(present, &[windows.len(), states]))
                .transpose()?,
        })
    }
}

/// Draws positions `0..count`, each once an epoch, in an order that depends on the seed and the draw alone, so that a
/// resumed training draws as the unbroken one would.
pub(super) struct Shuffle {
    count: usize,
    seed: Seed,
}

impl Shuffle {
    pub(super) fn new(count: usize, seed: Seed) -> Self {
        Self { count, seed }
    }

    /// The positions of batch `step`.
    pub(super) fn batch(&self, step: usize, batch_size: usize) -> Vec<usize> {
        let draws = step * batch_size..(step + 1) * batch_size;
        let mut epoch = usize::MAX;
        let mut order: Vec<usize> = Vec::new();
        draws
            .map(|draw| {
                if draw / self.count != epoch {
                    epoch = draw / self.count;
                    order = (0..self.count).collect();
                    order.shuffle(&mut self.seed.derive("epoch", epoch as u64).rng());
                }
                order[draw % self.count]
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_draws_every_position_once() {
        let shuffle = Shuffle::new(10, Seed(3));
        let mut first: Vec<usize> = (0..2).flat_map(|step| shuffle.batch(step, 5)).collect();
        first.sort_unstable();
        assert_eq!(first, (0..10).collect::<Vec<_>>());
    }

    #[test]
    fn a_batch_does_not_depend_on_those_before_it() {
        let (early, late) = (Shuffle::new(7, Seed(1)), Shuffle::new(7, Seed(1)));
        (0..9).for_each(|step| drop(early.batch(step, 4)));
        assert_eq!(early.batch(9, 4), late.batch(9, 4));
    }
}
