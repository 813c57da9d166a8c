//! The encoder's inputs for depth, as [`super::super::depth_views`] says.

use candle_core::{Device, Result, Tensor};

use super::cameras::Cameras;
use super::composition::blocks;
use crate::frame::warp::CameraModel;
use crate::nn::flow::depth_views::{FARTHER, MAX_SHIFT, MIN_SPREAD, SHIFT_PX, WALL_M};
use crate::nn::flow::encoder_views::EncoderViews;
use crate::nn::ops::sampling::{ImageSize, own_places};
use crate::nn::plain::sampling::{at_least, at_most, sample};

/// The contexts as the encoder reads them.
pub(super) struct SeenViews {
    /// `[contexts, channels, H/2, W/2]`.
    pub(super) inputs: Tensor,
    /// The last frames, from mean and in spread `[contexts, P]`.
    pub(super) frames: Tensor,
    /// Mean and spread of the last frames, `[contexts, 1]`.
    pub(super) mean: Tensor,
    pub(super) spread: Tensor,
    /// Depth before anything is learned `[contexts, P]`, in metres.
    pub(super) depths: Tensor,
    /// Column, row and inverse depth of each 2×2 block `[contexts, 3, H/2, W/2]`.
    pub(super) known: Tensor,
    /// The camera of each context.
    pub(super) cameras: Vec<CameraModel>,
}

impl SeenViews {
    pub(super) fn of(contexts: &EncoderViews, device: &Device) -> Result<Self> {
        let size = contexts.spec.image_size();
        let (count, pixels, earlier) = (contexts.count(), size.pixels(), contexts.frames_read - 1);
        let cameras: Vec<CameraModel> = (contexts.cameras.iter())
            .map(|camera| camera.unwrap_or(CameraModel::USUAL))
            .collect();
        let last = Tensor::from_slice(&contexts.last_frames, (count, pixels), device)?;
        let mean = last.mean_keepdim(1)?;
        let spread = last.broadcast_sub(&mean)?.sqr()?.mean_keepdim(1)?.sqrt()?;
        let spread = at_least(&spread, MIN_SPREAD.into())?;
        let frames = last.broadcast_sub(&mean)?.broadcast_div(&spread)?;
        let depths = first_depths(&cameras, size, device)?;
        let inverse = blocks(&depths.recip()?, size)?.mean_keepdim(1)?;
        let known = Tensor::cat(&[centred_places(size.shrunk(2), count, device)?, inverse], 1)?;

        let mut inputs = vec![blocks(&frames, size)?];
        if earlier > 0 {
            // The earlier frames of all contexts, one after another.
            let of_each = |values: &Tensor| {
                values
                    .unsqueeze(1)?
                    .expand((count, earlier, pixels))?
                    .reshape(((), pixels))
            };
            let seen = Tensor::from_slice(&contexts.earlier, (count, earlier, pixels), device)?;
            let seen = seen
                .broadcast_sub(&mean.unsqueeze(2)?)?
                .broadcast_div(&spread.unsqueeze(2)?)?;
            let of_cameras = cameras.iter().flat_map(|camera| std::iter::repeat_n(*camera, earlier));
            let viewed = EarlierFrames {
                cameras: Cameras::new(&of_cameras.collect::<Vec<_>>(), size, device)?,
                size,
                frames: seen.reshape(((), pixels))?,
                last: of_each(&frames)?,
                depths: of_each(&depths)?,
            };
            let [moved, shifts] = viewed.moved_back(contexts.motions_back.as_flattened())?;
            let half = size.shrunk(2);
            inputs.push(moved.reshape((count, 4 * earlier, half.height, half.width))?);
            inputs.push(shifts.reshape((count, 2 * earlier, half.height, half.width))?);
        }
        inputs.push(known.clone());
        Ok(Self {
            inputs: Tensor::cat(&inputs, 1)?,
            frames,
            mean,
            spread,
            depths,
            known,
            cameras,
        })
    }
}

/// The depth of each pixel `[contexts, P]`, in metres, if there were only the floor and a wall around the camera.
fn first_depths(cameras: &[CameraModel], size: ImageSize, device: &Device) -> Result<Tensor> {
    let heights: Vec<f32> = (cameras.iter())
        .map(|camera| camera.height_m.unwrap_or(CameraModel::USUAL_HEIGHT_M))
        .collect();
    let heights = Tensor::from_vec(heights, (cameras.len(), 1), device)?;
    let rays = Cameras::new(cameras, size, device)?.rays()?;
    let level = at_least(&(rays.ahead.sqr()? + rays.left.sqr()?)?.sqrt()?, 1e-3)?;
    let wall = (level.recip()? * f64::from(WALL_M))?;
    // Beside rays that go up, the floor is farther away than any wall.
    let floor = heights.broadcast_div(&at_least(&rays.up.neg()?, 1e-6)?)?;
    wall.minimum(&floor)
}

/// Column and row of each place as −1 to 1, `[count, 2, h, w]`.
pub(super) fn centred_places(size: ImageSize, count: usize, device: &Device) -> Result<Tensor> {
    let own = Tensor::from_vec(own_places(size), (1, size.height, size.width, 2), device)?;
    let part = |index: usize, side: usize| {
        let scale = 2.0 / side as f64;
        own.narrow(3, index, 1)?.squeeze(3)?.affine(scale, scale / 2.0 - 1.0)
    };
    let places = Tensor::stack(&[part(0, size.width)?, part(1, size.height)?], 1)?;
    places.broadcast_as((count, 2, size.height, size.width))?.contiguous()
}

/// Earlier frames and what is needed to move them into the view of the last one.
struct EarlierFrames {
    cameras: Cameras,
    size: ImageSize,
    frames: Tensor,
    last: Tensor,
    depths: Tensor,
}

impl EarlierFrames {
    /// Blocks of the frames in the view of the last one (the last one's pixel where they saw nothing), and how far each block would
    /// shift if it were farther away. `motions`: yaw, ahead and left of each frame, as seen from the last one.
    fn moved_back(&self, motions: &[f32]) -> Result<[Tensor; 2]> {
        let (size, half) = (self.size, self.size.shrunk(2));
        let items = self.frames.dim(0)?;
        let motions = Tensor::from_slice(motions, (items, 3), self.frames.device())?.neg()?;
        let part = |index: usize| motions.narrow(1, index, 1);
        let (yaw, ahead, left) = (part(0)?, part(1)?, part(2)?);
        let rays = self.cameras.rays()?;
        let seen_at = |depths: &Tensor| {
            let points = rays.scaled(depths)?.moved(&ahead, &left)?;
            self.cameras.project(&points.rotated(&yaw)?)
        };
        let (near, far) = (seen_at(&self.depths)?, seen_at(&(&self.depths * f64::from(FARTHER))?)?);
        let shown = near.inside(size, 0.5)?;
        let sampled = sample(&self.frames, size, &near)?;
        let moved = (&self.last + (shown * (sampled - &self.last)?)?)?;
        let shift = |far: &Tensor, near: &Tensor| {
            let shift = ((far - near)? * (1.0 / f64::from(SHIFT_PX)))?;
            let shift = at_most(&at_least(&shift, -f64::from(MAX_SHIFT))?, MAX_SHIFT.into())?;
            blocks(&shift, size)?.mean_keepdim(1)
        };
        let shifts = Tensor::cat(&[shift(&far.x, &near.x)?, shift(&far.y, &near.y)?], 1)?;
        debug_assert_eq!(shifts.dims(), [items, 2, half.height, half.width]);
        Ok([blocks(&moved, size)?, shifts])
    }
}
