//! What the surroundings look like, as [`super::super::scene`] says, and how the camera moves.

use candle_core::{DType, Device, Tensor};

use super::cameras::Cameras;
use super::room::{RoomPoses, describe};
use crate::nn::error::NnError;
use crate::nn::flow::motion::{AFFINE, CORRECTION, MotionHead};
use crate::nn::flow::rollout_rows::RolloutRows;
use crate::nn::flow::scene::{MIDDLE_GRAY, PLACE_VALUES, Scene, SceneKind, place_values};
use crate::nn::ops::compose::SCENE_CHANNELS;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::plain::layers::{linear, perceptron};
use crate::nn::plain::sampling::Places;
use crate::nn::spec::ModelSpec;

/// From where a scene is seen.
pub(super) struct SceneItems<'a> {
    /// The scaled states of the views `[M, S]`; `None` where the model takes none.
    pub(super) states: Option<Tensor>,
    /// Yaw, ahead and left of each since the last frame `[M, 3]`.
    pub(super) motion: &'a Tensor,
    /// Where the camera stands, where there is a room.
    pub(super) poses: Option<RoomPoses>,
}

impl Scene {
    /// The scene at the items `[M, SCENE_CHANNELS, H/2, W/2]`.
    pub(super) fn seen_plainly(&self, spec: &ModelSpec, views: &SceneItems) -> Result<Tensor, NnError> {
        let half = spec.image_size().shrunk(2);
        let (items, blocks) = (views.motion.dim(0)?, half.pixels());
        let image = || self.learned.unsqueeze(0);
        let seen = match (self.kind, &views.poses) {
            (SceneKind::Room(_, camera), Some(poses)) => {
                let cameras = Cameras::new(&vec![camera; items], half, views.motion.device())?;
                let met = describe(poses, &cameras, &self.learned)?;
                perceptron(&self.layers, &met)?.reshape((items, blocks, SCENE_CHANNELS))?
            }
            (SceneKind::Image, _) => image()?.broadcast_as((items, blocks, SCENE_CHANNELS))?.contiguous()?,
            _ => {
                let known = known_of_places(half, views)?;
                let seen = perceptron(&self.layers, &known)?;
                seen.reshape((items, blocks, SCENE_CHANNELS))?
                    .broadcast_add(&image()?)?
            }
        };
        let seen = (seen + MIDDLE_GRAY)?.transpose(1, 2)?.contiguous()?;
        Ok(seen.reshape((items, SCENE_CHANNELS, half.height, half.width))?)
    }
}

/// Place, state and motion of each block of each item.
fn known_of_places(half: ImageSize, views: &SceneItems) -> Result<Tensor, NnError> {
    let device = views.motion.device();
    let (items, blocks) = (views.motion.dim(0)?, half.pixels());
    let of_blocks = |values: &Tensor| {
        let values = values.unsqueeze(1)?;
        values.expand((items, blocks, values.dim(2)?))?.contiguous()
    };
    let places = Tensor::from_vec(place_values(half), (1, blocks, PLACE_VALUES), device)?;
    let mut known = vec![places.expand((items, blocks, PLACE_VALUES))?.contiguous()?];
    if let Some(states) = &views.states {
        known.push(of_blocks(states)?);
    }
    known.push(of_blocks(views.motion)?);
    Ok(Tensor::cat(&known, 2)?.flatten(0, 1)?)
}

impl MotionHead {
    /// Yaw, ahead and left since the last frame `[N, horizon, 3]`; zero for a standing camera.
    pub(super) fn forward_plainly(&self, rows: &RolloutRows, device: &Device) -> Result<Tensor, NnError> {
        let shape = (rows.count(), rows.spec.horizon, 3);
        let Some(layers) = &self.layers else {
            return Ok(Tensor::zeros(shape, DType::F32, device)?);
        };
        let correction = perceptron(layers, &rows.scaled()?.to_device(device)?)?;
        Ok((self.integral(rows)?.to_device(device)? + (correction.reshape(shape)? * CORRECTION)?)?)
    }

    /// Where each pixel was by a learned affine map of the image; every pixel where it is for a standing camera.
    pub(super) fn affine_places_plainly(&self, size: ImageSize, motion: &Tensor) -> Result<Places, NnError> {
        let (items, device) = (motion.dim(0)?, motion.device());
        let own = Places::own(size, device)?;
        let Some(affine) = &self.affine else {
            return Ok(own.of_items(items)?);
        };
        let from_middle = |at: &Tensor, side: usize| at.affine(2.0 / side as f64, -1.0);
        let (column, row) = (from_middle(&own.x, size.width)?, from_middle(&own.y, size.height)?);
        let basis = Tensor::cat(&[&column, &row, &column.ones_like()?], 0)?;
        let map = (linear(affine, motion)? * AFFINE)?.reshape((items, 3, 2))?;
        let moved = |axis: usize, side: usize, own: &Tensor| -> Result<Tensor, NnError> {
            let map = map.narrow(2, axis, 1)?.squeeze(2)?.contiguous()?;
            Ok((map.matmul(&basis)? * side as f64)?.broadcast_add(own)?)
        };
        Ok(Places {
            x: moved(0, size.width, &own.x)?,
            y: moved(1, size.height, &own.y)?,
        })
    }
}
