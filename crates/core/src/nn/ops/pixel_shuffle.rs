//! Moves pixels between channels and places: blocks of 2×2 pixels become four groups of channels, and back.

use candle_core::{Result, Shape, Tensor};

use crate::nn::fused::{FusedOperation, Operand, apply};

/// Spreads 4 · C channels over twice the sides: `[N, H, W, 4 · C]` → `[N, 2H, 2W, C]`. Channel group `2 · row + column` goes
/// to that row and column of each 2×2 block.
pub(in crate::nn) fn pixel_shuffle(x: &Tensor) -> Result<Tensor> {
    apply(PixelShuffle { is_inverse: false }, [x])
}

/// The inverse of [`pixel_shuffle`]: `[N, 2H, 2W, C]` → `[N, H, W, 4 · C]`.
pub(in crate::nn) fn pixel_unshuffle(x: &Tensor) -> Result<Tensor> {
    apply(PixelShuffle { is_inverse: true }, [x])
}

struct PixelShuffle {
    is_inverse: bool,
}

impl FusedOperation<1> for PixelShuffle {
    const NAME: &'static str = "pixel-shuffle";

    fn forward(&self, [x]: [Operand; 1]) -> Result<(Vec<f32>, Shape)> {
        let (count, height, width, channels) = x.layout.shape().dims4()?;
        if self.is_inverse {
            let moved = rows_to_columns(x.values, width / 2, 2, 2 * channels);
            return Ok((moved, Shape::from((count, height / 2, width / 2, 4 * channels))));
        }
        let moved = rows_to_columns(x.values, 2, width, channels / 2);
        Ok((moved, Shape::from((count, 2 * height, 2 * width, channels / 4))))
    }

    fn backward(&self, [x]: [Operand; 1], _output: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 1]> {
        let (_, _, width, channels) = x.layout.shape().dims4()?;
        let moved = if self.is_inverse {
            rows_to_columns(gradient.values, 2, width / 2, 2 * channels)
        } else {
            rows_to_columns(gradient.values, width, 2, channels / 2)
        };
        Ok([Some(moved)])
    }
}

/// Turns each matrix `[columns, rows]`, whose values are `length` numbers each, into one `[rows, columns]`. A row of 2×2
/// blocks is such a matrix: of two halves of its channels for each block, or of a half for each block in two rows.
fn rows_to_columns(values: &[f32], rows: usize, columns: usize, length: usize) -> Vec<f32> {
    let mut out = vec![0.0; values.len()];
    let size = rows * columns * length;
    for (from, to) in values.chunks_exact(size).zip(out.chunks_exact_mut(size)) {
        for (index, value) in from.chunks_exact(length).enumerate() {
            let place = index % rows * columns + index / rows;
            to[place * length..(place + 1) * length].copy_from_slice(value);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise};

    #[test]
    fn pixel_shuffle_is_undone_by_its_inverse() {
        let x = noise(&[2, 3, 2, 8], 4);
        let fine = pixel_shuffle(&x).unwrap();
        assert_eq!(fine.dims(), [2, 6, 4, 2]);
        let back = pixel_unshuffle(&fine).unwrap();
        assert_eq!(
            back.flatten_all().unwrap().to_vec1::<f32>().unwrap(),
            x.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        );
        assert_gradients(&[x], 1e-2, |inputs| pixel_shuffle(&inputs[0]));
    }
}
