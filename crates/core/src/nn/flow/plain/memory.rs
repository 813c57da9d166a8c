//! The memory of one room, as [`super::super::memory`] says.

use candle_core::{DType, Device, Result as TensorResult, Tensor};

use super::ItemsAhead;
use super::depth_views::SeenViews;
use super::direct::content;
use super::room::RoomPoses;
use super::scene::SceneItems;
use crate::frame::warp::CameraModel;
use crate::nn::error::NnError;
use crate::nn::flow::encoder_views::EncoderViews;
use crate::nn::flow::memory::{Memory, Recalled, known_poses, mixed};
use crate::nn::flow::rollout_rows::RolloutRows;
use crate::nn::flow::room_geometry::above;
use crate::nn::flow::scene::SceneKind;
use crate::nn::geometry::camera::CameraPose;
use crate::nn::ops::compose::SCENE_FEATURES;
use crate::nn::plain::convolution::convolution;
use crate::nn::plain::layers::pixel_shuffle;

impl Memory {
    /// What the encoder's first layer adds for these contexts, `[contexts, …, H/2, W/2]`.
    pub(super) fn plain_now(&self, contexts: &EncoderViews, views: &SeenViews) -> Result<Tensor, NnError> {
        let (mut poses, device) = (contexts.poses.clone(), views.mean.device());
        let is_known = as_column(&known_poses(&mut poses), device)?;
        let cameras = self.cameras(contexts.cameras.iter().copied());
        let items = SceneItems {
            states: None,
            motion: &Tensor::zeros((poses.len(), 3), DType::F32, device)?,
            poses: self.poses(&poses, &cameras, device)?,
            cameras: Some(cameras),
        };
        let content = content(&self.scene.plain_seen(contexts.spec, &items)?)?.detach();
        let added = convolution(&self.seen, &counted(&content, &views.mean, &views.spread)?)?;
        Ok(added.broadcast_mul(&over_places(&is_known)?)?)
    }

    /// The room at the items.
    pub(super) fn plain_recall(
        &self,
        rows: &RolloutRows,
        ahead: &ItemsAhead,
        views: &SeenViews,
    ) -> Result<Recalled, NnError> {
        let mut poses: Vec<CameraPose> = ahead.row_of.iter().map(|&row| rows.pose(row)).collect();
        let device = views.mean.device();
        let is_known = as_column(&known_poses(&mut poses), device)?;
        let cameras = self.cameras(ahead.row_of.iter().map(|&row| rows.camera(row)));
        let before = self.poses(&poses, &cameras, device)?;
        let after = match (self.scene.kind, before) {
            (SceneKind::Room(scale, _), Some(before)) => Some(before.moved(&ahead.item_motion.detach(), scale.unit)?),
            _ => None,
        };
        let items = SceneItems {
            states: None,
            motion: &ahead.item_motion,
            poses: after,
            cameras: Some(cameras),
        };
        let scene = self.scene.plain_seen(rows.spec, &items)?;
        let [mean, spread] = [ahead.of_contexts(&views.mean)?, ahead.of_contexts(&views.spread)?];
        let content = content(&scene)?;
        let counted_content = counted(&content, &mean, &spread)?;
        let read = Tensor::cat(&[&scene.narrow(1, 0, SCENE_FEATURES)?, &counted_content], 1)?;
        let fine = convolution(&self.fine, &read)?;
        Ok(Recalled {
            content: pixel_shuffle(&counted_content)?.flatten_from(1)?,
            intensities: pixel_shuffle(&content)?.flatten_from(1)?,
            fine: fine.broadcast_mul(&over_places(&is_known)?)?,
            is_known,
        })
    }

    /// The frames `[M, P]` with what is remembered mixed in.
    pub(super) fn plain_mix(&self, frames: &Tensor, fine: &Tensor, recalled: &Recalled) -> Result<Tensor, NnError> {
        let logits = pixel_shuffle(&convolution(&self.share, &fine.silu()?)?)?.flatten_from(1)?;
        Ok(mixed(frames, &logits, &recalled.content, &recalled.is_known)?)
    }

    fn poses(&self, poses: &[CameraPose], cameras: &[CameraModel], device: &Device) -> TensorResult<Option<RoomPoses>> {
        let SceneKind::Room(scale, learned_by) = self.scene.kind else {
            return Ok(None);
        };
        let above = cameras.iter().map(|&camera| above(camera, learned_by)).collect();
        let poses = RoomPoses::of(scale, poses, device)?;
        poses.raised(above, scale.unit).map(Some)
    }

    /// The cameras, those by which the room was learned where they are not known.
    fn cameras(&self, known: impl Iterator<Item = Option<CameraModel>>) -> Vec<CameraModel> {
        let SceneKind::Room(_, learned_by) = self.scene.kind else {
            return Vec::new();
        };
        known.map(|camera| camera.unwrap_or(learned_by)).collect()
    }
}

fn as_column(values: &[f32], device: &Device) -> TensorResult<Tensor> {
    Tensor::from_slice(values, (values.len(), 1), device)
}

/// `[M, 1]` for images `[M, …, H, W]`.
fn over_places(values: &Tensor) -> TensorResult<Tensor> {
    values.unsqueeze(2)?.unsqueeze(3)
}

/// Intensities of blocks `[M, 4, H/2, W/2]`, counted from the mean in the spread of the last frames `[M, 1]`.
fn counted(blocks: &Tensor, mean: &Tensor, spread: &Tensor) -> TensorResult<Tensor> {
    blocks
        .broadcast_sub(&over_places(mean)?)?
        .broadcast_div(&over_places(spread)?)
}
