//! How the camera moves, as [`super::super::motion`] says.

use candle_core::{Device, Tensor};

use crate::nn::error::NnError;
use crate::nn::flow::motion::{AFFINE, CORRECTION, MotionHead, of_rows, seen_ahead};
use crate::nn::flow::rollout_rows::RolloutRows;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::plain::layers::{linear, perceptron};
use crate::nn::plain::sampling::Places;

impl MotionHead {
    /// Yaw, ahead and left since the last frame `[N, horizon, 3]`; zero for a standing camera.
    pub(super) fn plain_forward(&self, rows: &RolloutRows, device: &Device) -> Result<Tensor, NnError> {
        let shape = (rows.count(), rows.spec.horizon, 3);
        let Some(layers) = &self.layers else {
            return seen_ahead(rows, self.unchanged_ahead(rows)?.to_device(device)?);
        };
        let correction = perceptron(layers, &rows.scaled()?.to_device(device)?)?;
        let correction = of_rows(
            &(correction.reshape(shape)? * CORRECTION)?,
            &rows.rows_with_known_inputs(),
        )?;
        Ok((seen_ahead(rows, self.integral(rows)?.to_device(device)?)? + correction)?)
    }

    /// Where each pixel was by a learned affine map of the image; every pixel where it is for a standing camera.
    pub(super) fn plain_affine_places(&self, size: ImageSize, motion: &Tensor) -> Result<Places, NnError> {
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
