//! The recurrent form of the flow network: each step advances the state of the step before it, and moves the pixels of the
//! frame that was predicted last. All steps share their weights, and each moves pixels only as far as they go in one step.
//! No gradients go through the predicted frames, only through the state.

use candle_core::{DType, Device, Tensor};

use super::blocks::{BLOCK_PIXELS, content_frames, sampled_blocks};
use super::network::{FlowNetwork, FlowPrediction};
use super::rollout_rows::RolloutRows;
use super::scene::Scene;
use crate::nn::error::NnError;
use crate::nn::geometry::camera::CameraPose;
use crate::nn::ops::compose::{Composition, RoomPlaces, SCENE_FEATURES};
use crate::nn::ops::joining::joined;
use crate::nn::ops::linear::per_place;
use crate::nn::ops::pixel_shuffle::pixel_unshuffle;
use crate::nn::ops::sampling::{PixelPlaces, own_places, sample_features};
use crate::nn::tensors::with_values;

impl FlowNetwork {
    /// The rollouts of a model that takes no actions: its camera stands. Only the first `steps` frames are computed.
    pub(super) fn predict_recurrently(
        &self,
        rows: &RolloutRows,
        steps: usize,
        scene: &Scene,
    ) -> Result<FlowPrediction, NnError> {
        let (count, horizon, size) = (rows.count(), self.spec.horizon, self.spec.image_size());
        let motion = Tensor::zeros((count, horizon, 3), DType::F32, &Device::Cpu)?;
        let contexts = rows.contexts(self.sizes.layers.frames_read);
        let inputs = contexts.inputs(self.sizes.camera, &scene.content_now(&contexts)?);
        let [coarse, _] = self.encode(contexts.count(), inputs, None)?;
        let own_coarse = own_places(size.shrunk(4)).repeat(count);
        let context_of = rows.context_of();
        let mut state = sample_features(&coarse, own_coarse, &context_of)?;

        let poses = vec![CameraPose::default(); count];
        let scene = scene.forward(
            rows,
            &(0..count).collect::<Vec<_>>(),
            &motion.narrow(1, 0, 1)?.squeeze(1)?,
            &poses,
        )?;
        let features = pixel_unshuffle(&scene.narrow(3, 0, SCENE_FEATURES)?)?;
        let modulation = self.modulate(rows, &motion)?.reshape((count, horizon, ()))?;
        let own = own_places(size).repeat(count);
        let places = Tensor::from_slice(&own, (count, size.pixels(), 2), &Device::Cpu)?;
        let each: Vec<u32> = (0..count as u32).collect();
        let mut last_frames = Vec::with_capacity(count * size.pixels());
        for &context in &context_of {
            last_frames.extend_from_slice(&contexts.last_frames[context as usize * size.pixels()..][..size.pixels()]);
        }
        let mut frames = Vec::with_capacity(steps);
        for step in 0..steps {
            let items = own.chunks_exact(2 * size.pixels()).map(PixelPlaces::Pairs);
            let moved = sampled_blocks(&last_frames, &each, items, size)?;
            let seen = pixel_unshuffle(&moved.narrow(3, 0, BLOCK_PIXELS)?)?;
            let inputs = joined([&state, &features, &seen])?;
            state = (state + per_place(&self.mix, &inputs)?)?;
            state = self.refined(state, &modulation.narrow(1, step, 1)?.squeeze(1)?)?;
            let head = self.head(&self.fine(&state, [&moved, &scene], None)?)?;
            let composition = Composition {
                size,
                frames: last_frames,
                frame_of: each.clone(),
                room: RoomPlaces::Turned,
            };
            let frame = composition.compose(&head, &scene, &places)?;
            // Intensities end at black and white; what is beyond would grow from step to step.
            let clamped = |values: &[f32]| values.iter().map(|value| value.clamp(0.0, 1.0)).collect();
            last_frames = with_values(&frame.detach(), clamped)?;
            frames.push(frame);
        }
        let content = content_frames(&scene)?.unsqueeze(1)?;
        Ok(FlowPrediction {
            speeds: None,
            frames: Tensor::stack(&frames, 1)?,
            scene: Some(content.broadcast_as((count, horizon, size.pixels()))?.contiguous()?),
            motion,
            movers: None,
        })
    }
}
