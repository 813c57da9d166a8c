//! The products on processors with AVX-512.
// A function's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::arch::x86_64::{
    __m512, __m512bh, __m512i, _mm512_add_ps, _mm512_dpbf16_ps, _mm512_dpbusd_epi32, _mm512_max_ps, _mm512_min_ps,
    _mm512_reduce_max_ps, _mm512_reduce_min_ps, _mm512_set1_epi32, _mm512_setzero_ps, _mm512_setzero_si512,
};

use super::products::{finished, products};
use super::{ByteRange, Group, LANES, PlaceGroups, ReducedPanel, ReducedProduct, Register};
use crate::nn::ops::casts::casts;
use crate::nn::precision::{Precision, multiplies_four_bytes};

/// Computes a product with the instructions of its precision.
#[expect(
    unsafe_code,
    reason = "only the processor can tell whether it has the instructions, and it is asked first"
)]
pub(super) fn multiply(product: ReducedProduct) {
    let precision = product.weights.precision;
    assert!(
        precision.is_supported() && (precision == Precision::Bf16 || multiplies_four_bytes()),
        "weights in {precision} on this processor are a bug"
    );
    match precision {
        // SAFETY: `multiplies_four_bytes` found the features of this function.
        Precision::Int8 => unsafe { multiply_bytes(product) },
        // SAFETY: `is_supported` found them.
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
    assert!(multiplies_four_bytes(), "bytes on this processor are a bug");
    // SAFETY: `multiplies_four_bytes` found the features of this function.
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
    whole: __m512i => Register<i32>;
    float_bits: Register<f32> => __m512;
    halves: __m512i => __m512bh;
    floats: __m512 => Register<f32>;
}

products!(
    fn multiply_halves, "avx512f,avx512bf16", places 8 then 4, vectors 1 2 3,
    sums _mm512_setzero_ps(), weights group_bits, group of_all, add add_halves, finish finish_halves
);
products!(
    fn multiply_bytes, "avx512f,avx512vnni", places 8 then 4, vectors 1 2 3,
    sums _mm512_setzero_si512(), weights group_bits, group of_all, add _mm512_dpbusd_epi32, finish finish_bytes
);

/// The same group for all outputs.
#[target_feature(enable = "avx512f")]
#[inline]
fn of_all(group: Group) -> __m512i {
    _mm512_set1_epi32(i32::from_le_bytes(group))
}

#[target_feature(enable = "avx512f,avx512bf16")]
#[inline]
fn add_halves(sum: __m512, group: __m512i, weights: __m512i) -> __m512 {
    _mm512_dpbf16_ps(sum, halves(group), halves(weights))
}

/// The sums with the bias.
#[target_feature(enable = "avx512f")]
#[inline]
fn finish_halves(sum: __m512, _: Option<ByteRange>, panel: &ReducedPanel, vector: usize) -> Register<f32> {
    floats(_mm512_add_ps(sum, float_bits(panel.bias[vector])))
}

/// What sums of products of bytes stand for.
#[target_feature(enable = "avx512f")]
#[inline]
fn finish_bytes(sum: __m512i, range: Option<ByteRange>, panel: &ReducedPanel, vector: usize) -> Register<f32> {
    finished(whole(sum), 0, range, panel, vector)
}
