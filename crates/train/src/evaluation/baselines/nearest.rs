//! The training window whose inputs differ least, and its future.

use rayon::prelude::*;

use crate::evaluation::EvaluationError;
use crate::evaluation::windows::true_frame;
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, Window};

/// Sides of the small image that frames are compared by first.
const SMALL_SIDE: usize = 8;
/// Windows that are compared pixel by pixel at most.
const MAX_CANDIDATES: usize = 64;

/// Training windows with their inputs in small.
pub(super) struct TrainingWindows {
    windows: Vec<Window>,
    shape: WindowShape,
    width: usize,
    /// Window by window, frame by frame.
    small: Vec<f32>,
}

impl TrainingWindows {
    /// None if there are no windows. Errors: those of [`Dataset::pixels`].
    pub(super) fn new(
        dataset: &Dataset,
        windows: &[Window],
        shape: WindowShape,
    ) -> Result<Option<Self>, EvaluationError> {
        if windows.is_empty() {
            return Ok(None);
        }
        let width = dataset.info().frame_width_px as usize;
        let window_values = shape.context * SMALL_SIDE * SMALL_SIDE;
        let mut small = vec![0.0; windows.len() * window_values];
        let places = small.par_chunks_exact_mut(window_values).zip(windows);
        places.try_for_each(|(small, window)| {
            let frames = small.chunks_exact_mut(SMALL_SIDE * SMALL_SIDE);
            for (small, frame) in frames.zip(window.first_frame..) {
                small.copy_from_slice(&shrunk(&true_frame(dataset, frame)?, width));
            }
            Ok::<(), EvaluationError>(())
        })?;
        Ok(Some(Self {
            windows: windows.to_vec(),
            shape,
            width,
            small,
        }))
    }

    /// The future of the nearest window.
    pub(super) fn predict(
        &self,
        dataset: &Dataset,
        inputs: &[Vec<f32>],
        horizon: usize,
    ) -> Result<Vec<Vec<f32>>, EvaluationError> {
        let future = self.nearest(dataset, inputs)?.first_frame + self.shape.context..;
        let frames = future.take(horizon).map(|frame| Ok(true_frame(dataset, frame)?));
        frames.collect()
    }

    /// The window with the least squared error. Means of blocks never differ by more than their pixels do, so the windows
    /// that are close in small are compared first, until no other can be nearer.
    fn nearest(&self, dataset: &Dataset, inputs: &[Vec<f32>]) -> Result<Window, EvaluationError> {
        let wanted: Vec<f32> = inputs.iter().flat_map(|frame| shrunk(frame, self.width)).collect();
        let known = self.small.chunks_exact(wanted.len()).zip(&self.windows);
        let mut ranked: Vec<(f32, Window)> = known
            .map(|(small, &window)| (squared_distance(small, &wanted), window))
            .collect();
        let candidates = MAX_CANDIDATES.min(ranked.len());
        ranked.select_nth_unstable_by(candidates - 1, |one, other| one.0.total_cmp(&other.0));
        ranked.truncate(candidates);
        ranked.sort_by(|one, other| one.0.total_cmp(&other.0));
        let bytes = |frame: &Vec<f32>| frame.iter().map(|value| (value * 255.0).round() as u8).collect();
        let pixels: Vec<Vec<u8>> = inputs.iter().map(bytes).collect();
        let block_pixels = inputs.first().map_or(0, Vec::len) as f32 / (SMALL_SIDE * SMALL_SIDE) as f32;
        let mut best = (u64::MAX, ranked[0].1);
        for (in_small, window) in ranked {
            let bound = f64::from(in_small * block_pixels) * 255.0 * 255.0;
            // A little room for rounding, and for blocks of unequal size.
            if 0.9 * bound > best.0 as f64 {
                break;
            }
            let mut error = 0;
            for (step, frame) in pixels.iter().enumerate() {
                error += squared_byte_distance(frame, &dataset.pixels(window.first_frame + step)?);
            }
            if error < best.0 {
                best = (error, window);
            }
        }
        Ok(best.1)
    }
}

/// The means of a frame's blocks, [`SMALL_SIDE`] a side.
fn shrunk(frame: &[f32], width: usize) -> Vec<f32> {
    // A side shorter than that has blocks of one pixel, some of them the same.
    let block = |index: usize, side: usize| {
        let start = index * side / SMALL_SIDE;
        start..((index + 1) * side / SMALL_SIDE).max(start + 1)
    };
    let mut small = Vec::with_capacity(SMALL_SIDE * SMALL_SIDE);
    for row in 0..SMALL_SIDE {
        for column in 0..SMALL_SIDE {
            let (rows, columns) = (block(row, frame.len() / width), block(column, width));
            let count = (rows.len() * columns.len()) as f32;
            let sum: f32 = rows.flat_map(|y| &frame[y * width..][columns.clone()]).sum();
            small.push(sum / count);
        }
    }
    small
}

/// Summed in lanes, so that it can be done in vectors.
fn squared_distance(one: &[f32], other: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    for (one, other) in one.chunks(16).zip(other.chunks(16)) {
        for ((lane, a), b) in lanes.iter_mut().zip(one).zip(other) {
            *lane += (a - b) * (a - b);
        }
    }
    lanes.iter().sum()
}

fn squared_byte_distance(one: &[u8], other: &[u8]) -> u64 {
    let squares = one.iter().zip(other).map(|(a, b)| u64::from(a.abs_diff(*b)).pow(2));
    squares.sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_is_the_mean_of_its_pixels() {
        let frame: Vec<f32> = (0..16 * 16).map(|i| (i % 16 / 2) as f32).collect();
        let small = shrunk(&frame, 16);
        assert_eq!(small[..8], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
        assert_eq!(shrunk(&[3.0], 1), [3.0; 64]);
    }

    #[test]
    fn distances_are_sums_of_squares() {
        let one: Vec<f32> = (0..37).map(|i| i as f32).collect();
        assert_eq!(
            squared_distance(&one, &[0.0; 37]),
            (0..37).map(|i| (i * i) as f32).sum::<f32>()
        );
        assert_eq!(squared_byte_distance(&[0, 255, 3], &[255, 0, 1]), 2 * 255 * 255 + 4);
    }
}
