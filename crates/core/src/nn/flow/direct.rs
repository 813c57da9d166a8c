//! The direct form of the flow network: every step starts from the last true frame, so no step needs another one.

use candle_core::{Device, Tensor};

use super::blocks::{coarse_places, content_frames, sampled_blocks};
use super::network::FlowNetwork;
use super::rollout_rows::RolloutRows;
use super::scene::Scene;
use super::steps_ahead::{PredictedAhead, StepsAhead};
use crate::nn::error::NnError;
use crate::nn::geometry::camera::{CameraPose, Viewer};
use crate::nn::geometry::turning::{turned, turning_places};
use crate::nn::ops::compose::{Composition, RoomPlaces, SCENE_FEATURES};
use crate::nn::ops::joining::joined;
use crate::nn::ops::linear::per_place;
use crate::nn::ops::pixel_shuffle::pixel_unshuffle;
use crate::nn::ops::sampling::{PixelPlaces, own_places, sample_features};
use crate::nn::tensors::with_values;

/// What the network sees of contexts, for all rollouts that follow them.
pub(super) struct SeenContexts {
    /// The encoder's features.
    coarse: Tensor,
    /// The last frames `[contexts, P]`.
    last_frames: Vec<f32>,
}

impl FlowNetwork {
    /// Encodes the contexts of the rollouts.
    pub(super) fn see(&self, rows: &RolloutRows, scene: &Scene) -> Result<SeenContexts, NnError> {
        let contexts = rows.contexts(self.sizes.layers.frames_read);
        let inputs = contexts.inputs(self.sizes.camera, &scene.content_now(&contexts)?);
        let [coarse, _] = self.encode(contexts.count(), inputs, None)?;
        Ok(SeenContexts {
            coarse,
            last_frames: contexts.last_frames,
        })
    }

    /// The frames of these steps.
    pub(super) fn predict_directly(
        &self,
        ahead: &StepsAhead,
        scene: &Scene,
        seen: &SeenContexts,
    ) -> Result<PredictedAhead, NnError> {
        let size = self.spec.image_size();
        let shape = (ahead.rows.count(), ahead.steps(), size.pixels());
        let motion = ahead.motion()?;
        let [before, poses] = ahead.poses()?;
        let geometry = self.places(&motion, &poses, &before, scene)?;
        let scene = scene.forward(ahead.rows, &ahead.row_of(), &motion, &poses)?;
        let context_of = ahead.context_of();
        let warped = sample_features(&seen.coarse, geometry.coarse, &context_of)?;
        let blocks_at = |places: &[f32]| {
            let items = places.chunks_exact(2 * size.pixels()).map(PixelPlaces::Pairs);
            sampled_blocks(&seen.last_frames, &context_of, items, size)
        };
        let moved = match &geometry.room {
            Some(places) => blocks_at(places)?,
            None => with_values(&geometry.turned, blocks_at)??,
        };
        let features = scene.narrow(3, 0, SCENE_FEATURES)?;
        let mixed = joined([&warped, &pixel_unshuffle(&features)?])?;
        let state = self.refined(per_place(&self.mix, &mixed)?, &ahead.modulation()?)?;
        let fine = self.fine(&state, [&moved, &scene], None)?;
        let head = self.head(&fine)?;

        let composition = Composition {
            size,
            frames: seen.last_frames.clone(),
            frame_of: context_of,
            room: geometry.room.map_or(RoomPlaces::Turned, RoomPlaces::Known),
        };
        let frames = composition.compose(&head, &scene, &geometry.turned)?;
        let content = || Ok::<_, NnError>(content_frames(&scene)?.reshape(shape)?);
        let content = (!ahead.rows.only_frames).then(content).transpose()?;
        drop(features);
        self.recycle([&warped, &mixed, &moved, &scene, &state, &fine, &head])?;
        Ok(PredictedAhead {
            frames: frames.reshape(shape)?,
            scene: content,
            movers: None,
        })
    }

    /// Where each item's pixels were in the last frame.
    fn places(
        &self,
        motion: &Tensor,
        poses: &[CameraPose],
        before: &[CameraPose],
        scene: &Scene,
    ) -> Result<ItemPlaces, NnError> {
        let size = self.spec.image_size();
        let Some(camera) = self.sizes.camera.filter(|_| self.motion.is_moving()) else {
            return self.places_without_camera(motion);
        };
        let viewer = Viewer::new(camera, size);
        let yaw = motion.narrow(1, 0, 1)?.flatten_all()?;
        Ok(ItemPlaces {
            turned: turning_places(viewer, &yaw)?,
            coarse: with_values(&yaw, |yaw| turned(Viewer::new(camera, size.shrunk(4)), yaw))?,
            room: scene.room_places(viewer, poses, before)?,
        })
    }

    /// As [`FlowNetwork::places`] where nothing is known of the camera: an affine map of the image learned from the motion,
    /// or every pixel where it is.
    fn places_without_camera(&self, motion: &Tensor) -> Result<ItemPlaces, NnError> {
        let size = self.spec.image_size();
        let items = motion.dim(0)?;
        let own = Tensor::from_vec(own_places(size), (1, size.pixels(), 2), &Device::Cpu)?;
        let turned = match self.motion.affine_places(size, motion, &own)? {
            Some(places) => places,
            None => own.broadcast_as((items, size.pixels(), 2))?.contiguous()?,
        };
        let coarse = with_values(&turned, |places| {
            let items = places.chunks_exact(2 * size.pixels());
            items
                .flat_map(|places| coarse_places(PixelPlaces::Pairs(places), size))
                .collect()
        })?;
        Ok(ItemPlaces {
            turned,
            coarse,
            room: None,
        })
    }
}

/// Where each item's pixels were in the last frame, columns and rows.
struct ItemPlaces {
    /// Before the camera turned, `[M, P, 2]`; gradients go to the motion.
    turned: Tensor,
    /// The same on the grid of a quarter of the sides.
    coarse: Vec<f32>,
    /// Before the camera turned and drove, for pixels of the room: the better guess, where there is one.
    room: Option<Vec<f32>>,
}
