//! Frames cut into blocks of 2×2 pixels, and back.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Device, Result, Tensor};

use crate::nn::ops::compose::{SCENE_CHANNELS, SCENE_FEATURES};
use crate::nn::ops::gathering::SAMPLED_TOGETHER;
use crate::nn::ops::pixel_shuffle::pixel_shuffle;
use crate::nn::ops::sampling::{ImageSize, PixelPlaces, SampledImage};
use crate::nn::recycled::buffer;
use crate::vectorized::{vectorized, vectorized_by};

/// Channels of the moved pixels that the fine layers read: a 2×2 block and the share inside the frame.
pub(super) const MOVED_CHANNELS: usize = 5;
/// Of these, the channels that hold pixels.
pub(super) const BLOCK_PIXELS: usize = MOVED_CHANNELS - 1;

/// An item's places on the grid of a quarter of the sides `[H/4, W/4, 2]`, as the means of the middles of their 4×4 blocks.
pub(super) fn coarse_places(places: PixelPlaces, size: ImageSize) -> Vec<f32> {
    let quarter = size.shrunk(4);
    let mut coarse = vec![0.0; 2 * quarter.pixels()];
    for (row, coarse) in coarse.chunks_exact_mut(2 * quarter.width).enumerate() {
        for (column, coarse) in coarse.as_chunks_mut::<2>().0.iter_mut().enumerate() {
            let at = |dy: usize, dx: usize| places.at((4 * row + dy) * size.width + 4 * column + dx);
            let middles = [at(1, 1), at(2, 2), at(1, 2), at(2, 1)];
            for (axis, coarse) in coarse.iter_mut().enumerate() {
                let middle = (middles[0][axis] + middles[1][axis] + middles[2][axis] + middles[3][axis]) / 4.0;
                *coarse = (middle - 1.5) / 4.0;
            }
        }
    }
    coarse
}

/// Samples a frame at the places and writes each 2×2 block to four channels of its place, from channel `first` on.
pub(super) fn write_blocks(frame: &[f32], size: ImageSize, places: PixelPlaces, out: &mut [f32], first: usize) {
    let half = size.shrunk(2);
    let channels = out.len() / half.pixels();
    vectorized_by(
        #[inline(always)]
        |instructions| {
            let frame = SampledImage {
                size,
                pixels: frame,
                instructions,
            };
            for row in 0..size.height {
                let out = &mut out[row / 2 * half.width * channels..][..half.width * channels];
                for (part, out) in out.chunks_mut(SAMPLED_TOGETHER / 2 * channels).enumerate() {
                    let sampled = frame.sample(&places.together(row * size.width + part * SAMPLED_TOGETHER));
                    for (out, pair) in out.chunks_exact_mut(channels).zip(sampled.as_chunks::<2>().0) {
                        out[first + row % 2 * 2..][..2].copy_from_slice(pair);
                    }
                }
            }
        },
    );
}

/// The last frames `[contexts, P]` sampled at the items' places: per 2×2 block its four pixels and the share
/// that lies inside the frame, `[M, H/2, W/2, 5]`.
pub(super) fn sampled_blocks<'a>(
    frames: &[f32],
    frame_of: &[u32],
    items: impl Iterator<Item = PixelPlaces<'a>>,
    size: ImageSize,
) -> Result<Tensor> {
    let (half, pixels) = (size.shrunk(2), size.pixels());
    let mut out = buffer(frame_of.len() * half.pixels() * MOVED_CHANNELS);
    let outs = out.chunks_exact_mut(half.pixels() * MOVED_CHANNELS);
    for ((out, places), &frame) in outs.zip(items).zip(frame_of) {
        write_blocks(&frames[frame as usize * pixels..][..pixels], size, places, out, 0);
        write_shares_inside(size, places, out);
    }
    Tensor::from_vec(
        out,
        (frame_of.len(), half.height, half.width, MOVED_CHANNELS),
        &Device::Cpu,
    )
}

/// Writes the share of each block that lies inside the frame to its last channel.
fn write_shares_inside(size: ImageSize, places: PixelPlaces, out: &mut [f32]) {
    let (last_x, last_y) = ((size.width - 1) as f32, (size.height - 1) as f32);
    let row_of_blocks = size.width / 2 * MOVED_CHANNELS;
    vectorized(
        #[inline(always)]
        || {
            for row in 0..size.height {
                let out = &mut out[row / 2 * row_of_blocks..][..row_of_blocks];
                for (part, out) in out.chunks_mut(SAMPLED_TOGETHER / 2 * MOVED_CHANNELS).enumerate() {
                    let [x, y] = places.together(row * size.width + part * SAMPLED_TOGETHER);
                    let mut shares = [0.0; SAMPLED_TOGETHER];
                    for at in 0..SAMPLED_TOGETHER {
                        let is_inside = (0.0..=last_x).contains(&x[at]) && (0.0..=last_y).contains(&y[at]);
                        shares[at] = if is_inside { 0.25 } else { 0.0 };
                    }
                    for (out, pair) in out.chunks_exact_mut(MOVED_CHANNELS).zip(shares.as_chunks::<2>().0) {
                        let above = if row % 2 == 0 { 0.0 } else { out[MOVED_CHANNELS - 1] };
                        out[MOVED_CHANNELS - 1] = above + pair[0] + pair[1];
                    }
                }
            }
        },
    );
}

/// The content of a scene `[M, H/2, W/2, SCENE_CHANNELS]`: 2×2 blocks of pixels `[M, H/2, W/2, 4]`.
pub(super) fn content_blocks(scene: &Tensor) -> Result<Tensor> {
    scene.narrow(3, SCENE_FEATURES, SCENE_CHANNELS - SCENE_FEATURES)
}

/// The content of a scene as frames `[M, P]`.
pub(super) fn content_frames(scene: &Tensor) -> Result<Tensor> {
    pixel_shuffle(&content_blocks(scene)?)?.flatten_from(1)
}
