//! The products on 64-bit ARM processors with instructions for sums of products of bytes.
// A function's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::arch::aarch64::{int32x4_t, vdupq_n_s32, veorq_s32};
use std::arch::asm;

use super::products::{self, products};
use super::{ByteRange, Group, LANES, PlaceGroups, ReducedPanel, ReducedProduct, Register};
use crate::nn::ops::casts::casts;

/// Registers of a vector of outputs, four in each.
const QUARTERS: usize = LANES / 4;
/// XOR with this turns each byte b of a group into the byte with a sign b − 128, which the instruction takes.
const SIGNS: i32 = i32::from_ne_bytes([0x80; 4]);
/// By how much these bytes are less.
const SHIFT: i32 = 128;

casts! {
    group_bits: Register<Group> => [int32x4_t; QUARTERS];
    whole: [int32x4_t; QUARTERS] => Register<i32>;
    whole_bits: Register<i32> => [int32x4_t; QUARTERS];
}

products!(
    fn multiply_bytes, "neon,dotprod", places 6 then 3, vectors 1,
    weights group_bits, group of_all, start first_sums, add add_products, add_half add_products, finish finish
);

/// The same group for all outputs, as bytes with a sign.
#[target_feature(enable = "neon,dotprod")]
#[inline]
fn of_all(group: Group) -> int32x4_t {
    veorq_s32(vdupq_n_s32(SIGNS), vdupq_n_s32(i32::from_ne_bytes(group)))
}

/// Adds to each sum four products.
#[target_feature(enable = "neon,dotprod")]
#[inline]
#[expect(unsafe_code, reason = "the standard library does not offer the instruction yet")]
fn add_products(
    mut sums: [int32x4_t; QUARTERS],
    group: int32x4_t,
    weights: [int32x4_t; QUARTERS],
) -> [int32x4_t; QUARTERS] {
    for at in 0..QUARTERS {
        // SAFETY: this function has the feature of the instruction, which reads and writes only these registers.
        unsafe {
            asm!(
                "sdot {sums:v}.4s, {weights:v}.16b, {group:v}.16b",
                sums = inout(vreg) sums[at],
                weights = in(vreg) weights[at],
                group = in(vreg) group,
                options(pure, nomem, nostack, preserves_flags)
            );
        }
    }
    sums
}

/// As [`products::first_sums`].
#[target_feature(enable = "neon,dotprod")]
#[inline]
fn first_sums(range: ByteRange, panel: &ReducedPanel, vector: usize) -> [int32x4_t; QUARTERS] {
    whole_bits(products::first_sums(SHIFT, range, panel, vector))
}

/// As [`products::dequantized`].
#[target_feature(enable = "neon,dotprod")]
#[inline]
fn finish(sums: [int32x4_t; QUARTERS], range: ByteRange, panel: &ReducedPanel, vector: usize) -> Register<f32> {
    products::dequantized(whole(sums), range, panel, vector)
}
