//! Values that are scattered in memory, as vectors with one number of each place.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

#[cfg(target_arch = "x86_64")]
mod x86;

use crate::vectorized::Instructions;

/// Places that are sampled together, so that the arithmetic of all is a few vector instructions.
pub(in crate::nn) const SAMPLED_TOGETHER: usize = 32;

/// One number of each of some places.
pub(in crate::nn) type OfPlaces = [f32; SAMPLED_TOGETHER];

/// Pairs of neighbouring pixels.
const PAIRS: usize = SAMPLED_TOGETHER / 2;
/// Values of each pixel of a pair.
pub(super) const PAIR_VALUES: usize = 8;

/// The pixels of an image at the indices `first`, and as many pixels later as the steps: one, the other, and both.
#[inline(always)]
pub(super) fn corners(
    image: &[f32],
    first: &[i32; SAMPLED_TOGETHER],
    [step_x, step_y]: [usize; 2],
    instructions: Instructions,
) -> [OfPlaces; 4] {
    if instructions.have_avx512() && step_x == 1 {
        #[cfg(target_arch = "x86_64")]
        return x86::corners(image, first, step_y, instructions);
    }
    let mut corners = [[0.0; SAMPLED_TOGETHER]; 4];
    for at in 0..SAMPLED_TOGETHER {
        let around = &image[first[at] as usize..][..=step_y + step_x];
        for (corner, step) in corners.iter_mut().zip([0, step_x, step_y, step_y + step_x]) {
            corner[at] = around[step];
        }
    }
    corners
}

/// The values of pairs of pixels `[pixel, value]` each, by value.
#[inline(always)]
pub(super) fn of_pairs(pairs: &[[f32; 2 * PAIR_VALUES]; PAIRS], instructions: Instructions) -> [OfPlaces; PAIR_VALUES] {
    if instructions.have_avx512() {
        #[cfg(target_arch = "x86_64")]
        return x86::of_pairs(pairs, instructions);
    }
    let mut values = [[0.0; SAMPLED_TOGETHER]; PAIR_VALUES];
    for at in 0..SAMPLED_TOGETHER {
        for (value, values) in values.iter_mut().enumerate() {
            values[at] = pairs[at / 2][at % 2 * PAIR_VALUES + value];
        }
    }
    values
}

/// Writes the values of neighbouring places, given by value, as one row for each of the first places. Rows have a multiple of 16 values.
#[inline(always)]
pub(in crate::nn) fn write_rows<const VALUES: usize>(
    values: &[OfPlaces; VALUES],
    rows: &mut [[f32; VALUES]],
    instructions: Instructions,
) {
    if instructions.have_avx512() && rows.len() == SAMPLED_TOGETHER {
        #[cfg(target_arch = "x86_64")]
        return x86::write_rows(values, rows, instructions);
    }
    for (at, row) in rows.iter_mut().enumerate() {
        for value in 0..VALUES {
            row[value] = values[value][at];
        }
    }
}

/// The values of some neighbouring places from `first` on; zeros after the last place.
#[inline(always)]
pub(in crate::nn) fn read_together(values: &[f32], first: usize) -> OfPlaces {
    let values = &values[first..];
    if let Some(values) = values.first_chunk() {
        return *values;
    }
    let mut filled = [0.0; SAMPLED_TOGETHER];
    filled[..values.len()].copy_from_slice(values);
    filled
}

/// Writes the values of some neighbouring places from `first` on; those beyond the last place are left out.
#[inline(always)]
pub(in crate::nn) fn write_together(values: &OfPlaces, out: &mut [f32], first: usize) {
    let out = &mut out[first..];
    match out.first_chunk_mut() {
        Some(out) => *out = *values,
        None => out.copy_from_slice(&values[..out.len()]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vectorized::vectorized_by;

    #[test]
    fn the_values_of_pairs_are_those_of_their_pixels() {
        let pairs: [[f32; 2 * PAIR_VALUES]; PAIRS] =
            std::array::from_fn(|pair| std::array::from_fn(|at| (100 * pair + at) as f32));
        let values = |instructions| of_pairs(&pairs, instructions);
        for values in [values(Instructions::PLAIN), vectorized_by(values)] {
            for (value, pixels) in values.iter().enumerate() {
                for (pixel, &found) in pixels.iter().enumerate() {
                    assert_eq!(found, (100 * (pixel / 2) + pixel % 2 * PAIR_VALUES + value) as f32);
                }
            }
        }
    }

    #[test]
    fn rows_hold_the_values_of_their_places() {
        let values: [OfPlaces; 48] =
            std::array::from_fn(|value| std::array::from_fn(|place| (100 * place + value) as f32));
        for count in [SAMPLED_TOGETHER, 7] {
            let mut rows = vec![[[0.0; 48]; SAMPLED_TOGETHER]; 2];
            write_rows(&values, &mut rows[0][..count], Instructions::PLAIN);
            vectorized_by(|instructions| write_rows(&values, &mut rows[1][..count], instructions));
            for (place, row) in rows.iter().flat_map(|rows| rows.iter().take(count).enumerate()) {
                assert_eq!(
                    row.map(|value| value as usize),
                    std::array::from_fn(|value| 100 * place + value)
                );
            }
        }
    }

    #[test]
    #[should_panic(expected = "out of range")]
    fn places_beyond_an_image_are_not_read() {
        corners(&[0.0; 40], &[23; SAMPLED_TOGETHER], [1, 16], Instructions::PLAIN);
    }

    #[test]
    fn a_place_beyond_an_image_is_not_read_by_any_instruction() {
        let image: Vec<f32> = (0..40).map(|pixel| pixel as f32).collect();
        let mut first = [22; SAMPLED_TOGETHER];
        let upper = |first| std::panic::catch_unwind(|| vectorized_by(|with| corners(&image, &first, [1, 16], with)));
        assert_eq!(upper(first).unwrap().map(|corner| corner[5]), [22.0, 23.0, 38.0, 39.0]);
        for wrong in [23, i32::MAX, -1] {
            first[5] = wrong;
            assert!(upper(first).is_err(), "{wrong}");
        }
    }
}
