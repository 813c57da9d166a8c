//! A few numbers that describe the last two frames of a context.
// Loops with vector instructions include only functions that are inlined into them.
#![allow(clippy::inline_always)]

use std::f32::consts::SQRT_2;

use crate::frame::Frame;
use crate::frame::difference::{squared_difference, squared_difference_of_bytes};
use crate::nn::{Network, NnError};
use crate::vectorized::vectorized;

/// Cosine waves along each side, the constant one included.
const WAVES: usize = 4;
/// Columns whose sums are computed together.
const LANES: usize = 16;
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
        let waves = Waves::new(width, last.len() / width.max(1));
        Self::with(&waves, last, before)
    }

    fn with(waves: &Waves, last: &[f32], before: &[f32]) -> Self {
        let mut appearance = [0.0; APPEARANCE];
        let (means, edges) = appearance.split_at_mut(WAVES * WAVES);
        means.copy_from_slice(waves.means(last).as_flattened());
        for (out, reach) in edges.chunks_exact_mut(2).zip(REACHES) {
            out.copy_from_slice(&log_differences(last, waves.width, reach));
        }
        let unchanged: u32 = vectorized(
            #[inline(always)]
            || {
                let pairs = last.iter().zip(before);
                pairs.map(|(a, b)| u32::from((a - b).abs() < STILL)).sum()
            },
        );
        let share = (f64::from(unchanged) / last.len().max(1) as f64).clamp(SHARE_MARGIN, 1.0 - SHARE_MARGIN);
        Self {
            appearance,
            // The first reach is that of the next pixel.
            edges: f64::midpoint(appearance[WAVES * WAVES], appearance[WAVES * WAVES + 1]),
            still: (share / (1.0 - share)).ln(),
        }
    }

    /// The statistics of windows whose frames have these codes, `frames` for each window, oldest first. What the codes do not hold, the
    /// statistics do not see. Errors: those of the network.
    #[doc(hidden)]
    pub fn of_codes(model: &Network, codes: &[f32], frames: usize) -> Result<Vec<Self>, NnError> {
        let (spec, length) = (model.spec(), model.spec().code_len());
        // Of each window the frame before the last one, or the only one, and the last one.
        let mut ends = Vec::new();
        for window in codes.chunks_exact(frames * length) {
            for back in [frames.min(2), 1] {
                ends.extend_from_slice(&window[(frames - back) * length..][..length]);
            }
        }
        let waves = Waves::new(spec.frame_width_px as usize, spec.frame_height_px as usize);
        let (mut found, mut before) = (Vec::new(), None);
        model.for_each_frame(&ends, |values| {
            let frame = spec.preprocess.inverse(values);
            match before.take() {
                None => before = Some(frame),
                Some(before) => found.push(Self::with(&waves, &frame, &before)),
            }
        })?;
        Ok(found)
    }
}

/// Cosine waves along both sides of images of one size.
struct Waves {
    width: usize,
    /// Of some neighbouring columns each; 0 beyond the image.
    across: Vec<[[f32; LANES]; WAVES]>,
    /// Of each row.
    down: Vec<[f32; WAVES]>,
}

impl Waves {
    fn new(width: usize, height: usize) -> Self {
        let mut across = vec![[[0.0; LANES]; WAVES]; width.div_ceil(LANES)];
        for (column, waves) in waves(width).enumerate() {
            for (wave, value) in waves.into_iter().enumerate() {
                across[column / LANES][wave][column % LANES] = value;
            }
        }
        Self {
            width,
            across,
            down: waves(height).collect(),
        }
    }

    /// Mean of the image times each pair of waves, down and across; the constant pair is the mean of the image.
    fn means(&self, image: &[f32]) -> [[f64; WAVES]; WAVES] {
        let mut sums = [[[0.0; LANES]; WAVES]; WAVES];
        vectorized(
            #[inline(always)]
            || {
                for (index, across) in self.across.iter().enumerate() {
                    let columns = self.columns(image, index * LANES);
                    for down in 0..WAVES {
                        for other in 0..WAVES {
                            for lane in 0..LANES {
                                sums[down][other][lane] += columns[down][lane] * across[other][lane];
                            }
                        }
                    }
                }
            },
        );
        let mean = |sums: [f32; LANES]| sums.into_iter().map(f64::from).sum::<f64>() / image.len().max(1) as f64;
        sums.map(|sums| sums.map(mean))
    }

