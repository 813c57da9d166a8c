//! Measures of the similarity of two images. All functions take intensities 0…1, row by row, of equal length.

use super::preprocess::{convolve_separable, gaussian_kernel};

/// The window of Wang et al. 2004: 11 taps, sigma 1.5.
const SSIM_RADIUS_PX: usize = 5;
const SSIM_SIGMA_PX: f32 = 1.5;
/// (K1 · L)² and (K2 · L)² with K1 = 0.01, K2 = 0.03, L = 1 (Wang et al. 2004).
const SSIM_C1: f32 = 0.01 * 0.01;
const SSIM_C2: f32 = 0.03 * 0.03;

/// Mean squared error per pixel.
#[must_use]
pub fn mse(a: &[f32], b: &[f32]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    sum / a.len().max(1) as f64
}

/// Peak signal-to-noise ratio in dB of a mean squared error, for a peak of 1. It is infinite for an error of 0.
#[must_use]
pub fn psnr_db(mse: f64) -> f64 {
    -10.0 * mse.log10()
}

/// Structural similarity, −1…1, averaged over all pixels (Wang et al. 2004). Outside the image, the edge pixel is
/// repeated.
#[must_use]
pub fn ssim(a: &[f32], b: &[f32], width: usize) -> f64 {
    let kernel = gaussian_kernel(SSIM_SIGMA_PX, SSIM_RADIUS_PX);
    let local_mean = |values: &[f32]| convolve_separable(values, width, &kernel);
    let product = |p: &[f32], q: &[f32]| p.iter().zip(q).map(|(p, q)| p * q).collect::<Vec<f32>>();
    let (mean_a, mean_b) = (local_mean(a), local_mean(b));
    let (aa, bb, ab) = (
        local_mean(&product(a, a)),
        local_mean(&product(b, b)),
        local_mean(&product(a, b)),
    );
    let sum: f64 = (0..a.len())
        .map(|i| {
            let (ma, mb) = (mean_a[i], mean_b[i]);
            let (va, vb, cov) = (aa[i] - ma * ma, bb[i] - mb * mb, ab[i] - ma * mb);
            let numerator = (2.0 * ma * mb + SSIM_C1) * (2.0 * cov + SSIM_C2);
            let denominator = (ma * ma + mb * mb + SSIM_C1) * (va + vb + SSIM_C2);
            f64::from(numerator / denominator)
        })
        .sum();
    sum / a.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> Vec<f32> {
        (0..256).map(|i| (i % 16) as f32 / 15.0).collect()
    }

    #[test]
    fn an_image_is_identical_to_itself() {
        assert_eq!(mse(&ramp(), &ramp()), 0.0);
        assert!((ssim(&ramp(), &ramp(), 16) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn an_error_of_one_tenth_is_20_db() {
        let shifted: Vec<f32> = ramp().iter().map(|value| value + 0.1).collect();
        assert!((psnr_db(mse(&ramp(), &shifted)) - 20.0).abs() < 1e-4);
    }

    #[test]
    fn ssim_of_flat_images_matches_the_formula() {
        let (a, b) = (vec![0.2; 256], vec![0.6; 256]);
        let expected = (2.0 * 0.12 + 1e-4) / (0.04 + 0.36 + 1e-4);
        assert!((ssim(&a, &b, 16) - expected).abs() < 1e-3);
    }
}
