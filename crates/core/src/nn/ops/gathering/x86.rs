//! The same on processors with AVX-512. The compiler reads and stores scattered values one by one; here, two neighbouring pixels are
//! 64 bits, which one instruction puts into a vector, and what belongs together is put there from two vectors at once.
// A function's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::arch::x86_64::{
    __m512, __m512i, _mm_setr_pd, _mm256_castpd128_pd256, _mm256_insertf128_pd, _mm512_castpd_ps,
    _mm512_castpd256_pd512, _mm512_insertf64x4, _mm512_max_epu32, _mm512_permutex2var_ps, _mm512_reduce_max_epu32,
    _mm512_setr_epi32, _mm512_setzero_ps, _mm512_setzero_si512,
};

use super::{OfPlaces, PAIR_VALUES, PAIRS, SAMPLED_TOGETHER};
use crate::nn::ops::casts::casts;
use crate::vectorized::Instructions;

/// Numbers of a vector.
const LANES: usize = 16;

/// As [`super::corners`], of images that are wider than a pixel.
#[inline(always)]
#[expect(
    unsafe_code,
    reason = "a check of each index would take longer than to read its pixels"
)]
pub(super) fn corners(
    image: &[f32],
    first: &[i32; SAMPLED_TOGETHER],
    below: usize,
    instructions: Instructions,
) -> [OfPlaces; 4] {
    assert!(instructions.have_avx512(), "a loop without AVX-512 is a bug");
    // SAFETY: the machine has the instructions.
    let most = unsafe { most(first) } as usize;
    assert!(
        below < image.len() && most < image.len() - below - 1,
        "a place beyond the image is a bug"
    );
    let mut corners = [[0.0; SAMPLED_TOGETHER]; 4];
    for (part, first) in first.as_chunks::<LANES>().0.iter().enumerate() {
        // SAFETY: the same, and the last pixel that is read is the one after `most + below`.
        let of_part = unsafe { corners_within(image, first, below) };
        for (corner, of_part) in corners.iter_mut().zip(of_part) {
            corner.as_chunks_mut::<LANES>().0[part] = of_part;
        }
    }
    corners
}

/// As [`super::of_pairs`].
#[inline(always)]
#[expect(unsafe_code, reason = "the machine has the instructions, and that is checked")]
pub(super) fn of_pairs(pairs: &[[f32; 2 * PAIR_VALUES]; PAIRS], instructions: Instructions) -> [OfPlaces; PAIR_VALUES] {
    assert!(instructions.have_avx512(), "a loop without AVX-512 is a bug");
    let mut all = [[0.0; SAMPLED_TOGETHER]; PAIR_VALUES];
    for (part, pairs) in pairs.as_chunks::<{ LANES / 2 }>().0.iter().enumerate() {
        // SAFETY: the machine has the instructions.
        let of_part = unsafe { of_pairs_by_halves(pairs) };
        for (value, of_part) in all.iter_mut().zip(of_part) {
            value.as_chunks_mut::<LANES>().0[part] = of_part;
        }
    }
    all
}

/// In each step, the vectors are joined two by two: lanes that belong to the same value come together, and the values of a vector
/// become half as many.
#[target_feature(enable = "avx512f")]
#[inline]
fn of_pairs_by_halves(pairs: &[[f32; LANES]; LANES / 2]) -> [[f32; LANES]; PAIR_VALUES] {
    // From [pixel, value] to [value, pair, pixel], for four of the eight values.
    let first = [
        _mm512_setr_epi32(0, 8, 16, 24, 1, 9, 17, 25, 2, 10, 18, 26, 3, 11, 19, 27),
        _mm512_setr_epi32(4, 12, 20, 28, 5, 13, 21, 29, 6, 14, 22, 30, 7, 15, 23, 31),
    ];
    // From [value, four pixels] to [value, eight pixels], for two of four values.
    let second = [
        _mm512_setr_epi32(0, 1, 2, 3, 16, 17, 18, 19, 4, 5, 6, 7, 20, 21, 22, 23),
        _mm512_setr_epi32(8, 9, 10, 11, 24, 25, 26, 27, 12, 13, 14, 15, 28, 29, 30, 31),
    ];
    // From [value, eight pixels] to all pixels of one value.
    let third = [
        _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23),
        _mm512_setr_epi32(8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31),
    ];
    let mut of_four = [[_mm512_setzero_ps(); 2]; 4];
    for at in 0..4 {
        let (left, right) = (floats(pairs[2 * at]), floats(pairs[2 * at + 1]));
        for half in 0..2 {
            of_four[at][half] = _mm512_permutex2var_ps(left, first[half], right);
        }
    }
    let mut of_eight = [[_mm512_setzero_ps(); 4]; 2];
    for at in 0..2 {
        for quarter in 0..4 {
            let (left, right) = (of_four[2 * at][quarter / 2], of_four[2 * at + 1][quarter / 2]);
            of_eight[at][quarter] = _mm512_permutex2var_ps(left, second[quarter % 2], right);
        }
    }
    let mut all = [[0.0; LANES]; PAIR_VALUES];
    for value in 0..PAIR_VALUES {
        let (left, right) = (of_eight[0][value / 2], of_eight[1][value / 2]);
        all[value] = values(_mm512_permutex2var_ps(left, third[value % 2], right));
    }
    all
}

