//! The cameras of items: the ray of each pixel, and where a camera sees a point. As [`crate::nn::geometry::camera`] on plain numbers.

use candle_core::{Device, Result, Tensor};

use crate::frame::warp::{CameraModel, CameraView, MIN_DEPTH};
use crate::nn::ops::sampling::ImageSize;
use crate::nn::plain::sampling::{Places, at_least};

/// Vectors in the robot's axes: K for each of M items, each part `[M, K]`.
#[derive(Clone, Debug)]
pub(super) struct Vectors {
    pub(super) ahead: Tensor,
    pub(super) left: Tensor,
    pub(super) up: Tensor,
}

impl Vectors {
    /// Turned counter-clockwise about the vertical by each item's angle `[M, 1]`.
    pub(super) fn rotated(&self, angle: &Tensor) -> Result<Self> {
        let (sin, cos) = (angle.sin()?, angle.cos()?);
        Ok(Self {
            ahead: (self.ahead.broadcast_mul(&cos)? - self.left.broadcast_mul(&sin)?)?,
            left: (self.ahead.broadcast_mul(&sin)? + self.left.broadcast_mul(&cos)?)?,
            up: self.up.clone(),
        })
    }

    /// Made longer by a factor for each, `[M, K]`.
    pub(super) fn scaled(&self, factors: &Tensor) -> Result<Self> {
        Ok(Self {
            ahead: (&self.ahead * factors)?,
            left: (&self.left * factors)?,
            up: (&self.up * factors)?,
        })
    }

    /// Moved by so much ahead and to the left, `[M, 1]` each.
    pub(super) fn moved(&self, ahead: &Tensor, left: &Tensor) -> Result<Self> {
        Ok(Self {
            ahead: self.ahead.broadcast_add(ahead)?,
            left: self.left.broadcast_add(left)?,
            up: self.up.clone(),
        })
    }

    /// Moved up by so much, `[M, 1]`.
    pub(super) fn raised(&self, up: &Tensor) -> Result<Self> {
        Ok(Self {
            up: self.up.broadcast_add(up)?,
            ..self.clone()
        })
    }
}

/// One camera for each of M items.
pub(super) struct Cameras {
    /// Sine and cosine of the tilt, and the size of a pixel at depth 1, `[M, 1]` each.
    tilt_sin: Tensor,
    tilt_cos: Tensor,
    pixel_size: Tensor,
    size: ImageSize,
}

impl Cameras {
    pub(super) fn new(cameras: &[CameraModel], size: ImageSize, device: &Device) -> Result<Self> {
        let of_each = |value: fn(&CameraModel, ImageSize) -> f32| {
            let values: Vec<f32> = cameras.iter().map(|camera| value(camera, size)).collect();
            Tensor::from_vec(values, (cameras.len(), 1), device)
        };
        Ok(Self {
            tilt_sin: of_each(|camera, _| camera.tilt_down_rad.sin())?,
            tilt_cos: of_each(|camera, _| camera.tilt_down_rad.cos())?,
            pixel_size: of_each(|camera, size| CameraView::new(*camera, size.width, size.height).pixel_size)?,
            size,
        })
    }

    /// The ray of each pixel, 1 long along the camera's axis.
    pub(super) fn rays(&self) -> Result<Vectors> {
        let own = Places::own(self.size, self.pixel_size.device())?;
        let from_middle = |at: &Tensor, side: usize| (at - (side as f64 - 1.0) / 2.0)?.broadcast_mul(&self.pixel_size);
        let right = from_middle(&own.x, self.size.width)?;
        let down = from_middle(&own.y, self.size.height)?;
        Ok(Vectors {
            ahead: down
                .broadcast_mul(&self.tilt_sin)?
                .neg()?
                .broadcast_add(&self.tilt_cos)?,
            left: right.neg()?,
            up: down
                .broadcast_mul(&self.tilt_cos)?
                .broadcast_add(&self.tilt_sin)?
                .neg()?,
        })
    }

    /// Depths of points; of directions, how the depth changes along them.
    pub(super) fn depths(&self, points: &Vectors) -> Result<Tensor> {
        points.ahead.broadcast_mul(&self.tilt_cos)? - points.up.broadcast_mul(&self.tilt_sin)?
    }

    /// The places of points. What is not in front of the camera gets no gradient.
    pub(super) fn project(&self, points: &Vectors) -> Result<Places> {
        let depths = self.depths(points)?;
        let up = (points.ahead.broadcast_mul(&self.tilt_sin)? + points.up.broadcast_mul(&self.tilt_cos)?)?;
        let scales = at_least(&depths, MIN_DEPTH.into())?.broadcast_mul(&self.pixel_size)?;
        let middle = |side: usize| (side as f64 - 1.0) / 2.0;
        let x = (&points.left / &scales)?.affine(-1.0, middle(self.size.width))?;
        let y = (up / scales)?.affine(-1.0, middle(self.size.height))?;
        if !x.track_op() {
            return Ok(Places { x, y });
        }
        let is_in_front = depths.gt(f64::from(MIN_DEPTH))?;
        Ok(Places {
            x: is_in_front.where_cond(&x, &x.detach())?,
            y: is_in_front.where_cond(&y, &y.detach())?,
        })
    }
}
