//! Converts frames to the model's value range and back: Gaussian smoothing, inversion I = 255 − I, scaling to 0…1 (paper,
//! Experimental Setup). The way back undoes scaling and inversion, but not smoothing.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use serde::{Deserialize, Serialize};

use super::{Frame, FrameError};
use crate::vectorized::{vectorized, whole};

/// How frames are converted to the model's value range.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Preprocess {
    /// Standard deviation of the Gaussian smoothing, in pixels; 0 means no smoothing.
    pub blur_sigma_px: f32,
    /// Whether intensities are inverted, I = 255 − I.
    pub invert: bool,
}

impl Default for Preprocess {
    fn default() -> Self {
        Self {
            blur_sigma_px: 0.7,
            invert: true,
        }
    }
}

impl Preprocess {
    /// The frame in the model's value range, 0…1, row by row.
    #[must_use]
    pub fn forward(&self, frame: &Frame) -> Vec<f32> {
        let scaled = scale(frame.pixels());
        let mut values = if self.blur_sigma_px > 0.0 {
            let kernel = gaussian_kernel(self.blur_sigma_px, (3.0 * self.blur_sigma_px).ceil() as usize);
            convolve_separable(&scaled, frame.width() as usize, &kernel)
        } else {
            scaled
        };
        if self.invert {
            invert_intensity(&mut values);
        }
        values
    }

    /// Converts values of the model back to camera intensities, clamped to 0…1.
    #[must_use]
    pub fn inverse(&self, values: &[f32]) -> Vec<f32> {
        vectorized(
            #[inline(always)]
            || values.iter().map(|value| self.intensity(*value)).collect(),
        )
    }

    /// Converts values of the model back to a frame. Errors: `NotFinite` at a NaN or infinity, `PixelCount`, `Size`.
    pub fn frame_from(&self, values: &[f32], width: u32, height: u32) -> Result<Frame, FrameError> {
        let mut pixels = vec![0; values.len()];
        let all_finite = vectorized(
            #[inline(always)]
            || {
                for (pixel, value) in pixels.iter_mut().zip(values) {
                    // `whole` cuts the fraction off, so adding 0.5 rounds.
                    *pixel = whole(self.intensity(*value) * 255.0 + 0.5) as u8;
                }
                // `fold` has no early exit, so the compiler can vectorize it.
                values.iter().fold(true, |all, value| all & value.is_finite())
            },
        );
        // The search by index runs only after a failure.
        if !all_finite && let Some(index) = values.iter().position(|value| !value.is_finite()) {
            return Err(FrameError::NotFinite {
                index,
                value: values[index],
            });
        }
        Frame::new(width, height, pixels)
    }

    /// The intensity of the camera that a value of the model stands for, 0…1.
    #[inline(always)]
    fn intensity(self, value: f32) -> f32 {
        let value = value.clamp(0.0, 1.0);
        if self.invert { 1.0 - value } else { value }
    }
}

/// Scales 8-bit intensities to 0…1.
#[must_use]
pub fn scale(pixels: &[u8]) -> Vec<f32> {
    vectorized(
        #[inline(always)]
        || pixels.iter().map(|&value| f32::from(value) / 255.0).collect(),
    )
}

/// Inverts intensities that are scaled to 0…1: I = 1 − I.
pub fn invert_intensity(values: &mut [f32]) {
    vectorized(
        #[inline(always)]
        || {
            for value in values {
                *value = 1.0 - *value;
            }
        },
    );
}

/// A normalized Gaussian kernel of `2 · radius + 1` weights.
pub(super) fn gaussian_kernel(sigma: f32, radius: usize) -> Vec<f32> {
    let mut kernel: Vec<f32> = (0..=2 * radius)
        .map(|i| {
            let distance = (i as f32 - radius as f32) / sigma;
            (-0.5 * distance * distance).exp()
        })
        .collect();
    let sum: f32 = kernel.iter().sum();
    for weight in &mut kernel {
        *weight /= sum;
    }
    kernel
}

/// Convolves rows, then columns, with the same kernel of odd length. Outside the image, the edge pixel is repeated.
pub(super) fn convolve_separable(values: &[f32], width: usize, kernel: &[f32]) -> Vec<f32> {
    vectorized(
        #[inline(always)]
        || rows_then_columns(values, width, kernel),
    )
}

#[inline(always)]
fn rows_then_columns(values: &[f32], width: usize, kernel: &[f32]) -> Vec<f32> {
    let height = values.len() / width;
    let radius = kernel.len() / 2;
    let mut rows = vec![0.0; values.len()];
    let mut padded = vec![0.0; width + 2 * radius];
    for (row, out) in values.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        padded[..radius].fill(row[0]);
        padded[radius..radius + width].copy_from_slice(row);
        padded[radius + width..].fill(row[width - 1]);
        weighted_sums(
            out,
            kernel,
            #[inline(always)]
            |tap| &padded[tap..tap + width],
        );
    }
    let mut result = vec![0.0; values.len()];
    for (y, out) in result.chunks_exact_mut(width).enumerate() {
        weighted_sums(
            out,
            kernel,
            #[inline(always)]
            |tap| {
                let from = (y + tap).saturating_sub(radius).min(height - 1) * width;
                &rows[from..from + width]
            },
        );
    }
    result
}

