//! The products on processors with AVX-512.
// A function's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::arch::x86_64::{
    __m512, __m512bh, __m512i, _mm512_add_ps, _mm512_cvtepi32_ps, _mm512_dpbf16_ps, _mm512_dpbusd_epi32, _mm512_max_ps,
    _mm512_min_ps, _mm512_mul_ps, _mm512_mullo_epi32, _mm512_reduce_max_ps, _mm512_reduce_min_ps, _mm512_set1_epi32,
    _mm512_set1_ps, _mm512_setzero_ps, _mm512_setzero_si512, _mm512_sub_epi32,
};

use super::{ByteRange, Group, LANES, MAX_VECTORS, PlaceGroups, ReducedPanel, ReducedProduct, Register};
use crate::nn::ops::casts::casts;
use crate::nn::ops::packed::StartSums;
use crate::nn::precision::Precision;

/// Computes a product with the instructions of its precision.
#[expect(
    unsafe_code,
    reason = "only the processor can tell whether it has the instructions, and it is asked first"
)]
pub(super) fn multiply(product: ReducedProduct) {
    let precision = product.weights.precision;
    assert!(
        precision.is_supported(),
        "weights in {precision} on this processor are a bug"
    );
    match precision {
        // SAFETY: `is_supported` found the features of this function.
        Precision::Int8 => unsafe { multiply_bytes(product) },
        // SAFETY: the same.
        Precision::Bf16 => unsafe { multiply_halves(product) },
        Precision::F32 => unreachable!("reduced weights in single precision are a bug"),
    }
}

/// The least and the largest of the values and of 0.
#[expect(
    unsafe_code,
    reason = "only the processor can tell whether it has the instructions, and it is asked first"
)]
pub(super) fn extremes(values: &[f32]) -> (f32, f32) {
    assert!(Precision::Int8.is_supported(), "bytes on this processor are a bug");
    // SAFETY: `is_supported` found the features of this function.
    unsafe { extremes_of_vectors(values) }
}

#[target_feature(enable = "avx512f")]
fn extremes_of_vectors(values: &[f32]) -> (f32, f32) {
    /// Vectors, so that none waits for the one before.
    const TOGETHER: usize = 4;
    let (vectors, rest) = values.as_chunks::<LANES>();
    let (together, others) = vectors.as_chunks::<TOGETHER>();
    let mut least = [_mm512_setzero_ps(); TOGETHER];
    let mut most = least;
    for vectors in together {
        for at in 0..TOGETHER {
            let values = float_bits(Register(vectors[at]));
            least[at] = _mm512_min_ps(values, least[at]);
            most[at] = _mm512_max_ps(values, most[at]);
        }
    }
    let mut last = Register([0.0; LANES]);
    last.0[..rest.len()].copy_from_slice(rest);
    for vector in others.iter().chain([&last.0]) {
        let values = float_bits(Register(*vector));
        least[0] = _mm512_min_ps(values, least[0]);
        most[0] = _mm512_max_ps(values, most[0]);
    }
    let least = least
        .into_iter()
        .fold(_mm512_setzero_ps(), |least, vector| _mm512_min_ps(vector, least));
    let most = most
        .into_iter()
        .fold(_mm512_setzero_ps(), |most, vector| _mm512_max_ps(vector, most));
    (_mm512_reduce_min_ps(least), _mm512_reduce_max_ps(most))
}

casts! {
    group_bits: Register<Group> => __m512i;
    whole_bits: Register<i32> => __m512i;
    float_bits: Register<f32> => __m512;
    halves: __m512i => __m512bh;
    floats: __m512 => Register<f32>;
}

