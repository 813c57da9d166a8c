//! How far a whole image moved between two frames, by phase correlation (Kuglin & Hines 1975), and moving one.

use std::f32::consts::PI;
use std::sync::Arc;

use rustfft::num_complex::Complex32;
use rustfft::{Fft, FftPlanner};

/// A shift of the image content in pixels: positive is right and down.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shift {
    /// To the right.
    pub x_px: f32,
    /// Down.
    pub y_px: f32,
}

/// The global shift from `before` to `after`, both `width` pixels wide, to a fraction of a pixel.
/// Zero where the images are flat or equal.
#[must_use]
pub fn phase_correlation(before: &[f32], after: &[f32], width: usize) -> Shift {
    if before == after || width == 0 {
        return Shift::default();
    }
    let height = before.len() / width;
    let (columns, rows) = (width.next_power_of_two(), height.next_power_of_two());
    let spectrum_before = spectrum(before, width, columns, rows);
    let spectrum_after = spectrum(after, width, columns, rows);
    let mut cross: Vec<Complex32> = spectrum_after
        .iter()
        .zip(&spectrum_before)
        .map(|(after, before)| normalized(after * before.conj()))
        .collect();
    transform_2d(&mut cross, columns, FftPlanner::plan_fft_inverse);
    let surface: Vec<f32> = cross.iter().map(|value| value.re).collect();
    let peak = (0..surface.len()).max_by(|&a, &b| surface[a].total_cmp(&surface[b]));
    let Some(peak) = peak.filter(|&peak| surface[peak] > 0.0) else {
        return Shift::default();
    };
    let (x, y) = (peak % columns, peak / columns);
    let at = |x: usize, y: usize| surface[(y % rows) * columns + x % columns];
    Shift {
        x_px: signed(x, columns) + vertex(at(x + columns - 1, y), at(x, y), at(x + 1, y)),
        y_px: signed(y, rows) + vertex(at(x, y + rows - 1), at(x, y), at(x, y + 1)),
    }
}

/// The image moved by the shift, bilinear; new parts repeat the edge pixel.
#[must_use]
pub fn shifted(image: &[f32], width: usize, shift: Shift) -> Vec<f32> {
    if width == 0 || image.is_empty() {
        return Vec::new();
    }
    let height = image.len() / width;
    let columns: Vec<(usize, usize, f32)> = (0..width).map(|x| source(x, shift.x_px, width)).collect();
    (0..height)
        .flat_map(|y| {
            let (top, bottom, down) = source(y, shift.y_px, height);
            columns.iter().map(move |&(left, right, across)| {
                let row = |y: usize| mix(image[y * width + left], image[y * width + right], across);
                mix(row(top), row(bottom), down)
            })
        })
        .collect()
}

/// The two source positions of one axis and the weight of the second.
fn source(position: usize, shift_px: f32, len: usize) -> (usize, usize, f32) {
    let from = (position as f32 - shift_px).clamp(0.0, (len - 1) as f32);
    let first = from.floor();
    (first as usize, (first as usize + 1).min(len - 1), from - first)
}

fn mix(a: f32, b: f32, weight: f32) -> f32 {
    a + (b - a) * weight
}

/// Positions in the second half of a periodic axis are negative shifts.
fn signed(position: usize, len: usize) -> f32 {
    if position > len / 2 {
        position as f32 - len as f32
    } else {
        position as f32
    }
}

/// The place of the peak, −½ to ½, of the parabola through three neighbours.
fn vertex(before: f32, peak: f32, after: f32) -> f32 {
    let curvature = before - 2.0 * peak + after;
    if curvature < -1e-9 {
        (0.5 * (before - after) / curvature).clamp(-0.5, 0.5)
    } else {
        0.0
    }
}

fn normalized(value: Complex32) -> Complex32 {
    let length = value.norm();
    if length < 1e-6 { Complex32::ZERO } else { value / length }
}