/// The adjoint of [`convolve_separable`]: the gradient of what it was given, from the gradient of its result.
pub(super) fn convolve_separable_adjoint(gradient: &[f32], width: usize, kernel: &[f32]) -> Vec<f32> {
    vectorized(
        #[inline(always)]
        || columns_then_rows(gradient, width, kernel),
    )
}

#[inline(always)]
fn columns_then_rows(gradient: &[f32], width: usize, kernel: &[f32]) -> Vec<f32> {
    let height = gradient.len() / width;
    let radius = kernel.len() / 2;
    let mut rows = vec![0.0; gradient.len()];
    for (y, gradient) in gradient.chunks_exact(width).enumerate() {
        for (tap, weight) in kernel.iter().enumerate() {
            let from = (y + tap).saturating_sub(radius).min(height - 1) * width;
            add_scaled(&mut rows[from..from + width], gradient, *weight);
        }
    }
    let mut result = Vec::with_capacity(gradient.len());
    let mut padded = vec![0.0; width + 2 * radius];
    for row in rows.chunks_exact(width) {
        padded.fill(0.0);
        for (tap, weight) in kernel.iter().enumerate() {
            add_scaled(&mut padded[tap..tap + width], row, *weight);
        }
        // The edge pixel was read wherever the kernel reached beyond the image.
        padded[radius] += padded[..radius].iter().sum::<f32>();
        padded[radius + width - 1] += padded[radius + width..].iter().sum::<f32>();
        result.extend_from_slice(&padded[radius..radius + width]);
    }
    result
}

/// The sums of values for each tap of a kernel, times its weights. Those of a whole vector stay in registers.
#[inline(always)]
fn weighted_sums<'a>(out: &mut [f32], kernel: &[f32], values: impl Fn(usize) -> &'a [f32]) {
    const LANES: usize = 16;
    let (vectors, rest) = out.as_chunks_mut::<LANES>();
    let done = vectors.len();
    for (index, out) in vectors.iter_mut().enumerate() {
        let mut sums = [0.0; LANES];
        for (tap, weight) in kernel.iter().enumerate() {
            let values = &values(tap).as_chunks::<LANES>().0[index];
            for lane in 0..LANES {
                sums[lane] += weight * values[lane];
            }
        }
        *out = sums;
    }
    rest.fill(0.0);
    for (tap, weight) in kernel.iter().enumerate() {
        add_scaled(rest, &values(tap)[done * LANES..], *weight);
    }
}

#[inline(always)]
fn add_scaled(out: &mut [f32], values: &[f32], weight: f32) {
    for (out, value) in out.iter_mut().zip(values) {
        *out += weight * value;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn inverting_twice_restores_every_intensity(pixels in proptest::collection::vec(any::<u8>(), 16)) {
            let frame = Frame::new(4, 4, pixels).unwrap();
            let preprocess = Preprocess { blur_sigma_px: 0.0, invert: true };
            let values = preprocess.forward(&frame);
            prop_assert_eq!(preprocess.frame_from(&values, 4, 4).unwrap(), frame);
        }

        #[test]
        fn smoothing_keeps_a_flat_image(value in any::<u8>(), sigma in 0.1f32..3.0) {
            let frame = Frame::new(9, 7, vec![value; 63]).unwrap();
            let preprocess = Preprocess { blur_sigma_px: sigma, invert: false };
            for out in preprocess.forward(&frame) {
                prop_assert!((out - f32::from(value) / 255.0).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn black_becomes_one_after_inversion() {
        let frame = Frame::new(1, 1, vec![0]).unwrap();
        assert_eq!(Preprocess::default().forward(&frame), [1.0]);
    }

    #[test]
    fn a_point_is_smoothed_to_a_gaussian() {
        let mut pixels = vec![0; 49];
        pixels[24] = 255;
        let frame = Frame::new(7, 7, pixels).unwrap();
        let preprocess = Preprocess {
            blur_sigma_px: 0.7,
            invert: false,
        };
        let values = preprocess.forward(&frame);
        let expected = (-0.5f32 / 0.49).exp();
        assert!((values[25] / values[24] - expected).abs() < 1e-4);
    }

    #[test]
    fn a_nan_is_refused_with_its_position() {
        let error = Preprocess::default().frame_from(&[0.5, f32::NAN], 2, 1).unwrap_err();
        assert!(error.to_string().starts_with("pixel 1 is NaN"));
    }
}
