//! The form that remembers its surroundings, as [`super::super::direct`] says.

use candle_core::Tensor;

use super::ItemsAhead;
use super::cameras::Cameras;
use super::composition::{MovedPlaces, blocks, moved_blocks};
use super::depth_views::centred_places;
use super::room::{RoomPoses, places_before};
use super::scene::SceneItems;
use crate::nn::error::NnError;
use crate::nn::flow::encoder_views::EncoderViews;
use crate::nn::flow::network::{FlowNetwork, FlowPrediction};
use crate::nn::flow::rollout_rows::RolloutRows;
use crate::nn::flow::scene::{Scene, SceneKind};
use crate::nn::geometry::camera::CameraPose;
use crate::nn::geometry::state_channels::StateChannels;
use crate::nn::ops::compose::{SCENE_CHANNELS, SCENE_FEATURES};
use crate::nn::plain::layers::{pixel_shuffle, pixel_unshuffle};
use crate::nn::plain::sampling::{Places, sample, sample_features};

impl FlowNetwork {
    pub(super) fn plain_predict_directly(
        &self,
        rows: &RolloutRows,
        scene: &Scene,
        steps: usize,
    ) -> Result<FlowPrediction, NnError> {
        let size = self.spec.image_size();
        let contexts = rows.contexts(self.sizes.layers.frames_read);
        let last = self.last_frames(&contexts)?;
        let [coarse, _] = self.plain_encode(&self.encoder_inputs(&contexts, &last, scene)?, None)?;
        // The scene's own loss is of all steps.
        let computed = if self.is_trained() { self.spec.horizon } else { steps };
        let ahead = self.ahead(rows, computed)?;

        let poses: Vec<CameraPose> = ahead.row_of.iter().map(|&row| rows.pose(row)).collect();
        let before = self.room_poses(scene, &poses)?;
        let after = moved_poses(scene, before.as_ref(), &ahead.item_motion.detach())?;
        let places = self.plain_places(scene, &ahead, before.as_ref().zip(after.as_ref()))?;
        let states = ahead.row_of.iter().map(|&row| rows.state(row));
        let views = SceneItems {
            states: self.scaled_states(states)?,
            motion: &ahead.item_motion,
            poses: after,
            cameras: None,
        };
        let seen = scene.plain_seen(&self.spec, &views)?;
        let coarse_places = self.plain_coarse_places(&ahead, &places)?;
        let warped = sample_features(&ahead.of_contexts(&coarse)?, &coarse_places)?;
        let features = pixel_unshuffle(&seen.narrow(1, 0, SCENE_FEATURES)?)?;
        let state = self.plain_state(&Tensor::cat(&[&warped, &features], 1)?, &ahead.modulation)?;
        let last = ahead.of_contexts(&last)?;
        let moved = moved_blocks(&last, size, &places.room)?;
        let head = self.plain_head(&self.plain_fine(&state, [&moved, &seen], None)?)?;
        let content = pixel_shuffle(&content(&seen)?)?.flatten_from(1)?;
        let frames = places.compose(&last, size, &head, &content)?;
        Ok(FlowPrediction {
            speeds: None,
            frames: ahead.in_rows(&frames)?.narrow(1, 0, steps)?.contiguous()?,
            scene: Some(ahead.in_rows(&content)?),
            motion: ahead.motion,
            movers: None,
        })
    }

    /// The last frames `[contexts, P]`.
    pub(super) fn last_frames(&self, contexts: &EncoderViews) -> Result<Tensor, NnError> {
        let shape = (contexts.count(), self.spec.pixels());
        Ok(Tensor::from_slice(&contexts.last_frames, shape, self.device())?)
    }