/// Spectrum of the image without its mean, faded out at the border (Hann) so that the border does not correlate.
fn spectrum(image: &[f32], width: usize, columns: usize, rows: usize) -> Vec<Complex32> {
    let height = image.len() / width;
    let mean = image.iter().sum::<f32>() / image.len().max(1) as f32;
    let (across, down) = (hann(width), hann(height));
    let mut values = vec![Complex32::ZERO; columns * rows];
    for (y, row) in image.chunks_exact(width).enumerate() {
        for (x, pixel) in row.iter().enumerate() {
            values[y * columns + x].re = (pixel - mean) * across[x] * down[y];
        }
    }
    transform_2d(&mut values, columns, FftPlanner::plan_fft_forward);
    values
}

fn hann(len: usize) -> Vec<f32> {
    (0..len)
        .map(|i| 0.5 - 0.5 * (2.0 * PI * (i as f32 + 0.5) / len as f32).cos())
        .collect()
}

/// Discrete Fourier transform of rows, then columns, in one direction; not scaled.
fn transform_2d(values: &mut [Complex32], columns: usize, plan: fn(&mut FftPlanner<f32>, usize) -> Arc<dyn Fft<f32>>) {
    let rows = values.len() / columns;
    let mut planner = FftPlanner::new();
    plan(&mut planner, columns).process(values);
    let mut turned: Vec<Complex32> = (0..values.len())
        .map(|place| values[place % rows * columns + place / rows])
        .collect();
    plan(&mut planner, rows).process(&mut turned);
    for (place, value) in turned.into_iter().enumerate() {
        values[place % rows * columns + place / rows] = value;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::Rng;

    use super::*;
    use foreframe_core::types::Seed;

    fn textured(width: usize, height: usize) -> Vec<f32> {
        let mut rng = Seed(3).rng();
        let noise: Vec<f32> = (0..width * height).map(|_| rng.random()).collect();
        // Smooth a little so that fractions of a pixel mean something.
        shifted(&noise, width, Shift { x_px: 0.5, y_px: 0.5 })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn a_shift_by_whole_pixels_is_recovered(x in -9i32..=9, y in -9i32..=9, wide in any::<bool>()) {
            let (width, height) = if wide { (80, 60) } else { (64, 64) };
            let expected = Shift { x_px: x as f32, y_px: y as f32 };
            let before = textured(width, height);
            let found = phase_correlation(&before, &shifted(&before, width, expected), width);
            prop_assert!((found.x_px - expected.x_px).abs() < 0.35, "{found:?}");
            prop_assert!((found.y_px - expected.y_px).abs() < 0.35, "{found:?}");
        }
    }

    #[test]
    fn a_still_or_flat_scene_does_not_move() {
        let still = Shift { x_px: 0.0, y_px: 0.0 };
        let image = textured(16, 16);
        assert_eq!(phase_correlation(&image, &image, 16), still);
        assert_eq!(phase_correlation(&[0.2; 256], &[0.7; 256], 16), still);
    }

    #[test]
    fn a_transform_and_its_inverse_give_back_the_image() {
        let image = textured(8, 4);
        let mut values: Vec<Complex32> = image.iter().map(|&value| value.into()).collect();
        transform_2d(&mut values, 8, FftPlanner::plan_fft_forward);
        let sum: f32 = image.iter().sum();
        assert!((values[0].re - sum).abs() < 1e-4, "the first coefficient is the sum");
        transform_2d(&mut values, 8, FftPlanner::plan_fft_inverse);
        for (value, pixel) in values.iter().zip(&image) {
            assert!((value.re / 32.0 - pixel).abs() < 1e-5);
        }
    }

    #[test]
    fn new_parts_of_a_shifted_image_repeat_the_edge() {
        let moved = shifted(&[1.0, 2.0, 3.0, 4.0], 4, Shift { x_px: 1.5, y_px: 0.0 });
        assert_eq!(moved, [1.0, 1.0, 1.5, 2.5]);
    }
}
