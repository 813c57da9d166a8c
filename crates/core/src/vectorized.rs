//! Loops with the widest vector instructions that the machine has, chosen at run time.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use pulp::{Arch, Simd, WithSimd};

/// Runs a loop, with all that is inlined into it, with the widest vector instructions of this machine. Pass the closure as a
/// literal with `#[inline(always)]`; each function that it calls in the loop must be `#[inline(always)]` too.
///
/// The compiler takes a closure's kind from the bound of the function that it is passed to. `Arch::dispatch` asks for
/// `WithSimd`, so a closure that could run twice becomes `Fn` or `FnMut` and is called through a wrapper, which may be left
/// without the vector instructions. With the bound `FnOnce` there is no wrapper.
pub fn vectorized<R>(run: impl FnOnce() -> R) -> R {
    vectorized_by(
        #[inline(always)]
        |_| run(),
    )
}

/// As [`vectorized`], of a loop that chooses some instructions itself: the closure hears which it is compiled with.
pub(crate) fn vectorized_by<R>(run: impl FnOnce(Instructions) -> R) -> R {
    Arch::new().dispatch(Loop(run))
}

/// The vector instructions that a loop is compiled with, which this machine has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Instructions {
    lanes: usize,
}

impl Instructions {
    /// No more than those that the whole program is compiled with.
    #[cfg(test)]
    pub(crate) const PLAIN: Self = Self { lanes: 1 };

    /// a · b + c. Rounded once where the processor has an instruction for it; elsewhere in two steps, since `mul_add` would be a call.
    #[inline(always)]
    pub(crate) fn multiply_add(self, a: f32, b: f32, c: f32) -> f32 {
        if cfg!(target_arch = "aarch64") || self.lanes >= 8 {
            a.mul_add(b, c)
        } else {
            a * b + c
        }
    }

    /// Whether they are AVX-512 or later, with its parts for all kinds of numbers.
    #[inline(always)]
    pub(crate) fn have_avx512(self) -> bool {
        cfg!(target_arch = "x86_64") && self.lanes == 16
    }
}

struct Loop<F>(F);

impl<R, F: FnOnce(Instructions) -> R> WithSimd for Loop<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> R {
        let lanes = S::F32_LANES;
        (self.0)(Instructions { lanes })
    }
}

/// 1.5 · 2^23: after adding it, the low bits hold the nearest whole number.
pub(crate) const ROUND: f32 = 12_582_912.0;

/// The whole part of a value from 0 to 2^22; 0 of NaN. `as i32` would convert one value after the other.
#[inline(always)]
pub(crate) fn whole(value: f32) -> i32 {
    // `max` turns NaN into 0.
    let value = value.max(0.0);
    let shifted = value + ROUND;
    let nearest = shifted.to_bits().wrapping_sub(ROUND.to_bits()) as i32;
    nearest - i32::from(shifted - ROUND > value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_parts_are_those_of_a_conversion() {
        for step in 0..200_000 {
            let value = step as f32 * 0.037;
            assert_eq!(
                [value, value.floor()].map(whole),
                [value as i32, value as i32],
                "{value}"
            );
        }
        assert_eq!(
            [0.0, 0.5, 1.5, 2.5, 4_194_303.0, f32::NAN].map(whole),
            [0, 0, 1, 2, 4_194_303, 0]
        );
    }
}