    /// The sums of the columns from one on, each row times its waves.
    #[inline(always)]
    fn columns(&self, image: &[f32], first: usize) -> [[f32; LANES]; WAVES] {
        let mut columns = [[0.0; LANES]; WAVES];
        for (row, down) in image.chunks_exact(self.width).zip(&self.down) {
            let row = &row[first..];
            let mut values = [0.0; LANES];
            match row.first_chunk() {
                Some(all) => values = *all,
                None => values[..row.len()].copy_from_slice(row),
            }
            for wave in 0..WAVES {
                for lane in 0..LANES {
                    columns[wave][lane] += values[lane] * down[wave];
                }
            }
        }
        columns
    }
}

/// The waves at each place of a side of that length.
fn waves(side: usize) -> impl Iterator<Item = [f32; WAVES]> {
    (0..side).map(move |at| {
        let cosine = (std::f32::consts::PI * (at as f32 + 0.5) / side as f32).cos();
        // The cosines of multiples of an angle follow from its own.
        let second = 2.0 * cosine * cosine - 1.0;
        let third = cosine * (2.0 * second - 1.0);
        [1.0, SQRT_2 * cosine, SQRT_2 * second, SQRT_2 * third]
    })
}

/// Logarithms of the mean squared difference of pixels that are `reach` apart, across and down.
fn log_differences(image: &[f32], width: usize, reach: usize) -> [f64; 2] {
    let sums = vectorized(
        #[inline(always)]
        || {
            let (mut across, mut pairs) = (0.0f64, 0);
            for row in image.chunks_exact(width.max(1)) {
                let later = row.get(reach..).unwrap_or_default();
                across += squared_difference(row, later);
                pairs += later.len();
            }
            let below = image.get(reach * width..).unwrap_or_default();
            [(across, pairs), (squared_difference(image, below), below.len())]
        },
    );
    sums.map(|(sum, count)| (sum / count.max(1) as f64 + super::FLOOR).ln())
}

/// Logarithm of the mean squared difference of neighbouring pixels, intensities 0…1.
pub(super) fn log_edges(frame: &Frame) -> f64 {
    let (pixels, width) = (frame.pixels(), frame.width() as usize);
    let (mut across, mut pairs) = (0, 0);
    let down = vectorized(
        #[inline(always)]
        || {
            for row in pixels.chunks_exact(width) {
                across += squared_difference_of_bytes(row, &row[1..]);
                pairs += width - 1;
            }
            squared_difference_of_bytes(pixels, &pixels[width..])
        },
    );
    let [across, down] = [(across, pairs), (down, pixels.len() - width)].map(|(sum, pairs)| {
        let mean = sum as f64 / (255.0 * 255.0 * pairs.max(1) as f64);
        (mean + super::FLOOR).ln()
    });
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
    fn the_edges_of_a_frame_are_those_of_its_intensities() {
        let pixels: Vec<u8> = (0..20 * 9).map(|at| (at * at * 7 % 256) as u8).collect();
        let intensities: Vec<f32> = pixels.iter().map(|&pixel| f32::from(pixel) / 255.0).collect();
        let [across, down] = log_differences(&intensities, 20, 1);
        let frame = Frame::new(20, 9, pixels).unwrap();
        assert!((log_edges(&frame) - f64::midpoint(across, down)).abs() < 1e-5);
        let square = |a: f32, b: f32| f64::from((a - b) * (a - b));
        let below: f64 = intensities
            .iter()
            .zip(&intensities[20..])
            .map(|(a, b)| square(*a, *b))
            .sum();
        assert!((down - (below / 160.0 + super::super::FLOOR).ln()).abs() < 1e-5);
        let line = Frame::new(1, 3, vec![0, 255, 0]).unwrap();
        assert!((log_edges(&line) - f64::midpoint(super::super::FLOOR.ln(), 0.0)).abs() < 1e-5);
    }

    #[test]
    fn the_still_share_counts_unchanged_pixels() {
        let mut last = [0.5; 64];
        last[..32].fill(0.6);
        assert!(ContextStatistics::of(&last, &[0.5; 64], 8).still.abs() < 1e-9);
    }
}
