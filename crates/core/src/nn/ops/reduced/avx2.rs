//! The products of bytes on x86-64 processors with AVX2 and without AVX-512 VNNI. AVX2 adds up two products in 16 bits before it widens
//! them to 32. So weights are at most ±63: two products always fit.
// A function's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::arch::x86_64::{
    __m256i, _mm256_add_epi32, _mm256_madd_epi16, _mm256_maddubs_epi16, _mm256_set1_epi16, _mm256_set1_epi32,
};

use super::products::{self, products};
use super::{ByteRange, Group, PlaceGroups, ReducedPanel, ReducedProduct, Register};
use crate::nn::ops::casts::casts;

/// The largest byte of a weight: 2 · 255 · 63 fits 16 bits.
pub(super) const MOST_OF_WEIGHT: f32 = 63.0;

casts! {
    group_bits: Register<Group> => [__m256i; 2];
    whole: [__m256i; 2] => Register<i32>;
    whole_bits: Register<i32> => [__m256i; 2];
}

products!(
    fn multiply_bytes, "avx2", places 4 then 2, vectors 1,
    weights group_bits, group of_all, start first_sums, add add_products, add_half add_products, finish finish
);

/// The same group for all outputs.
#[target_feature(enable = "avx2")]
#[inline]
fn of_all(group: Group) -> __m256i {
    _mm256_set1_epi32(i32::from_le_bytes(group))
}

/// Adds to each sum four products.
#[target_feature(enable = "avx2")]
#[inline]
fn add_products(mut sums: [__m256i; 2], group: __m256i, weights: [__m256i; 2]) -> [__m256i; 2] {
    for half in 0..2 {
        let of_two = _mm256_maddubs_epi16(group, weights[half]);
        let of_four = _mm256_madd_epi16(of_two, _mm256_set1_epi16(1));
        sums[half] = _mm256_add_epi32(sums[half], of_four);
    }
    sums
}

/// As [`products::first_sums`].
#[target_feature(enable = "avx2")]
#[inline]
fn first_sums(range: ByteRange, panel: &ReducedPanel, vector: usize) -> [__m256i; 2] {
    whole_bits(products::first_sums(0, range, panel, vector))
}

/// As [`products::dequantized`].
#[target_feature(enable = "avx2")]
#[inline]
fn finish(sums: [__m256i; 2], range: ByteRange, panel: &ReducedPanel, vector: usize) -> Register<f32> {
    products::dequantized(whole(sums), range, panel, vector)
}
