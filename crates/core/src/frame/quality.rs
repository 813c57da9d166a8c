//! Measures of the similarity of two images. All functions take intensities 0…1, row by row, of equal length.

use super::preprocess::{convolve_separable, convolve_separable_adjoint, gaussian_kernel};

/// The window of Wang et al. 2004: 11 taps, sigma 1.5.
const SSIM_RADIUS_PX: usize = 5;
const SSIM_SIGMA_PX: f32 = 1.5;
/// (K1 · L)² and (K2 · L)² with K1 = 0.01, K2 = 0.03, L = 1 (Wang et al. 2004).
pub(crate) const SSIM_C1: f32 = 0.01 * 0.01;
pub(crate) const SSIM_C2: f32 = 0.03 * 0.03;

/// Side of the even window of scikit-image.
const EVEN_WINDOW_PX: usize = 7;

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
    SsimTerms::new(a, b, width).sum() / a.len().max(1) as f64
}

/// Structural similarity as scikit-image computes it by default (for a data range of 1): even windows of 7×7 px instead of
/// Gaussian ones, sample variances, averaged over the windows that lie inside the image. Benchmarks are published with it.
/// NaN for images with a side below 7 px.
#[must_use]
pub fn ssim_even(a: &[f32], b: &[f32], width: usize) -> f64 {
    let count = (EVEN_WINDOW_PX * EVEN_WINDOW_PX) as f64;
    let sample = count / (count - 1.0);
    let [a, b] = [a, b].map(|image| image.iter().map(|&value| f64::from(value)).collect::<Vec<f64>>());
    let product = |p: &[f64], q: &[f64]| p.iter().zip(q).map(|(p, q)| p * q).collect::<Vec<f64>>();
    let [mean_a, mean_b] = [&a, &b].map(|image| even_means(image, width));
    let [aa, bb, ab] = [(&a, &a), (&b, &b), (&a, &b)].map(|(p, q)| even_means(&product(p, q), width));
    let (c1, c2) = (f64::from(SSIM_C1), f64::from(SSIM_C2));
    let sum: f64 = (0..mean_a.len())
        .map(|at| {
            let (ma, mb) = (mean_a[at], mean_b[at]);
            let variances = sample * (aa[at] - ma * ma + bb[at] - mb * mb);
            let covariance = sample * (ab[at] - ma * mb);
            (2.0 * ma * mb + c1) * (2.0 * covariance + c2) / ((ma * ma + mb * mb + c1) * (variances + c2))
        })
        .sum();
    sum / mean_a.len() as f64
}

/// The mean of every window of 7×7 px that lies inside the image.
fn even_means(values: &[f64], width: usize) -> Vec<f64> {
    let along: Vec<f64> = values
        .chunks_exact(width)
        .flat_map(|row| row.windows(EVEN_WINDOW_PX).map(|window| window.iter().sum::<f64>()))
        .collect();
    let columns = (width + 1).saturating_sub(EVEN_WINDOW_PX).max(1);
    let rows: Vec<&[f64]> = along.chunks_exact(columns).collect();
    let area = (EVEN_WINDOW_PX * EVEN_WINDOW_PX) as f64;
    rows.windows(EVEN_WINDOW_PX)
        .flat_map(|window| (0..columns).map(move |column| window.iter().map(|row| row[column]).sum::<f64>() / area))
        .collect()
}

/// The shares of the pixels along one side of the window, from its first to its last.
pub(crate) fn ssim_kernel() -> Vec<f32> {
    gaussian_kernel(SSIM_SIGMA_PX, SSIM_RADIUS_PX)
}

/// What the structural similarity of two images is made of at each pixel.
pub struct SsimTerms<'a> {
    images: [&'a [f32]; 2],
    width: usize,
    kernel: Vec<f32>,
    means: [Vec<f32>; 2],
    /// Local means of the squares of both images, and of their product.
    products: [Vec<f32>; 3],
}

