//! The products on processors with AVX-512.
// A function's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::arch::x86_64::{
    __m256bh, __m256i, __m512, __m512bh, __m512i, _mm256_dpbf16_ps, _mm256_dpbusd_epi32, _mm512_add_ps,
    _mm512_castps256_ps512, _mm512_castps512_ps256, _mm512_castsi256_si512, _mm512_castsi512_si256, _mm512_cvtepi32_ps,
    _mm512_dpbf16_ps, _mm512_dpbusd_epi32, _mm512_mul_ps, _mm512_mullo_epi32, _mm512_set1_epi32, _mm512_set1_ps,
    _mm512_setzero_ps,
};

use super::products::{self, products};
use super::{ByteRange, Group, PlaceGroups, ReducedPanel, ReducedProduct, Register};
use crate::nn::ops::casts::casts;

casts! {
    group_bits: Register<Group> => __m512i;
    whole_bits: Register<i32> => __m512i;
    float_bits: Register<f32> => __m512;
    halves: __m512i => __m512bh;
    fewer_halves: __m256i => __m256bh;
    floats: __m512 => Register<f32>;
}

products!(
    fn multiply_halves, "avx512f,avx512vl,avx512bf16", places 8 then 4, vectors 1 2 3,
    weights group_bits, group of_all, start no_sum, add add_halves, add_half add_fewer_halves, finish finish_halves
);
products!(
    fn multiply_bytes, "avx512f,avx512vl,avx512vnni", places 8 then 4, vectors 1 2 3,
    weights group_bits, group of_all, start first_sums, add _mm512_dpbusd_epi32, add_half add_fewer_bytes, finish finish_bytes
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

/// As [`add_halves`], for the first half of the outputs.
#[target_feature(enable = "avx512f,avx512vl,avx512bf16")]
#[inline]
fn add_fewer_halves(sum: __m512, group: __m512i, weights: __m512i) -> __m512 {
    let (group, weights) = (_mm512_castsi512_si256(group), _mm512_castsi512_si256(weights));
    let sum = _mm256_dpbf16_ps(_mm512_castps512_ps256(sum), fewer_halves(group), fewer_halves(weights));
    _mm512_castps256_ps512(sum)
}

/// Adds to the sums of the first half of the outputs.
#[target_feature(enable = "avx512f,avx512vl,avx512vnni")]
#[inline]
fn add_fewer_bytes(sum: __m512i, group: __m512i, weights: __m512i) -> __m512i {
    let sum = _mm512_castsi512_si256(sum);
    let sum = _mm256_dpbusd_epi32(sum, _mm512_castsi512_si256(group), _mm512_castsi512_si256(weights));
    _mm512_castsi256_si512(sum)
}

#[target_feature(enable = "avx512f")]
#[inline]
fn no_sum(_: ByteRange, _: &ReducedPanel, _: usize) -> __m512 {
    _mm512_setzero_ps()
}

/// The sums with the bias.
#[target_feature(enable = "avx512f")]
#[inline]
fn finish_halves(sum: __m512, _: ByteRange, panel: &ReducedPanel, vector: usize) -> Register<f32> {
    floats(_mm512_add_ps(sum, float_bits(panel.bias[vector])))
}

/// As [`products::first_sums`], in instructions. The compiler does not inline the loop everywhere, and would pass vectors through memory.
#[target_feature(enable = "avx512f")]
#[inline]
fn first_sums(range: ByteRange, panel: &ReducedPanel, vector: usize) -> __m512i {
    let zero = _mm512_set1_epi32(-i32::from(range.zero));
    _mm512_mullo_epi32(whole_bits(panel.weight_sums[vector]), zero)
}

/// As [`products::dequantized`], in instructions for the same reason.
#[target_feature(enable = "avx512f")]
#[inline]
fn finish_bytes(sum: __m512i, range: ByteRange, panel: &ReducedPanel, vector: usize) -> Register<f32> {
    let factors = _mm512_mul_ps(_mm512_set1_ps(range.scale), float_bits(panel.factors[vector]));
    let values = _mm512_mul_ps(_mm512_cvtepi32_ps(sum), factors);
    floats(_mm512_add_ps(float_bits(panel.bias[vector]), values))
}