/// A function that computes a product, and its parts: the same loops for two kinds of instructions. The sums of up to 8 places and 3
/// vectors of outputs stay in registers while the inputs and weights pass by.
macro_rules! products {
    ($name:ident, $features:literal, $no_sum:expr, $product:expr, $finished:expr) => {
        #[target_feature(enable = $features)]
        fn $name(mut product: ReducedProduct) {
            #[target_feature(enable = $features)]
            fn panel<const VECTORS: usize>(product: &mut ReducedProduct, panel: &ReducedPanel) {
                let (mut place, places) = (0, product.out.len() / product.weights.outputs);
                while place + 8 <= places {
                    block::<8, VECTORS>(product, panel, place);
                    place += 8;
                }
                while place + 4 <= places {
                    block::<4, VECTORS>(product, panel, place);
                    place += 4;
                }
                while place < places {
                    block::<1, VECTORS>(product, panel, place);
                    place += 1;
                }
            }

            #[target_feature(enable = $features)]
            #[inline]
            fn block<const PLACES: usize, const VECTORS: usize>(
                product: &mut ReducedProduct,
                panel: &ReducedPanel,
                place: usize,
            ) {
                let PlaceGroups {
                    groups, step, runs, ..
                } = product.inputs;
                let weights = panel.weights.as_chunks::<VECTORS>().0;
                let mut sums = [[$no_sum; VECTORS]; PLACES];
                for run in runs {
                    let weights = &weights[run.first..][..run.length];
                    // A slice of the loop's length needs no check in the loop, which would keep the sums out of the registers.
                    let mut inputs: [&[Group]; PLACES] = [&[]; PLACES];
                    for (at, inputs) in inputs.iter_mut().enumerate() {
                        *inputs = &groups[(place + at) * step + run.offset..][..weights.len()];
                    }
                    for (input, weights) in weights.iter().enumerate() {
                        for at in 0..PLACES {
                            let group = _mm512_set1_epi32(i32::from_le_bytes(inputs[at][input]));
                            for vector in 0..VECTORS {
                                sums[at][vector] = $product(sums[at][vector], group, group_bits(weights[vector]));
                            }
                        }
                    }
                }
                for (at, sums) in sums.into_iter().enumerate() {
                    for (vector, sum) in sums.into_iter().enumerate() {
                        let sum = $finished(sum, product.inputs.range(place + at), panel, vector);
                        let sum = _mm512_add_ps(sum, float_bits(panel.bias[vector]));
                        product.store(panel, [place + at, vector], floats(sum));
                    }
                }
            }

            for outputs in &product.weights.panels {
                match outputs.vectors {
                    1 => panel::<1>(&mut product, outputs),
                    2 => panel::<2>(&mut product, outputs),
                    _ => panel::<MAX_VECTORS>(&mut product, outputs),
                }
            }
        }
    };
}

products!(
    multiply_halves,
    "avx512f,avx512bf16",
    _mm512_setzero_ps(),
    add_halves,
    |sum: __m512, _: Option<ByteRange>, _: &ReducedPanel, _: usize| sum
);
products!(
    multiply_bytes,
    "avx512f,avx512vnni",
    _mm512_setzero_si512(),
    _mm512_dpbusd_epi32,
    finish_bytes
);

#[target_feature(enable = "avx512f,avx512bf16")]
#[inline]
fn add_halves(sum: __m512, group: __m512i, weights: __m512i) -> __m512 {
    _mm512_dpbf16_ps(sum, halves(group), halves(weights))
}

/// What sums of products of bytes stand for.
#[target_feature(enable = "avx512f")]
#[inline]
fn finish_bytes(sum: __m512i, range: Option<ByteRange>, panel: &ReducedPanel, vector: usize) -> __m512 {
    let ByteRange { scale, zero } = range.unwrap_or_default();
    let of_zeros = _mm512_mullo_epi32(_mm512_set1_epi32(zero.into()), whole_bits(panel.weight_sums[vector]));
    let factor = _mm512_mul_ps(_mm512_set1_ps(scale), float_bits(panel.factors[vector]));
    _mm512_mul_ps(_mm512_cvtepi32_ps(_mm512_sub_epi32(sum, of_zeros)), factor)
}

impl PlaceGroups<'_> {
    /// What the bytes of a place stand for.
    #[inline(always)]
    fn range(&self, place: usize) -> Option<ByteRange> {
        match self.ranges {
            [all] => Some(*all),
            ranges => ranges.get(place).copied(),
        }
    }
}

impl ReducedProduct<'_> {
    /// Writes the sums of a vector of outputs at a place.
    #[inline(always)]
    fn store(&mut self, panel: &ReducedPanel, [place, vector]: [usize; 2], Register(sums): Register<f32>) {
        let outputs = self.weights.outputs;
        let first = panel.first + vector * LANES;
        let out = &mut self.out[place * outputs + first..][..LANES.min(outputs - first)];
        let held = |at: usize, out: &[f32]| if self.start == StartSums::Output { out[at] } else { 0.0 };
        match out.as_mut_array::<LANES>() {
            Some(out) => {
                for at in 0..LANES {
                    out[at] = sums[at] + held(at, out);
                }
            }
            None => {
                for at in 0..out.len() {
                    out[at] = sums[at] + held(at, out);
                }
            }
        }
    }
}
