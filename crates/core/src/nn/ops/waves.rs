//! Sine and cosine without branches or calls, so that the compiler can vectorize them (libm's functions are scalar).
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use std::f32::consts::{FRAC_2_PI, FRAC_PI_4};

use crate::vectorized::{Instructions, ROUND};

/// Sine and cosine of x. Up to ±1000 they differ from the exact values by less than 2e-7; those of larger arguments
/// are inaccurate, but within −1 to 1. Those of NaN and infinities are NaN.
#[inline(always)]
pub(in crate::nn) fn sin_cos(x: f32, instructions: Instructions) -> (f32, f32) {
    let shifted = instructions.multiply_add(x, FRAC_2_PI, ROUND);
    let (turns, quarter) = (shifted - ROUND, shifted.to_bits());
    // A quarter turn in three parts, of which the first two have few digits, so that their multiples are exact.
    let rest = instructions.multiply_add(turns, -1.570_312_5, x);
    let rest = instructions.multiply_add(turns, -4.837_513e-4, rest);
    let rest = instructions.multiply_add(turns, -7.549_79e-8, rest);
    // A little more than an eighth of a turn: rounding may choose the other neighbour.
    let rest = rest.clamp(-FRAC_PI_4 - 1e-3, FRAC_PI_4 + 1e-3);
    // The polynomials of Cephes' `sinf` and `cosf`.
    let square = rest * rest;
    let mut sin = instructions.multiply_add(square, -1.951_529_6e-4, 8.332_161e-3);
    sin = instructions.multiply_add(square, sin, -0.166_666_55);
    sin = instructions.multiply_add(square * rest, sin, rest);
    let mut cos = instructions.multiply_add(square, 2.443_315_7e-5, -1.388_731_6e-3);
    cos = instructions.multiply_add(square, cos, 4.166_664_6e-2);
    cos = instructions.multiply_add(square * square, cos, instructions.multiply_add(square, -0.5, 1.0));
    let (sin, cos) = if quarter & 1 == 0 { (sin, cos) } else { (cos, sin) };
    let signed = |value: f32, negative: u32| f32::from_bits(value.to_bits() ^ negative << 31);
    (
        signed(sin, quarter >> 1 & 1),
        signed(cos, quarter.wrapping_add(1) >> 1 & 1),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vectorized::vectorized_by;

    fn found(x: f32) -> [(f32, f32); 2] {
        let widest = vectorized_by(
            #[inline(always)]
            |instructions| sin_cos(x, instructions),
        );
        [widest, sin_cos(x, Instructions::PLAIN)]
    }

    #[test]
    fn both_differ_from_exact_values_by_under_2e_7() {
        for step in -400_000..=400_000 {
            let x = step as f32 * 2.5e-3;
            let exact = f64::from(x).sin_cos();
            for (sin, cos) in found(x) {
                let off = (f64::from(sin) - exact.0).abs().max((f64::from(cos) - exact.1).abs());
                assert!(off < 2e-7, "{x}: {sin} and {cos} instead of {exact:?}");
            }
        }
    }

    #[test]
    fn results_stay_within_1_for_huge_arguments() {
        for x in [1e5, -3e7, 1e20, f32::MAX] {
            for (sin, cos) in found(x) {
                assert!(sin.abs() <= 1.0 && cos.abs() <= 1.0, "{x}: {sin} and {cos}");
            }
        }
    }

    #[test]
    fn nan_and_infinity_give_nan() {
        for x in [f32::NAN, f32::INFINITY] {
            assert!(found(x).iter().all(|(sin, cos)| sin.is_nan() && cos.is_nan()));
        }
    }
}
