//! What the surroundings look like, as [`super::super::scene`] says.

use candle_core::Tensor;

use super::cameras::Cameras;
use super::room::{RoomPoses, describe};
use crate::frame::warp::CameraModel;
use crate::nn::error::NnError;
use crate::nn::flow::scene::{MIDDLE_GRAY, PLACE_VALUES, Scene, SceneKind, place_values};
use crate::nn::ops::compose::SCENE_CHANNELS;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::plain::layers::perceptron;
use crate::nn::spec::ModelSpec;

/// From where a scene is seen.
pub(super) struct SceneItems<'a> {
    /// The scaled states of the views `[M, S]`; `None` where the model takes none.
    pub(super) states: Option<Tensor>,
    /// Yaw, ahead and left of each since the last frame `[M, 3]`.
    pub(super) motion: &'a Tensor,
    /// Where the camera stands, where there is a room.
    pub(super) poses: Option<RoomPoses>,
    /// The camera of each; the one by which the room was learned where they are `None`.
    pub(super) cameras: Option<Vec<CameraModel>>,
}

impl Scene {
    /// The scene at the items `[M, SCENE_CHANNELS, H/2, W/2]`.
    pub(super) fn plain_seen(&self, spec: &ModelSpec, views: &SceneItems) -> Result<Tensor, NnError> {
        let half = spec.image_size().shrunk(2);
        let (items, blocks) = (views.motion.dim(0)?, half.pixels());
        let image = || self.learned.unsqueeze(0);
        let seen = match (self.kind, &views.poses) {
            (SceneKind::Room(_, camera), Some(poses)) => {
                let own = views.cameras.clone();
                let cameras = own.unwrap_or_else(|| vec![camera; items]);
                let cameras = Cameras::new(&cameras, half, views.motion.device())?;
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
