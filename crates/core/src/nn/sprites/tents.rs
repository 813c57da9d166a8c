//! Matrices that move the rows or columns of a picture by a part of a pixel, and spread them.

use candle_core::{Result, Shape, Tensor, bail};

use crate::nn::fused::{FusedOperation, Operand, apply};

/// For each row of `moves` `[M, 2]` (how far, and how wide, in pixels; the width is 1 or more) a matrix `[side, side]`: row r has a
/// tent of area 1 around column r − move, of that half width, seen at the middles of the pixels. Its product with a picture moves the picture's rows down;
/// at a width of 1 this is linear interpolation. Between whole widths, its sum over a row is only near 1 (0.89 to 1.13), so a picture becomes a bit
/// brighter or darker. Gradients go to both values. Values that are not finite give NaN.
pub(super) fn tents(moves: &Tensor, side: usize) -> Result<Tensor> {
    apply(Tents { side }, [moves])
}

struct Tents {
    side: usize,
}

impl Tents {
    /// Calls `visit` with each place in the matrices that is not 0: its index, the move's, its distance from the tent's middle and
    /// the width.
    fn visit(&self, moves: &[f32], mut visit: impl FnMut(usize, usize, f32, f32)) {
        let side = self.side;
        for (index, values) in moves.chunks_exact(2).enumerate() {
            let (by, wide) = (values[0], values[1].max(1.0));
            for row in 0..side {
                let middle = row as f32 - by;
                let first = (middle - wide).ceil().clamp(0.0, side as f32) as usize;
                let end = ((middle + wide).floor() + 1.0).clamp(0.0, side as f32) as usize;
                for column in first..end {
                    visit(
                        (index * side + row) * side + column,
                        index,
                        column as f32 - middle,
                        wide,
                    );
                }
            }
        }
    }
}

impl FusedOperation<1> for Tents {
    const NAME: &'static str = "tents";

    fn forward(&self, [moves]: [Operand; 1]) -> Result<(Vec<f32>, Shape)> {
        let &[count, 2] = moves.dims() else {
            bail!("{:?} are not moves and widths", moves.dims());
        };
        let mut out = vec![0.0; count * self.side * self.side];
        for (values, matrix) in moves
            .values
            .chunks_exact(2)
            .zip(out.chunks_exact_mut(self.side * self.side))
        {
            if !(values[0] + values[1]).is_finite() {
                matrix.fill(f32::NAN);
            }
        }
        self.visit(moves.values, |place, _, distance, wide| {
            out[place] = (1.0 - distance.abs() / wide) / wide;
        });
        Ok((out, Shape::from((count, self.side, self.side))))
    }

    fn backward(&self, [moves]: [Operand; 1], _output: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 1]> {
        let mut sums = vec![0.0; moves.values.len()];
        self.visit(moves.values, |place, index, distance, wide| {
            let gradient = gradient.values[place];
            // The distance grows with the move.
            let sign = if distance == 0.0 { 0.0 } else { distance.signum() };
            sums[2 * index] -= gradient * sign / (wide * wide);
            sums[2 * index + 1] += gradient * (2.0 * distance.abs() / wide - 1.0) / (wide * wide);
        });
        Ok([Some(sums)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise, values};

    #[test]
    fn a_tent_of_width_1_interpolates() {
        let moves = Tensor::new(&[[1.25f32, 1.0]], &candle_core::Device::Cpu).unwrap();
        let matrix = values(&tents(&moves, 4).unwrap());
        let expected = [
            [0.0, 0.0, 0.0, 0.0],
            [0.75, 0.0, 0.0, 0.0],
            [0.25, 0.75, 0.0, 0.0],
            [0.0, 0.25, 0.75, 0.0],
        ];
        assert_eq!(matrix, expected.concat());
    }

    #[test]
    fn moves_that_are_not_finite_do_not_look_like_black() {
        let moves = Tensor::new(&[[f32::NAN, 1.0], [0.0, 1.0]], &candle_core::Device::Cpu).unwrap();
        let matrices = values(&tents(&moves, 4).unwrap());
        assert!(matrices[..16].iter().all(|value| value.is_nan()));
        assert!(matrices[16..].iter().all(|value| value.is_finite()));
    }

    #[test]
    fn wide_tents_nearly_keep_the_sum_and_pass_gradients_on() {
        let moves = (noise(&[3, 2], 1) + 2.37).unwrap();
        let sums = tents(&moves, 16).unwrap().sum(2).unwrap();
        for row in sums.to_vec2::<f32>().unwrap() {
            assert!((row[8] - 1.0).abs() < 0.2, "{}", row[8]);
        }
        assert_gradients(&[moves], 1e-3, |inputs| tents(&inputs[0], 12));
    }
}
