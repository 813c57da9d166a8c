//! Inputs as bytes: whole numbers with a scale and a zero.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use super::{Group, LANES, inputs_of_group};
use crate::nn::precision::Precision;
use crate::vectorized::vectorized;

/// The largest byte of an input.
const MOST_OF_INPUT: f32 = 255.0;

/// Which numbers bytes stand for.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::nn::ops) struct ByteRange {
    pub(in crate::nn::ops) scale: f32,
    pub(in crate::nn::ops) zero: u8,
}

impl ByteRange {
    /// That of these values and of 0.
    pub(in crate::nn::ops) fn of(values: &[f32]) -> Self {
        let (least, most) = extremes(values);
        let scale = (most - least) / MOST_OF_INPUT;
        if scale.is_normal() {
            let zero = (-least / scale).round() as u8;
            Self { scale, zero }
        } else {
            Self { scale: 1.0, zero: 0 }
        }
    }

    /// Writes places `[places, channels]` as bytes; the last group of each is filled up with what stands for 0.
    pub(in crate::nn::ops) fn write(self, values: &[f32], channels: usize, groups: &mut [Group]) {
        let length = channels.div_ceil(inputs_of_group(Precision::Int8)) * size_of::<Group>();
        let to = groups.as_flattened_mut();
        vectorized(
            #[inline(always)]
            || {
                if length == channels {
                    return self.write_bytes(values, to);
                }
                for (values, to) in values.chunks_exact(channels).zip(to.chunks_exact_mut(length)) {
                    // All of the last group, before some of it is overwritten: a few bytes alone would be a call.
                    *to.last_chunk_mut().expect("a place without channels is a bug") = [self.zero; size_of::<Group>()];
                    self.write_bytes(values, &mut to[..channels]);
                }
            },
        );
    }

    #[inline(always)]
    fn write_bytes(self, values: &[f32], to: &mut [u8]) {
        /// After adding 2^23, the low bits hold the nearest whole number.
        const ROUND: f32 = 8_388_608.0;
        let (factor, first) = (self.scale.recip(), ROUND + f32::from(self.zero));
        for (to, value) in to.iter_mut().zip(values) {
            let shifted = (value * factor + first).clamp(ROUND, ROUND + MOST_OF_INPUT);
            *to = shifted.to_bits() as u8;
        }
    }
}

/// The least and the largest of the values and of 0.
fn extremes(values: &[f32]) -> (f32, f32) {
    vectorized(
        #[inline(always)]
        || {
            let (vectors, rest) = values.as_chunks::<LANES>();
            let (pairs, last) = vectors.as_chunks::<2>();
            // Two vectors, so that none waits for the one before.
            let mut least = [[0.0; LANES]; 2];
            let mut most = least;
            for pair in pairs {
                for nth in 0..2 {
                    widen(&mut least[nth], &mut most[nth], &pair[nth]);
                }
            }
            for vector in last {
                widen(&mut least[0], &mut most[0], vector);
            }
            let widened = |(least, most): (f32, f32), &value: &f32| (least.min(value), most.max(value));
            let all = rest.iter().chain(least.as_flattened()).chain(most.as_flattened());
            all.fold((0.0, 0.0), widened)
        },
    )
}

#[inline(always)]
fn widen(least: &mut [f32; LANES], most: &mut [f32; LANES], vector: &[f32; LANES]) {
    for at in 0..LANES {
        // On x86-64, one instruction each: `min` and `max` take more, for NaN.
        least[at] = if vector[at] < least[at] { vector[at] } else { least[at] };
        most[at] = if vector[at] > most[at] { vector[at] } else { most[at] };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extremes_are_those_of_all_values() {
        for length in [0usize, 1, 15, 16, 17, 31, 32, 33, 64, 65, 200] {
            for (at, value) in [
                (0, -3.0),
                (length / 2, 7.0),
                (length.saturating_sub(1), 5.0),
                (0, f32::NAN),
            ] {
                let mut values: Vec<f32> = (0..length).map(|place| (place as f32).sin()).collect();
                values.iter_mut().skip(at).take(1).for_each(|found| *found = value);
                let expected = values.iter().fold((0.0f32, 0.0f32), |(least, most), value| {
                    (least.min(*value), most.max(*value))
                });
                assert_eq!(extremes(&values), expected, "{value} at {at} of {length}");
            }
        }
    }
}
