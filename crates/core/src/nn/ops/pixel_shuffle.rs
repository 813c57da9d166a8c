//! Moves pixels between channels and places: blocks of 2×2 pixels become four groups of channels, and back.

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};

use crate::nn::tensors::slice;

/// Spreads 4 · C channels over twice the sides: `[N, H, W, 4 · C]` → `[N, 2H, 2W, C]`. Channel group `2 · row + column` goes
/// to that row and column of each 2×2 block.
pub(in crate::nn) fn pixel_shuffle(x: &Tensor) -> Result<Tensor> {
    PixelShuffle { is_inverse: false }.apply(x)
}

/// The inverse of [`pixel_shuffle`]: `[N, 2H, 2W, C]` → `[N, H, W, 4 · C]`.
pub(in crate::nn) fn pixel_unshuffle(x: &Tensor) -> Result<Tensor> {
    PixelShuffle { is_inverse: true }.apply(x)
}

#[derive(Clone, Copy)]
struct PixelShuffle {
    is_inverse: bool,
}

impl PixelShuffle {
    fn apply(self, x: &Tensor) -> Result<Tensor> {
        let x = x.contiguous()?;
        if x.track_op() {
            x.apply_op1(self)
        } else {
            x.apply_op1_no_bwd(&self)
        }
    }
}

impl CustomOp1 for PixelShuffle {
    fn name(&self) -> &'static str {
        "pixel-shuffle"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (count, height, width, channels) = layout.shape().dims4()?;
        let values = slice(x, layout)?;
        let mut out = vec![0.0; values.len()];
        // Rows, columns and channels on the fine side.
        let (rows, columns, depth) = if self.is_inverse {
            (height, width, channels)
        } else {
            (2 * height, 2 * width, channels / 4)
        };
        let half = columns / 2 * 4 * depth;
        for row in 0..count * rows {
            // Both rows of a block lie in the same row of blocks; sides are even, so items need no care.
            let blocks = row / 2 * half + row % 2 * 2 * depth;
            for column in 0..columns {
                let coarse = blocks + column / 2 * 4 * depth + column % 2 * depth;
                let fine = (row * columns + column) * depth;
                let (from, to) = if self.is_inverse {
                    (fine, coarse)
                } else {
                    (coarse, fine)
                };
                out[to..to + depth].copy_from_slice(&values[from..from + depth]);
            }
        }
        let shape = if self.is_inverse {
            (count, height / 2, width / 2, 4 * channels)
        } else {
            (count, rows, columns, depth)
        };
        Ok((CpuStorage::F32(out), Shape::from(shape)))
    }

    fn bwd(&self, _x: &Tensor, _y: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let inverse = Self {
            is_inverse: !self.is_inverse,
        };
        Ok(Some(inverse.apply(&gradient.detach())?))
    }
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
