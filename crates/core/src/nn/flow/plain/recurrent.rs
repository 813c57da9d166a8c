//! The recurrent form, as [`super::super::recurrent`] says.

use candle_core::Tensor;

use super::composition::{MovedPlaces, moved_blocks};
use super::scene::SceneItems;
use crate::nn::error::NnError;
use crate::nn::flow::blocks::BLOCK_PIXELS;
use crate::nn::flow::network::{FlowNetwork, FlowPrediction};
use crate::nn::flow::rollout_rows::RolloutRows;
use crate::nn::flow::scene::Scene;
use crate::nn::ops::compose::SCENE_FEATURES;
use crate::nn::plain::layers::{linear_per_place, pixel_shuffle, pixel_unshuffle};
use crate::nn::plain::sampling::Places;

impl FlowNetwork {
    /// The rollouts of a model that takes no actions: its camera stands. Only the first `steps` frames are computed.
    pub(super) fn plain_predict_recurrently(
        &self,
        rows: &RolloutRows,
        scene: &Scene,
        steps: usize,
    ) -> Result<FlowPrediction, NnError> {
        let (count, horizon, size) = (rows.count(), self.spec.horizon, self.spec.image_size());
        let contexts = rows.contexts(self.sizes.layers.frames_read);
        let last = self.last_frames(&contexts)?;
        let [coarse, _] = self.plain_encode(&self.encoder_inputs(&contexts, &last, scene)?, None)?;
        let once = self.ahead(rows, 1)?;
        let modulation = self.plain_modulate(rows, &once.motion)?;
        let views = SceneItems {
            states: self.scaled_states((0..count).map(|row| rows.state(row)))?,
            motion: &once.item_motion,
            poses: None,
            cameras: None,
        };
        let seen = scene.plain_seen(&self.spec, &views)?;
        let features = pixel_unshuffle(&seen.narrow(1, 0, SCENE_FEATURES)?)?;
        let content = pixel_shuffle(&super::direct::content(&seen)?)?.flatten_from(1)?;
        let own = Places::own(size, self.device())?.of_items(count)?;
        let places = MovedPlaces {
            room: own.clone(),
            turned: own,
        };
        let (mut state, mut last) = (once.of_contexts(&coarse)?, once.of_contexts(&last)?);
        let mut frames = Vec::with_capacity(steps);
        for step in 0..steps {
            let moved = moved_blocks(&last, size, &places.room)?;
            let shown = pixel_unshuffle(&moved.narrow(1, 0, BLOCK_PIXELS)?)?;
            let inputs = Tensor::cat(&[&state, &features, &shown], 1)?;
            state = (state + linear_per_place(&self.mix, &inputs)?)?;
            state = self.plain_refined(state, &modulation.narrow(1, step, 1)?.squeeze(1)?)?;
            let head = self.plain_head(&self.plain_fine(&state, [&moved, &seen], None)?)?;
            let frame = places.compose(&last, size, &head, &content)?;
            // Intensities end at black and white; what is beyond would grow from step to step.
            last = frame.detach().clamp(0f32, 1f32)?;
            frames.push(frame);
        }
        let content = content.unsqueeze(1)?.broadcast_as((count, horizon, size.pixels()))?;
        Ok(FlowPrediction {
            speeds: None,
            frames: Tensor::stack(&frames, 1)?,
            scene: Some(content.contiguous()?),
            motion: once.motion,
            movers: None,
        })
    }
}
