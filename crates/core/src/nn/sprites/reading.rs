//! What is read of the frames before the first layer.

use candle_core::{Device, Tensor};

use super::block_tracks::{REACH, TRACK_VALUES, block_tracks};
use super::layers::SPRITES;
use super::two_ways::{FARTHEST_PX, two_ways};
use crate::nn::error::NnError;
use crate::nn::ops::sampling::{ImageSize, centred};
use crate::nn::tensors::with_values;

/// What is read of N windows.
pub(super) struct Reading {
    /// Blocks of 2×2 pixels of the frames, latest first, and the block's column and row `[N, H/2, W/2, …]`.
    pub(super) inputs: Tensor,
    /// `[N, H/4 · W/4, context − 1, 3]`
    pub(super) tracks: Tensor,
    /// How far each block went from each of the two ways `[N, H/4 · W/4, 2]`.
    pub(super) apart: Tensor,
}

impl Reading {
    /// Reads the windows of frames `[N, context, P]`.
    pub(super) fn new(frames: &Tensor, size: ImageSize) -> Result<Self, NnError> {
        let (half, quarter) = (size.shrunk(2), size.shrunk(4));
        let (windows, context, pixels) = frames.dims3()?;
        let (mut inputs, mut tracks, mut apart) = (Vec::new(), Vec::new(), Vec::new());
        with_values(frames, |frames| {
            for window in frames.chunks_exact(context * pixels) {
                let mut frames = window.chunks_exact(pixels).rev();
                inputs.extend(blocks_and_places(&frames, size));
                let last = frames.next().unwrap_or_default();
                let of_window = block_tracks(last, frames, size);
                apart.extend(two_ways(&of_window, &light_of_blocks(last, size)).into_flattened());
                tracks.extend(of_window.values);
            }
        })?;
        let of_blocks = (windows, quarter.pixels(), context - 1, TRACK_VALUES);
        Ok(Self {
            inputs: Tensor::from_vec(inputs, (windows, half.height, half.width, ()), &Device::Cpu)?,
            tracks: Tensor::from_vec(tracks, of_blocks, &Device::Cpu)?,
            apart: Tensor::from_vec(apart, (windows, quarter.pixels(), SPRITES), &Device::Cpu)?,
        })
    }

    /// Tracks and distances as a layer reads them `[N, H/4, W/4, …]`: how far a block is from its place in the last frame, over
    /// the most that it can be, its misfits, and its distances from the two ways over the most that they can be.
    pub(super) fn scaled_tracks(&self, quarter: ImageSize) -> Result<Tensor, NnError> {
        let (windows, _, frames, _) = self.tracks.dims4()?;
        let scale = (1..=frames).flat_map(|frame| {
            let of_way = 1.0 / (REACH as f32 * frame as f32);
            [of_way, of_way, 1.0]
        });
        let scale = Tensor::from_iter(scale, &Device::Cpu)?.reshape((1, 1, frames, TRACK_VALUES))?;
        let tracks = self.tracks.broadcast_mul(&scale)?.flatten_from(2)?;
        let apart = (&self.apart / f64::from(FARTHEST_PX))?;
        let both = Tensor::cat(&[&tracks, &apart], 2)?;
        Ok(both.reshape((windows, quarter.height, quarter.width, ()))?)
    }
}

fn blocks_and_places<'a>(frames: &(impl Iterator<Item = &'a [f32]> + Clone), size: ImageSize) -> Vec<f32> {
    let half = size.shrunk(2);
    let mut inputs = Vec::new();
    for place in 0..half.pixels() {
        let (row, column) = (place / half.width, place % half.width);
        for frame in frames.clone() {
            let block = &frame[2 * row * size.width + 2 * column..];
            inputs.extend([block[0], block[1], block[size.width], block[size.width + 1]]);
        }
        inputs.extend([centred(column, half.width), centred(row, half.height)]);
    }
    inputs
}

/// The sums of blocks of 4×4 px.
fn light_of_blocks(frame: &[f32], size: ImageSize) -> Vec<f32> {
    let blocks = size.shrunk(4);
    let mut sums = vec![0.0; blocks.pixels()];
    for (row, values) in frame.chunks_exact(size.width).enumerate() {
        for (block, values) in values.chunks_exact(4).enumerate() {
            sums[row / 4 * blocks.width + block] += values.iter().sum::<f32>();
        }
    }
    sums
}