/// As [`super::write_rows`], of as many rows as places.
#[inline(always)]
#[expect(unsafe_code, reason = "the machine has the instructions, and that is checked")]
pub(super) fn write_rows<const VALUES: usize>(
    values: &[OfPlaces; VALUES],
    rows: &mut [[f32; VALUES]],
    instructions: Instructions,
) {
    assert!(instructions.have_avx512(), "a loop without AVX-512 is a bug");
    const { assert!(VALUES.is_multiple_of(LANES), "rows are whole vectors") };
    for (part, rows) in rows.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
        for (block, values) in values.as_chunks::<LANES>().0.iter().enumerate() {
            let mut square = [[0.0; LANES]; LANES];
            for (row, values) in square.iter_mut().zip(values) {
                *row = values.as_chunks::<LANES>().0[part];
            }
            // SAFETY: the machine has the instructions.
            let square = unsafe { transposed(&square) };
            for (row, values) in rows.iter_mut().zip(square) {
                row.as_chunks_mut::<LANES>().0[block] = values;
            }
        }
    }
}

/// Transposes a block of 16×16 values.
#[target_feature(enable = "avx512f")]
#[inline]
fn transposed(rows: &[[f32; LANES]; LANES]) -> [[f32; LANES]; LANES] {
    let mut vectors = [_mm512_setzero_ps(); LANES];
    for row in 0..LANES {
        vectors[row] = floats(rows[row]);
    }
    swap_blocks::<8>(&mut vectors);
    swap_blocks::<4>(&mut vectors);
    swap_blocks::<2>(&mut vectors);
    swap_blocks::<1>(&mut vectors);
    let mut columns = [[0.0; LANES]; LANES];
    for row in 0..LANES {
        columns[row] = values(vectors[row]);
    }
    columns
}

/// Of each square of twice as many lanes and rows, swaps the upper right and the lower left block.
#[target_feature(enable = "avx512f")]
#[inline]
fn swap_blocks<const APART: usize>(vectors: &mut [__m512; LANES]) {
    let upper = indices(const { swapped(APART, false) });
    let lower = indices(const { swapped(APART, true) });
    for row in 0..LANES {
        if row & APART == 0 {
            let (above, below) = (vectors[row], vectors[row + APART]);
            vectors[row] = _mm512_permutex2var_ps(above, upper, below);
            vectors[row + APART] = _mm512_permutex2var_ps(above, lower, below);
        }
    }
}

/// Where each lane of the upper or lower row comes from after blocks of so many lanes were swapped between two rows that are as far
/// apart: 0 to 15 are the lanes of the upper row, the others those of the lower one.
const fn swapped(apart: usize, is_lower: bool) -> [i32; LANES] {
    let mut from = [0; LANES];
    let mut lane = 0;
    while lane < LANES {
        let is_right = lane & apart != 0;
        from[lane] = match (is_lower, is_right) {
            (false, false) => lane,
            (false, true) => LANES + lane - apart,
            (true, false) => lane + apart,
            (true, true) => LANES + lane,
        } as i32;
        lane += 1;
    }
    from
}

/// The largest index; a negative one counts as larger than all others.
#[target_feature(enable = "avx512f")]
#[inline]
fn most(first: &[i32; SAMPLED_TOGETHER]) -> u32 {
    let parts = first.as_chunks::<LANES>().0.iter();
    let most = parts.fold(_mm512_setzero_si512(), |most, part| {
        _mm512_max_epu32(most, indices(*part))
    });
    _mm512_reduce_max_epu32(most)
}

/// # Safety
///
/// Each index, plus `below` and 1, is within the image.
#[target_feature(enable = "avx512f")]
#[inline]
#[expect(
    unsafe_code,
    reason = "a check of each index would take longer than to read its pixels"
)]
unsafe fn corners_within(image: &[f32], first: &[i32; LANES], below: usize) -> [[f32; LANES]; 4] {
    /// A pixel and its right neighbour, as the bits of one number. Macros, since the compiler does not inline as many calls.
    macro_rules! pair {
        ($row:expr, $place:expr) => {{
            let left = image.as_ptr().wrapping_add($row + first[$place] as u32 as usize);
            // SAFETY: the caller says that both are within the image.
            number(unsafe { left.cast::<[f32; 2]>().read() })
        }};
    }
    /// Those of two, four, eight places.
    macro_rules! two {
        ($row:expr, $place:expr) => {
            _mm_setr_pd(pair!($row, $place), pair!($row, $place + 1))
        };
    }
    macro_rules! four {
        ($row:expr, $place:expr) => {{
            let first = _mm256_castpd128_pd256(two!($row, $place));
            _mm256_insertf128_pd::<1>(first, two!($row, $place + 2))
        }};
    }
    macro_rules! eight {
        ($row:expr, $place:expr) => {{
            let first = _mm512_castpd256_pd512(four!($row, $place));
            _mm512_castpd_ps(_mm512_insertf64x4::<1>(first, four!($row, $place + 4)))
        }};
    }
    let left = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    let right = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
    let upper = [eight!(0, 0), eight!(0, 8)];
    let lower = [eight!(below, 0), eight!(below, 8)];
    [
        values(_mm512_permutex2var_ps(upper[0], left, upper[1])),
        values(_mm512_permutex2var_ps(upper[0], right, upper[1])),
        values(_mm512_permutex2var_ps(lower[0], left, lower[1])),
        values(_mm512_permutex2var_ps(lower[0], right, lower[1])),
    ]
}

casts! {
    indices: [i32; LANES] => __m512i;
    number: [f32; 2] => f64;
    floats: [f32; LANES] => __m512;
    values: __m512 => [f32; LANES];
}
