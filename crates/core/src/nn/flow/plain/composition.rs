//! The predicted frame from its parts, as [`crate::nn::ops::compose`] says.

use candle_core::{Result, Tensor};

use crate::nn::ops::compose::{FLOW_PX, MAX_OUTSIDE_LOGIT, OUTSIDE_LOGIT, ROOM_LOGIT};
use crate::nn::ops::sampling::ImageSize;
use crate::nn::plain::layers::pixel_unshuffle;
use crate::nn::plain::sampling::{Places, at_most, sample};

/// Where each pixel was in the last frame.
pub(super) struct MovedPlaces {
    /// Before the camera turned and drove: the better guess for the room.
    pub(super) room: Places,
    /// Before the camera turned.
    pub(super) turned: Places,
}

impl MovedPlaces {
    /// The frames `[M, P]` from the items' last frames `[M, P]`, the head's values `[M, HEAD_VALUES, P]` and the content `[M, P]`.
    pub(super) fn compose(&self, frames: &Tensor, size: ImageSize, head: &Tensor, content: &Tensor) -> Result<Tensor> {
        let value = |index: usize| head.narrow(1, index, 1)?.squeeze(1);
        let (pixels, both) = (size.pixels(), self.room.joined(&self.turned)?);
        let along = |first: usize| Tensor::cat(&[value(first)?, value(first + 2)?], 1)?.affine(FLOW_PX.into(), 0.0);
        let flowed = Places {
            x: (&both.x + along(0)?)?,
            y: (&both.y + along(1)?)?,
        };
        let sampled = sample(frames, size, &flowed)?;
        let outside = both.detach().outside(size)?.affine(OUTSIDE_LOGIT.into(), 0.0)?;
        let outside = at_most(&outside, MAX_OUTSIDE_LOGIT.into())?;
        let logits = [
            ((value(4)? + f64::from(ROOM_LOGIT))? - outside.narrow(1, 0, pixels)?)?,
            (value(5)? - outside.narrow(1, pixels, pixels)?)?,
            value(6)?,
        ];
        let most = logits[0].maximum(&logits[1])?.maximum(&logits[2])?.detach();
        let [room, turned, new] = logits.map(|logit| (logit - &most)?.exp());
        let (room, turned, new) = (room?, turned?, new?);
        let sum = ((&room + &turned)? + &new)?;
        let parts = [
            (room * sampled.narrow(1, 0, pixels)?)?,
            (turned * sampled.narrow(1, pixels, pixels)?)?,
            (new * (content + value(7)?)?)?,
        ];
        let [first, second, third] = parts;
        ((first + second)? + third)? / sum
    }
}

/// The last frames `[M, P]` sampled at places, per 2×2 block: its four pixels and the share that lies inside the frame,
/// `[M, 5, H/2, W/2]`. Without gradients.
pub(super) fn moved_blocks(frames: &Tensor, size: ImageSize, places: &Places) -> Result<Tensor> {
    let places = places.detach();
    let moved = blocks(&sample(frames, size, &places)?, size)?;
    let inside = blocks(&places.inside(size, 0.0)?, size)?.mean_keepdim(1)?;
    Tensor::cat(&[moved, inside], 1)
}

/// Frames `[M, P]` as 2×2 blocks `[M, 4, H/2, W/2]`.
pub(super) fn blocks(frames: &Tensor, size: ImageSize) -> Result<Tensor> {
    pixel_unshuffle(&frames.reshape((frames.dim(0)?, 1, size.height, size.width))?)
}
