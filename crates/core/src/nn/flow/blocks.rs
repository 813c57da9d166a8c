//! Frames cut into blocks of 2×2 pixels, and back.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Device, Result, Tensor};

use crate::nn::ops::compose::{SCENE_CHANNELS, SCENE_FEATURES};
use crate::nn::ops::pixel_shuffle::pixel_shuffle;
use crate::nn::ops::sampling::{ImageSize, SAMPLED_TOGETHER};
use crate::vectorized::vectorized;

/// Channels of the moved pixels that the fine layers read: a 2×2 block and the share inside the frame.
pub(super) const MOVED_CHANNELS: usize = 5;
/// Of these, the channels that hold pixels.
pub(super) const BLOCK_PIXELS: usize = MOVED_CHANNELS - 1;

/// A column or row as −1 to 1.
pub(super) fn centred(at: usize, side: usize) -> f32 {
    (2.0 * at as f32 + 1.0) / side as f32 - 1.0
}

/// The places `[M, H/4, W/4, 2]` on the grid of a quarter of the sides, as the means of the middles of their 4×4 blocks, of
/// places `[M, P, values]` (columns and rows) that begin at value `first`.
pub(super) fn coarse_places(places: &[f32], values: usize, first: usize, size: ImageSize) -> Vec<f32> {
    let quarter = size.shrunk(4);
    let items = places.chunks_exact(size.pixels() * values);
    let mut coarse = Vec::with_capacity(items.len() * quarter.pixels() * 2);
    for item in items {
        for place in 0..quarter.pixels() {
            let (row, column) = (place / quarter.width, place % quarter.width);
            for axis in first..first + 2 {
                let at = |dy: usize, dx: usize| item[((4 * row + dy) * size.width + 4 * column + dx) * values + axis];
                let middle = (at(1, 1) + at(2, 2) + at(1, 2) + at(2, 1)) / 4.0;
                coarse.push((middle - 1.5) / 4.0);
            }
        }
    }
    coarse
}

/// Samples a frame at `places` `[P, 2]` and writes each 2×2 block to four channels of its place, from channel `first` on.
pub(super) fn write_blocks(frame: &[f32], size: ImageSize, places: &[f32], out: &mut [f32], first: usize) {
    let half = size.shrunk(2);
    let channels = out.len() / half.pixels();
    vectorized(
        #[inline(always)]
        || {
            for (row, places) in places.chunks_exact(2 * size.width).enumerate() {
                let out = &mut out[row / 2 * half.width * channels..][..half.width * channels];
                let together = out.chunks_mut(SAMPLED_TOGETHER / 2 * channels);
                for (out, places) in together.zip(places.chunks(2 * SAMPLED_TOGETHER)) {
                    let [mut x, mut y] = [[0.0; SAMPLED_TOGETHER]; 2];
                    for ((x, y), place) in x.iter_mut().zip(&mut y).zip(places.as_chunks::<2>().0) {
                        [*x, *y] = *place;
                    }
                    let sampled = size.sample(frame, &[x, y]);
                    for (out, pair) in out.chunks_exact_mut(channels).zip(sampled.as_chunks::<2>().0) {
                        out[first + row % 2 * 2..][..2].copy_from_slice(pair);
                    }
                }
            }
        },
    );
}

/// The last frames `[contexts, P]` sampled at the items' places `[M, P, 2]`: per 2×2 block its four pixels and the share
/// that lies inside the frame, `[M, H/2, W/2, 5]`.
pub(super) fn sampled_blocks(frames: &[f32], frame_of: &[u32], places: &[f32], size: ImageSize) -> Result<Tensor> {
    let (half, pixels) = (size.shrunk(2), size.pixels());
    let mut out = vec![0.0; frame_of.len() * half.pixels() * MOVED_CHANNELS];
    let items = out
        .chunks_exact_mut(half.pixels() * MOVED_CHANNELS)
        .zip(places.chunks_exact(pixels * 2));
    for ((out, places), &frame) in items.zip(frame_of) {
        write_blocks(&frames[frame as usize * pixels..], size, places, out, 0);
        for (row, places) in places.chunks_exact(2 * size.width).enumerate() {
            let out = &mut out[row / 2 * half.width * MOVED_CHANNELS..][..half.width * MOVED_CHANNELS];
            for (out, pair) in out.chunks_exact_mut(MOVED_CHANNELS).zip(places.chunks_exact(4)) {
                let inside = pair.chunks_exact(2).filter(|place| {
                    (0.0..=size.width as f32 - 1.0).contains(&place[0])
                        && (0.0..=size.height as f32 - 1.0).contains(&place[1])
                });
                out[MOVED_CHANNELS - 1] += 0.25 * inside.count() as f32;
            }
        }
    }
    Tensor::from_vec(
        out,
        (frame_of.len(), half.height, half.width, MOVED_CHANNELS),
        &Device::Cpu,
    )
}

/// The content of a scene `[M, H/2, W/2, SCENE_CHANNELS]`: 2×2 blocks of pixels `[M, H/2, W/2, 4]`.
pub(super) fn content_blocks(scene: &Tensor) -> Result<Tensor> {
    scene.narrow(3, SCENE_FEATURES, SCENE_CHANNELS - SCENE_FEATURES)
}

/// The content of a scene as frames `[M, P]`.
pub(super) fn content_frames(scene: &Tensor) -> Result<Tensor> {
    pixel_shuffle(&content_blocks(scene)?)?.flatten_from(1)
}