impl<'a> SsimTerms<'a> {
    /// The terms of two images of this width and of equal size.
    #[must_use]
    pub fn new(a: &'a [f32], b: &'a [f32], width: usize) -> Self {
        let kernel = ssim_kernel();
        let local_mean = |values: &[f32]| convolve_separable(values, width, &kernel);
        let product = |p: &[f32], q: &[f32]| p.iter().zip(q).map(|(p, q)| p * q).collect::<Vec<f32>>();
        let means = [local_mean(a), local_mean(b)];
        let products = [(a, a), (b, b), (a, b)].map(|(p, q)| local_mean(&product(p, q)));
        Self {
            images: [a, b],
            width,
            kernel,
            means,
            products,
        }
    }

    /// The similarity at a pixel is `luminance · structure / (energy · variance)`.
    fn factors(&self, pixel: usize) -> SsimFactors {
        let [ma, mb] = [self.means[0][pixel], self.means[1][pixel]];
        let [aa, bb, ab] = [0, 1, 2].map(|part: usize| self.products[part][pixel]);
        SsimFactors {
            means: [ma, mb],
            luminance: 2.0 * ma * mb + SSIM_C1,
            structure: 2.0 * (ab - ma * mb) + SSIM_C2,
            energy: ma * ma + mb * mb + SSIM_C1,
            variance: (aa - ma * ma) + (bb - mb * mb) + SSIM_C2,
        }
    }

    /// The sum over all pixels.
    pub fn sum(&self) -> f64 {
        (0..self.images[0].len())
            .map(|pixel| f64::from(self.factors(pixel).similarity()))
            .sum()
    }

    /// The gradient of [`SsimTerms::sum`] with respect to the first image.
    pub fn gradient(&self) -> Vec<f32> {
        let pixels = self.images[0].len();
        // With respect to the local mean, the local mean of the square, and that of the product.
        let (mut mean, mut square, mut product) = (Vec::with_capacity(pixels), vec![0.0; pixels], vec![0.0; pixels]);
        for pixel in 0..pixels {
            let factors = self.factors(pixel);
            let [ma, mb] = factors.means;
            let denominator = factors.energy * factors.variance;
            let similarity = factors.similarity();
            product[pixel] = 2.0 * factors.luminance / denominator;
            square[pixel] = -similarity / factors.variance;
            mean.push(
                2.0 * mb * (factors.structure - factors.luminance) / denominator
                    - 2.0 * ma * similarity * (1.0 / factors.energy - 1.0 / factors.variance),
            );
        }
        let adjoint = |values: &[f32]| convolve_separable_adjoint(values, self.width, &self.kernel);
        let [mean, square, product] = [&mean, &square, &product].map(|values| adjoint(values));
        let [a, b] = self.images;
        (0..pixels)
            .map(|pixel| mean[pixel] + 2.0 * a[pixel] * square[pixel] + b[pixel] * product[pixel])
            .collect()
    }
}

struct SsimFactors {
    means: [f32; 2],
    luminance: f32,
    structure: f32,
    energy: f32,
    variance: f32,
}

impl SsimFactors {
    fn similarity(&self) -> f32 {
        self.luminance * self.structure / (self.energy * self.variance)
    }
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

    #[test]
    fn the_gradient_of_ssim_matches_finite_differences() {
        let (width, pixels) = (14, 14 * 12);
        let wave = |step: f32, phase: f32| {
            (0..pixels)
                .map(|i| 0.5 + 0.4 * (i as f32 * step + phase).sin())
                .collect()
        };
        let (a, b): (Vec<f32>, Vec<f32>) = (wave(0.37, 0.0), wave(0.41, 0.8));
        let gradient = SsimTerms::new(&a, &b, width).gradient();
        for pixel in [0, 5, 13, 40, 77, 167] {
            let at = |change: f32| {
                let mut moved = a.clone();
                moved[pixel] += change;
                SsimTerms::new(&moved, &b, width).sum()
            };
            let slope = (at(2e-3) - at(-2e-3)) / 4e-3;
            assert!(
                (slope - f64::from(gradient[pixel])).abs() < 5e-3 * slope.abs().max(0.2),
                "{pixel}: {slope} {}",
                gradient[pixel]
            );
        }
    }
}
