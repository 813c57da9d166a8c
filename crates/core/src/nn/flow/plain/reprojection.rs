//! Where a camera that turned and drove saw each of its pixels before, as [`super::super::reprojection`] says.

use candle_core::{Result, Tensor};

use super::cameras::{Cameras, Vectors};
use super::composition::MovedPlaces;
use crate::frame::warp::MIN_DEPTH;
use crate::nn::flow::reprojection::{CORRECTION, MIN_DEEPENING, ROUNDS};
use crate::nn::ops::sampling::ImageSize;
use crate::nn::plain::sampling::{at_least, at_most, sample, sample_tracked};

/// The places of the items' pixels, and their depths `[M, P]` in the new view (without gradients).
pub(super) struct Reprojected {
    pub(super) places: MovedPlaces,
    pub(super) depths: Tensor,
}

/// How items move: `[M, 1]` each.
struct Moves {
    yaw: Tensor,
    ahead: Tensor,
    left: Tensor,
}

impl Moves {
    fn of(motion: &Tensor) -> Result<Self> {
        Ok(Self {
            yaw: motion.narrow(1, 0, 1)?,
            ahead: motion.narrow(1, 1, 1)?,
            left: motion.narrow(1, 2, 1)?,
        })
    }

    fn points(&self, directions: &Vectors, depths: &Tensor) -> Result<Vectors> {
        directions.scaled(depths)?.moved(&self.ahead, &self.left)
    }
}

/// The places after the motions `[M, 3]`, from the depths in the items' old views `[M, P]`. Gradients go to both.
pub(super) fn reproject(cameras: &Cameras, size: ImageSize, depths: &Tensor, motion: &Tensor) -> Result<Reprojected> {
    let (rays, moves) = (cameras.rays()?, Moves::of(motion)?);
    let directions = rays.rotated(&moves.yaw)?;
    let turned = cameras.project(&directions)?;
    let (known, still) = (depths.detach(), Moves::of(&motion.detach())?);
    let toward = rays.rotated(&still.yaw)?;
    let mut found = sample(&known, size, &turned.detach())?;
    let mut corrected_at = turned.detach();
    for _ in 0..ROUNDS {
        let points = still.points(&toward, &found)?;
        corrected_at = cameras.project(&points)?;
        let seen = sample(&known, size, &corrected_at)?;
        let factor = (seen / at_least(&cameras.depths(&points)?, MIN_DEPTH.into())?)?;
        let [least, most] = CORRECTION.map(f64::from);
        found = (found * at_most(&at_least(&factor, least)?, most)?)?;
    }
    let depth = if motion.track_op() || depths.track_op() {
        let points = moves.points(&directions, &found)?;
        let seen = sample_tracked(depths, size, &corrected_at)?;
        // As if the surroundings of each place were equally deep, and its depth had settled.
        let error = (seen - cameras.depths(&points)?)?;
        let deepens = at_least(&cameras.depths(&toward)?, MIN_DEEPENING.into())?;
        (&found + ((&error - error.detach())? / deepens)?)?
    } else {
        found.clone()
    };
    Ok(Reprojected {
        places: MovedPlaces {
            room: cameras.project(&moves.points(&directions, &depth)?)?,
            turned,
        },
        depths: found,
    })
}
