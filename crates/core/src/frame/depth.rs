//! Distances in one byte a pixel, on a logarithmic scale.
//!
//! Byte `b` means `0.1 · 255^(b / 255)` metres: 0.1 m for 0, 25.5 m for 255, and 2.2 % more from one byte to the next. So a
//! distance within the range is off by at most 1.1 %; a distance outside of it becomes the nearer end.

use std::sync::LazyLock;

/// The distance of byte 0, in metres.
pub const NEAREST_M: f32 = 0.1;
/// The distance of byte 255, in metres.
pub const FARTHEST_M: f32 = 25.5;

/// The distance of each byte.
static DISTANCES_M: LazyLock<[f32; 256]> = LazyLock::new(|| {
    let ratio = f64::from(FARTHEST_M / NEAREST_M);
    std::array::from_fn(|byte| (f64::from(NEAREST_M) * ratio.powf(byte as f64 / 255.0)) as f32)
});

/// The byte of a distance in metres. NaN becomes 0.
#[must_use]
pub fn byte_of_m(distance_m: f32) -> u8 {
    let share = (distance_m / NEAREST_M).ln() / (FARTHEST_M / NEAREST_M).ln();
    // The cast of a float clamps to the byte's range.
    (255.0 * share).round() as u8
}

/// The distance of a byte, in metres.
#[must_use]
pub fn m_of_byte(byte: u8) -> f32 {
    DISTANCES_M[usize::from(byte)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_comes_back_from_its_distance() {
        for byte in 0..=u8::MAX {
            assert_eq!(byte_of_m(m_of_byte(byte)), byte);
        }
    }

    #[test]
    fn a_distance_is_off_by_at_most_one_percent() {
        for step in 0..1000 {
            let distance = 0.1 + 0.0254 * step as f32;
            let back = m_of_byte(byte_of_m(distance));
            assert!((back / distance - 1.0).abs() < 0.0112, "{distance} {back}");
        }
    }

    #[test]
    fn distances_beyond_the_range_become_its_ends() {
        let bytes = [0.0, -1.0, f32::NAN, 0.05, 26.0, f32::INFINITY].map(byte_of_m);
        assert_eq!(bytes, [0, 0, 0, 0, 255, 255]);
    }
}
