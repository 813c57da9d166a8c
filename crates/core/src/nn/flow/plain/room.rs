//! What rays meet in the learned room, as [`super::super::room_geometry`] says.

use candle_core::{DType, Device, Result, Tensor};

use super::cameras::{Cameras, Vectors};
use crate::nn::flow::ray_description::{LOWEST, OCTAVES};
use crate::nn::flow::room_geometry::{FIRST_SIDES, MIN_DISTANCE, RoomScale, SIDE_GAIN};
use crate::nn::geometry::camera::CameraPose;
use crate::nn::plain::sampling::{Places, at_least};

/// Where views of a room are taken from, `[M, 1]` each; places in units of the room.
pub(super) struct RoomPoses {
    x: Tensor,
    y: Tensor,
    /// Above the height from which the room was learned.
    z: Tensor,
    heading: Tensor,
}

impl RoomPoses {
    /// Of cameras at the height from which the room was learned.
    pub(super) fn of(scale: RoomScale, poses: &[CameraPose], device: &Device) -> Result<Self> {
        let RoomScale { middle, unit } = scale;
        let part = |value: &dyn Fn(&CameraPose) -> f32| {
            Tensor::from_vec(poses.iter().map(value).collect::<Vec<f32>>(), (poses.len(), 1), device)
        };
        Ok(Self {
            x: part(&|pose| (pose.x - middle[0]) / unit)?,
            y: part(&|pose| (pose.y - middle[1]) / unit)?,
            z: part(&|_| 0.0)?,
            heading: part(&|pose| pose.heading)?,
        })
    }

    /// So far above that height, in metres.
    pub(super) fn raised(self, above: Vec<f32>, unit: f32) -> Result<Self> {
        let above = Tensor::from_vec(above, self.z.shape(), self.z.device())?;
        Ok(Self {
            z: (above / f64::from(unit))?,
            ..self
        })
    }

    /// After driving and turning by motions `[M, 3]` (in radians and metres).
    pub(super) fn moved(&self, motions: &Tensor, unit: f32) -> Result<Self> {
        let part = |index: usize| motions.narrow(1, index, 1);
        let lengths = |index: usize| part(index)? * (1.0 / f64::from(unit));
        let (ahead, left) = (lengths(1)?, lengths(2)?);
        let (sin, cos) = (self.heading.sin()?, self.heading.cos()?);
        Ok(Self {
            x: ((&self.x + (&cos * &ahead)?)? - (&sin * &left)?)?,
            y: ((&self.y + (sin * ahead)?)? + (cos * left)?)?,
            z: self.z.clone(),
            heading: (&self.heading + part(0)?)?,
        })
    }
}

/// What rays meet.
struct RayHits {
    /// The points, in units of the room.
    points: Vectors,
    /// Directions of the rays.
    directions: Vectors,
    /// In lengths of the directions, `[M, K]`.
    times: Tensor,
    /// 1 for the side that is met, low and high of each axis, else 0.
    sides: Vec<Tensor>,
}

impl RayHits {
    /// `parameter` `[6]` moves the sides.
    fn new(poses: &RoomPoses, rays: &Vectors, parameter: &Tensor) -> Result<Self> {
        let directions = rays.rotated(&poses.heading)?;
        let first = Tensor::new(&FIRST_SIDES, parameter.device())?;
        let sides = (first + (parameter * f64::from(SIDE_GAIN))?)?;
        let side = |index: usize| sides.narrow(0, index, 1)?.reshape((1, 1));
        let (mut times, mut highs) = (Vec::new(), Vec::new());
        let axes = [
            (&directions.ahead, &poses.x),
            (&directions.left, &poses.y),
            (&directions.up, &poses.z),
        ];
        for (axis, (speed, origin)) in axes.into_iter().enumerate() {
            let high = speed.gt(0.0)?.to_dtype(DType::F32)?;
            let (low_side, high_side) = (side(2 * axis)?, side(2 * axis + 1)?);
            let side = high
                .broadcast_mul(&(high_side - &low_side)?)?
                .broadcast_add(&low_side)?;
            let is_still = speed.abs()?.lt(1e-6)?;
            let speed = is_still.where_cond(&(speed.ones_like()? * 1e-6)?, speed)?;
            times.push((side.broadcast_sub(origin)? / speed)?);
            highs.push(high);
        }
        let least = times[0].minimum(&times[1])?.minimum(&times[2])?;
        let mut met = Vec::new();
        let mut is_left = least.ones_like()?;
        for (time, high) in times.iter().zip(&highs) {
            // Of equal times, the first axis.
            let hit = (time.eq(&least)?.to_dtype(DType::F32)? * &is_left)?;
            is_left = (&is_left - &hit)?;
            let far = (&hit * high)?;
            met.push((hit - &far)?);
            met.push(far);
        }
        let times = at_least(&least, MIN_DISTANCE.into())?;
        Ok(Self {
            points: directions.scaled(&times)?.moved(&poses.x, &poses.y)?.raised(&poses.z)?,
            directions,
            times,
            sides: met,
        })
    }
}

/// What each ray of each view meets, described by `RAY_VALUES` numbers: `[M · K, RAY_VALUES]`. Gradients go to the sides.
pub(super) fn describe(poses: &RoomPoses, cameras: &Cameras, parameter: &Tensor) -> Result<Tensor> {
    let RayHits {
        points,
        directions,
        times,
        sides,
    } = RayHits::new(poses, &cameras.rays()?, parameter)?;
    let mut values = Vec::new();
    for axis in [&points.ahead, &points.left, &points.up] {
        for octave in 0..OCTAVES {
            let angle = (axis * (f64::from(LOWEST) * f64::from(1 << octave)))?;
            values.extend([angle.sin()?, angle.cos()?]);
        }
    }
    values.extend(sides);
    let squares = (directions.ahead.sqr()? + directions.left.sqr()?)?;
    let level = at_least(&squares.sqrt()?, 1e-6)?;
    let length = (level.sqr()? + directions.up.sqr()?)?.sqrt()?;
    let distance = (times * length)?;
    let (x, y) = ((&directions.ahead / &level)?, (&directions.left / &level)?);
    let line = (y.broadcast_mul(&poses.x)? - x.broadcast_mul(&poses.y)?)?;
    let of_rays = |value: &Tensor| value.broadcast_as(line.shape())?.contiguous();
    values.extend([
        points.ahead,
        points.left,
        points.up,
        of_rays(&poses.x)?,
        of_rays(&poses.y)?,
    ]);
    values.extend([x, y, (&directions.up / &level)?, line]);
    values.extend([
        (&distance * 0.25)?,
        (distance.sqr()? * 0.05)?,
        (distance + 0.3)?.recip()?,
    ]);
    Tensor::stack(&values, 2)?.flatten(0, 1)
}

/// Where the views' pixels were seen from the poses before. Without gradients.
pub(super) fn places_before([before, poses]: [&RoomPoses; 2], cameras: &Cameras, parameter: &Tensor) -> Result<Places> {
    let met = RayHits::new(poses, &cameras.rays()?, &parameter.detach())?;
    let relative = met.points.moved(&before.x.neg()?, &before.y.neg()?)?;
    let relative = relative.raised(&before.z.neg()?)?;
    cameras.project(&relative.rotated(&before.heading.neg()?)?)
}
