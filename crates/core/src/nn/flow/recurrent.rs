//! The recurrent form of the flow network: each step advances the state of the step before it, and moves the pixels of the
//! frame that was predicted last. All steps share their weights, and each moves pixels only as far as they go in one step.
//! No gradients go through the predicted frames, only through the state.

use candle_core::{DType, Device, Tensor};

use super::blocks::{MOVED_CHANNELS, fold_pixels, sampled_blocks};
use super::network::{FlowNetwork, FlowPrediction};
use super::rollout_rows::RolloutRows;
use crate::nn::error::NnError;
use crate::nn::geometry::camera::CameraPose;
use crate::nn::ops::compose::{Composition, SCENE_CHANNELS, SCENE_FEATURES};
use crate::nn::ops::pixel_shuffle::pixel_unshuffle;
use crate::nn::ops::sampling::{own_places, sample_features};
use crate::nn::spec::ModelSpec;
use crate::nn::tensors::with_values;

/// Of the blocks to move, the channels that hold pixels; the last one says how much of a block is inside the frame.
const BLOCK_PIXELS: usize = MOVED_CHANNELS - 1;

impl FlowNetwork {
    /// The rollouts of a model that takes no actions: its camera stands. Only the first `steps` frames are computed.
    pub(super) fn predict_recurrently(
        &self,
        spec: &ModelSpec,
        rows: &RolloutRows,
        steps: usize,
    ) -> Result<FlowPrediction, NnError> {
        let (count, horizon, size) = (rows.count(), spec.horizon, spec.image_size());
        let (half, quarter) = (size.shrunk(2), size.shrunk(4));
        let motion = Tensor::zeros((count, horizon, 3), DType::F32, &Device::Cpu)?;
        let contexts = rows.contexts(spec, self.sizes.layers.frames_read);
        let coarse = self.encode(spec, &contexts)?;
        let mut state = sample_features(&coarse, own_places(quarter).repeat(count), &contexts.row_of)?;

        let poses = vec![CameraPose::default(); count];
        let scene = self.scene.forward(spec, rows, &motion, &poses)?;
        let features = pixel_unshuffle(&scene.narrow(3, 0, SCENE_FEATURES)?.contiguous()?)?;
        let modulation = self.modulate(spec, rows, &motion)?.reshape((count, horizon, ()))?;
        let own = own_places(size).repeat(count);
        let places = Tensor::from_vec(own.clone(), (count, size.pixels(), 2), &Device::Cpu)?;
        let each: Vec<u32> = (0..count as u32).collect();
        let mut last_frames: Vec<f32> = contexts
            .row_of
            .iter()
            .flat_map(|&row| &contexts.last_frames[row as usize * size.pixels()..(row as usize + 1) * size.pixels()])
            .copied()
            .collect();
        let mut frames = Vec::with_capacity(steps);
        for step in 0..steps {
            let moved = sampled_blocks(&last_frames, &each, &own, size);
            let moved = Tensor::from_vec(moved, (count, half.height, half.width, MOVED_CHANNELS), &Device::Cpu)?;
            let seen = pixel_unshuffle(&moved.narrow(3, 0, BLOCK_PIXELS)?.contiguous()?)?;
            let inputs = Tensor::cat(&[&state, &features, &seen], 3)?;
            state = (state + Self::per_place(&self.mix, &inputs, quarter)?)?;
            state = self.refined(state, &modulation.narrow(1, step, 1)?.squeeze(1)?)?;
            let head = self.head(&state, &moved, &scene, quarter)?;
            let composition = Composition {
                size,
                frames: last_frames,
                frame_of: each.clone(),
                room_places: None,
            };
            let frame = composition.compose(&head, &scene, &places)?;
            // Intensities end at black and white; what is beyond would grow from step to step.
            let clamped = |values: &[f32]| values.iter().map(|value| value.clamp(0.0, 1.0)).collect();
            last_frames = with_values(&frame.detach(), clamped)?;
            frames.push(frame);
        }
        let content = fold_pixels(&scene.narrow(3, SCENE_FEATURES, SCENE_CHANNELS - SCENE_FEATURES)?)?;
        let shape = (count, horizon, size.pixels());
        Ok(FlowPrediction {
            frames: Tensor::stack(&frames, 1)?,
            scene: content.unsqueeze(1)?.broadcast_as(shape)?.contiguous()?,
            motion,
        })
    }
}
