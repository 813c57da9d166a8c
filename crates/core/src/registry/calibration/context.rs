//! A few numbers that describe the last two frames of a context.

use candle_core::{Device, Tensor};

use crate::nn::tensors::with_values;
use crate::nn::{Network, NnError};

/// Cosine waves along each side, the constant one included.
const WAVES: usize = 4;
/// Distances in pixels over which neighbours are compared.
const REACHES: [usize; 2] = [1, 4];
/// Number of statistics of a frame's look: waves along both sides, and edges over each reach in both directions.
pub const APPEARANCE: usize = WAVES * WAVES + 2 * REACHES.len();
/// A pixel stands still if it changes by less than this, about five of 255 levels.
const STILL: f32 = 0.02;
/// Shares are kept this far from 0 and 1.
const SHARE_MARGIN: f64 = 1e-3;

/// What the last two frames of a context look like.
#[derive(Clone, Debug, PartialEq)]
pub struct ContextStatistics {
    /// The last frame's lowest cosine waves, and the logarithms of its edges.
    pub appearance: [f64; APPEARANCE],
    /// Logarithm of the mean squared difference of neighbouring pixels of the last frame.
    pub edges: f64,
    /// The share of pixels that did not change since the frame before, as a log-odds ratio.
    pub still: f64,
}

impl ContextStatistics {
    /// Of the last frame and the one before it: intensities 0…1, row by row.
    #[must_use]
    pub fn of(last: &[f32], before: &[f32], width: usize) -> Self {
        let mut appearance = [0.0; APPEARANCE];
        let (waves, edges) = appearance.split_at_mut(WAVES * WAVES);
        write_waves(last, width, waves);
        for (out, reach) in edges.chunks_exact_mut(2).zip(REACHES) {
            out.copy_from_slice(&log_differences(last, width, reach));
        }
        let unchanged = last
            .iter()
            .zip(before)
            .filter(|(a, b)| (**a - **b).abs() < STILL)
            .count();
        let share = (unchanged as f64 / last.len().max(1) as f64).clamp(SHARE_MARGIN, 1.0 - SHARE_MARGIN);
        Self {
            appearance,
            edges: log_edges(last, width),
            still: (share / (1.0 - share)).ln(),
        }
    }

    /// The statistics of windows whose frames have these codes, `frames` for each window, oldest first. What the codes do not hold, the
    /// statistics do not see. Errors: those of the network.
    #[doc(hidden)]
    pub fn of_codes(model: &Network, codes: &[f32], frames: usize) -> Result<Vec<Self>, NnError> {
        let (spec, length) = (model.spec(), model.spec().code_len());
        let mut ends = Vec::new();
        for window in codes.chunks_exact(frames * length) {
            for back in [1, frames.min(2)] {
                ends.extend_from_slice(&window[(frames - back) * length..][..length]);
            }
        }
        let ends = Tensor::from_vec(ends, (2 * codes.len() / (frames * length), length), &Device::Cpu)?;
        let (pixels, width) = (spec.pixels(), spec.frame_width_px as usize);
        let decoded = model.decode_frames(&ends)?;
        Ok(with_values(&decoded, |values| {
            values
                .chunks_exact(2 * pixels)
                .map(|pair| {
                    let camera = spec.preprocess.inverse(pair);
                    let (last, before) = camera.split_at(pixels);
                    Self::of(last, before, width)
                })
                .collect()
        })?)
    }
}

/// Mean of the image times each pair of cosine waves; the constant pair is the mean of the image.
fn write_waves(image: &[f32], width: usize, out: &mut [f64]) {
    let height = image.len() / width.max(1);
    let table = |side: usize| -> Vec<[f32; WAVES]> {
        let angle = |at: usize| std::f32::consts::PI * (at as f32 + 0.5) / side as f32;
        let wave = |at, wave: usize| {
            if wave == 0 {
                1.0
            } else {
                std::f32::consts::SQRT_2 * (angle(at) * wave as f32).cos()
            }
        };
        (0..side)
            .map(|at| std::array::from_fn(|index| wave(at, index)))
            .collect()
    };
    let (across, down) = (table(width), table(height));
    for (row, down) in image.chunks_exact(width.max(1)).zip(&down) {
        let mut sums = [0.0f32; WAVES];
        for (value, waves) in row.iter().zip(&across) {
            for (sum, wave) in sums.iter_mut().zip(waves) {
                *sum += value * wave;
            }
        }
        for (out, down) in out.chunks_exact_mut(WAVES).zip(down) {
            for (out, sum) in out.iter_mut().zip(sums) {
                *out += f64::from(sum * down) / image.len() as f64;
            }
        }
    }
}

/// Logarithms of the mean squared difference of pixels that are `reach` apart, across and down.
fn log_differences(image: &[f32], width: usize, reach: usize) -> [f64; 2] {
    let square = |a: &f32, b: &f32| (a - b) * (a - b);
    let (mut across, mut pairs) = (0.0f64, 0);
    for row in image.chunks_exact(width.max(1)) {
        let later = row.get(reach..).unwrap_or_default();
        across += f64::from(row.iter().zip(later).map(|(a, b)| square(a, b)).sum::<f32>());
        pairs += later.len();
    }
    let below = image.get(reach * width..).unwrap_or_default();
    let down: f64 = image.iter().zip(below).map(|(a, b)| f64::from(square(a, b))).sum();
    [(across, pairs), (down, below.len())].map(|(sum, count)| (sum / count.max(1) as f64 + super::FLOOR).ln())
}

/// Logarithm of the mean squared difference of neighbouring pixels.
pub(super) fn log_edges(image: &[f32], width: usize) -> f64 {
    let [across, down] = log_differences(image, width, 1);
    f64::midpoint(across, down)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flat_image_has_its_mean_and_no_other_wave() {
        let flat = ContextStatistics::of(&[0.5; 96], &[0.5; 96], 12);
        assert!((flat.appearance[0] - 0.5).abs() < 1e-6);
        assert!(flat.appearance[1..WAVES * WAVES].iter().all(|wave| wave.abs() < 1e-6));
        assert!(flat.still > 6.0);
    }

    #[test]
    fn the_still_share_counts_unchanged_pixels() {
        let mut last = [0.5; 64];
        last[..32].fill(0.6);
        assert!(ContextStatistics::of(&last, &[0.5; 64], 8).still.abs() < 1e-9);
    }
}