    /// The inputs of the encoder `[contexts, channels, H/2, W/2]`: blocks of the last frames, of the earlier ones turned into the last
    /// one's view by the measured yaw rate, and of the scene without movers; and the place in the frame.
    pub(super) fn encoder_inputs(
        &self,
        contexts: &EncoderViews,
        last: &Tensor,
        scene: &Scene,
    ) -> Result<Tensor, NnError> {
        let (size, device) = (self.spec.image_size(), self.device());
        let (count, pixels, earlier) = (contexts.count(), size.pixels(), contexts.frames_read - 1);
        let mut inputs = vec![blocks(last, size)?];
        if earlier > 0 {
            let frames = Tensor::from_slice(&contexts.earlier, (count * earlier, pixels), device)?;
            let channels = StateChannels::of(&self.spec);
            let rates = contexts.states.iter().map(|state| channels.yaw_rate_in(state));
            let rates = rates.collect::<Option<Vec<f32>>>().zip(self.sizes.camera);
            let seen = match rates {
                Some((rates, camera)) => {
                    let period = self.spec.frame_period_s as f32;
                    let yaws = rates
                        .iter()
                        .flat_map(|rate| (1..=earlier).map(move |back| rate * period * back as f32));
                    let yaws = Tensor::from_iter(yaws, device)?.unsqueeze(1)?;
                    let cameras = Cameras::new(&vec![camera; count * earlier], size, device)?;
                    sample(&frames, size, &cameras.project(&cameras.rays()?.rotated(&yaws)?)?)?
                }
                None => frames,
            };
            let half = size.shrunk(2);
            inputs.push(blocks(&seen, size)?.reshape((count, 4 * earlier, half.height, half.width))?);
        }
        let views = SceneItems {
            states: self.scaled_states(contexts.states.iter().map(Vec::as_slice))?,
            motion: &Tensor::zeros((count, 3), candle_core::DType::F32, device)?,
            poses: self.room_poses(scene, &contexts.poses)?,
            cameras: None,
        };
        inputs.push(content(&scene.plain_seen(&self.spec, &views)?)?.detach());
        inputs.push(centred_places(size.shrunk(2), count, device)?);
        Ok(Tensor::cat(&inputs, 1)?)
    }

    /// The states `[M, S]`, scaled; `None` where the model takes none.
    pub(super) fn scaled_states<'s>(&self, states: impl Iterator<Item = &'s [f32]>) -> Result<Option<Tensor>, NnError> {
        let rows: Vec<Vec<f32>> = states.map(|state| self.spec.scaled_state(state)).collect();
        let shape = (rows.len(), rows.first().map_or(0, Vec::len));
        let is_given = shape.1 > 0;
        let states = is_given.then(|| Tensor::from_vec(rows.concat(), shape, self.device()));
        Ok(states.transpose()?)
    }

    /// The poses, where there is a room.
    fn room_poses(&self, scene: &Scene, poses: &[CameraPose]) -> Result<Option<RoomPoses>, NnError> {
        let SceneKind::Room(scale, _) = scene.kind else {
            return Ok(None);
        };
        Ok(Some(RoomPoses::of(scale, poses, self.device())?))
    }

    /// Where each item's pixels were in the last frame.
    fn plain_places(
        &self,
        scene: &Scene,
        ahead: &ItemsAhead,
        poses: Option<(&RoomPoses, &RoomPoses)>,
    ) -> Result<MovedPlaces, NnError> {
        let (size, motion) = (self.spec.image_size(), &ahead.item_motion);
        let Some(camera) = self.sizes.camera.filter(|_| self.motion.is_moving()) else {
            let turned = self.motion.plain_affine_places(size, motion)?;
            return Ok(MovedPlaces {
                room: turned.clone(),
                turned,
            });
        };
        let cameras = Cameras::new(&vec![camera; motion.dim(0)?], size, self.device())?;
        let turned = cameras.project(&cameras.rays()?.rotated(&motion.narrow(1, 0, 1)?)?)?;
        let room = match poses {
            Some((before, after)) => places_before([before, after], &cameras, &scene.learned)?,
            None => Places::clone(&turned),
        };
        Ok(MovedPlaces { room, turned })
    }

    /// The places before the turn on the grid of a quarter of the sides, without gradients.
    fn plain_coarse_places(&self, ahead: &ItemsAhead, places: &MovedPlaces) -> Result<Places, NnError> {
        let size = self.spec.image_size();
        let motion = ahead.item_motion.detach();
        let Some(camera) = self.sizes.camera.filter(|_| self.motion.is_moving()) else {
            return Ok(places.turned.detach().coarse(size)?);
        };
        let cameras = Cameras::new(&vec![camera; motion.dim(0)?], size.shrunk(4), self.device())?;
        Ok(cameras.project(&cameras.rays()?.rotated(&motion.narrow(1, 0, 1)?)?)?)
    }
}

/// The content of a scene `[M, SCENE_CHANNELS, H/2, W/2]`, `[M, 4, H/2, W/2]`.
pub(super) fn content(scene: &Tensor) -> Result<Tensor, NnError> {
    Ok(scene.narrow(1, SCENE_FEATURES, SCENE_CHANNELS - SCENE_FEATURES)?)
}

/// The poses after the motions, where there is a room.
fn moved_poses(scene: &Scene, before: Option<&RoomPoses>, motions: &Tensor) -> Result<Option<RoomPoses>, NnError> {
    match (scene.kind, before) {
        (SceneKind::Room(scale, _), Some(before)) => Ok(Some(before.moved(motions, scale.unit)?)),
        _ => Ok(None),
    }
}
