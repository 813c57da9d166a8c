//! tanh and the logistic function without branches or calls, so that the compiler can vectorize them (libm's functions
//! are scalar). Both differ from the exact value by less than 3e-7 everywhere.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use crate::vectorized::{Instructions, ROUND};

/// tanh(x) = 2σ(2x) − 1.
#[inline(always)]
pub(in crate::nn) fn tanh(x: f32) -> f32 {
    1.0 - 2.0 / (exp(2.0 * x) + 1.0)
}

/// σ(x) = 1 / (1 + e^−x).
#[inline(always)]
pub(in crate::nn) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// σ(x), with the instructions of the loop that it is in.
#[inline(always)]
pub(in crate::nn) fn sigmoid_with(x: f32, instructions: Instructions) -> f32 {
    1.0 / (1.0 + exp_with(-x, instructions))
}

/// σ(x), off by less than 4e-5: for what is reduced to 16 or 8 bits.
#[inline(always)]
pub(in crate::nn) fn rough_sigmoid(x: f32, instructions: Instructions) -> f32 {
    let x = (-x).clamp(-87.0, 87.0);
    let shifted = instructions.multiply_add(x, std::f32::consts::LOG2_E, ROUND);
    let r = instructions.multiply_add(shifted - ROUND, -std::f32::consts::LN_2, x);
    // With these two terms, the largest error is least.
    let p = instructions.multiply_add(0.166_628_1, r, 0.503_941);
    let mantissa = instructions.multiply_add(p * r, r, r) + 1.0;
    1.0 / (1.0 + mantissa * power_of_two(shifted))
}

/// e^x.
#[inline(always)]
pub(in crate::nn) fn exp(x: f32) -> f32 {
    exp_by(
        x,
        #[inline(always)]
        |a, b, c| a * b + c,
    )
}

/// e^x, with the instructions of the loop that it is in.
#[inline(always)]
pub(in crate::nn) fn exp_with(x: f32, instructions: Instructions) -> f32 {
    exp_by(
        x,
        #[inline(always)]
        |a, b, c| instructions.multiply_add(a, b, c),
    )
}

/// e^x by 2^n · e^r, |r| ≤ ln 2 / 2, the polynomial of Cephes' `expf`, from a · b + c. Arguments are clamped to ±87; NaN stays NaN.
#[inline(always)]
fn exp_by(x: f32, add: impl Fn(f32, f32, f32) -> f32) -> f32 {
    let x = x.clamp(-87.0, 87.0);
    let shifted = add(x, std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = add(n, 2.121_944_4e-4, add(n, -0.693_359_4, x));
    let mut p = 1.987_569_1e-4;
    p = add(p, r, 1.398_2e-3);
    p = add(p, r, 8.333_452e-3);
    p = add(p, r, 4.166_579_6e-2);
    p = add(p, r, 1.666_666_5e-1);
    p = add(p, r, 0.5);
    let mantissa = add(p * r, r, r) + 1.0;
    mantissa * power_of_two(shifted)
}

/// 2^n, of n + [`ROUND`].
#[inline(always)]
fn power_of_two(shifted: f32) -> f32 {
    f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3F80_0000))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vectorized::vectorized_by;

    #[test]
    fn rough_values_differ_by_under_4e_5() {
        for step in -400_000..=400_000 {
            let x = step as f32 * 2.5e-4;
            let exact = 1.0 / (1.0 + (-f64::from(x)).exp());
            let found = vectorized_by(|instructions| rough_sigmoid(x, instructions));
            assert!((f64::from(found) - exact).abs() < 4e-5, "sigmoid({x})");
        }
    }

    #[test]
    fn both_functions_differ_from_exact_values_by_under_3e_7() {
        for step in -400_000..=400_000 {
            let x = step as f32 * 2.5e-4;
            let exact = f64::from(x);
            let logistic = 1.0 / (1.0 + (-exact).exp());
            assert!((f64::from(tanh(x)) - exact.tanh()).abs() < 3e-7, "tanh({x})");
            let sigmoids = [sigmoid(x), vectorized_by(|instructions| sigmoid_with(x, instructions))];
            for sigmoid in sigmoids {
                assert!((f64::from(sigmoid) - logistic).abs() < 3e-7, "sigmoid({x})");
            }
        }
    }

    #[test]
    fn nan_stays_nan_and_infinities_saturate() {
        assert!(tanh(f32::NAN).is_nan() && sigmoid(f32::NAN).is_nan());
        assert_eq!([tanh(f32::INFINITY), tanh(f32::NEG_INFINITY)], [1.0, -1.0]);
        assert_eq!(sigmoid(f32::INFINITY), 1.0);
        assert!(sigmoid(f32::NEG_INFINITY) < 1e-30);
    }
}
