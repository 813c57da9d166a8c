//! Bilinear sampling of images at places that lie between pixels.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};

use crate::nn::tensors::{slice, with_values};
use crate::vectorized::vectorized;

/// The four pixels around a place, and the shares of the right column and of the lower row.
#[derive(Clone, Copy)]
pub(in crate::nn) struct Neighbourhood {
    /// Indices of the upper left, upper right, lower left and lower right pixel.
    pub(in crate::nn) pixels: [usize; 4],
    pub(in crate::nn) right: f32,
    pub(in crate::nn) lower: f32,
    /// Whether the place is not beyond the border in x, in y: only then does the value change with the place.
    pub(in crate::nn) moves: [bool; 2],
}

/// Height and width of an image in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::nn) struct ImageSize {
    pub(in crate::nn) height: usize,
    pub(in crate::nn) width: usize,
}

impl ImageSize {
    pub(in crate::nn) fn pixels(self) -> usize {
        self.height * self.width
    }

    /// The size with both sides divided.
    pub(in crate::nn) fn shrunk(self, divisor: usize) -> Self {
        Self {
            height: self.height / divisor,
            width: self.width / divisor,
        }
    }

    /// Around the place [column, row], counted from the first pixel's middle; beyond the border, the border's pixel.
    #[inline(always)]
    pub(in crate::nn) fn around(self, x: f32, y: f32) -> Neighbourhood {
        let (last_x, last_y) = ((self.width - 1) as f32, (self.height - 1) as f32);
        let (inside_x, inside_y) = (x.clamp(0.0, last_x), y.clamp(0.0, last_y));
        let (left, top) = (inside_x as usize, inside_y as usize);
        let left = left.min(self.width.saturating_sub(2));
        let top = top.min(self.height.saturating_sub(2));
        let step_x = usize::from(self.width > 1);
        let step_y = if self.height > 1 { self.width } else { 0 };
        let first = top * self.width + left;
        Neighbourhood {
            pixels: [first, first + step_x, first + step_y, first + step_y + step_x],
            right: inside_x - left as f32,
            lower: inside_y - top as f32,
            moves: [(0.0..=last_x).contains(&x), (0.0..=last_y).contains(&y)],
        }
    }
}

impl Neighbourhood {
    /// The four pixels' shares.
    #[inline(always)]
    pub(in crate::nn) fn shares(self) -> [f32; 4] {
        let (left, upper) = (1.0 - self.right, 1.0 - self.lower);
        [
            upper * left,
            upper * self.right,
            self.lower * left,
            self.lower * self.right,
        ]
    }

    /// The value there of an image of one channel.
    #[inline(always)]
    pub(in crate::nn) fn sample(self, image: &[f32]) -> f32 {
        let [a, b, c, d] = self.pixels.map(|pixel| image[pixel]);
        let upper = a + (b - a) * self.right;
        upper + (c + (d - c) * self.right - upper) * self.lower
    }

    /// How the value there changes with the place's column and row.
    #[inline(always)]
    pub(in crate::nn) fn slopes(self, image: &[f32]) -> [f32; 2] {
        let [a, b, c, d] = self.pixels.map(|pixel| image[pixel]);
        let along = (b - a) + ((d - c) - (b - a)) * self.lower;
        let down = (c - a) + ((d - b) - (c - a)) * self.right;
        [
            if self.moves[0] { along } else { 0.0 },
            if self.moves[1] { down } else { 0.0 },
        ]
    }
}

/// Each pixel's own place in a frame, `[P, 2]`.
pub(in crate::nn) fn own_places(size: ImageSize) -> Vec<f32> {
    let rows = (0..size.height).flat_map(|row| (0..size.width).map(move |column| [column as f32, row as f32]));
    rows.flatten().collect()
}

/// Features `[B, h, w, C]` sampled at `places` (columns and rows, `[M, h, w, 2]`); item m samples image `image_of[m]`:
/// `[M, h, w, C]`. Zero where a place lies more than a pixel outside. Gradients go to the features only.
pub(in crate::nn) fn sample_features(features: &Tensor, places: Vec<f32>, image_of: &[u32]) -> Result<Tensor> {
    let features = features.contiguous()?;
    let operation = FeatureSampling {
        places,
        image_of: image_of.to_vec(),
    };
    if features.track_op() {
        features.apply_op1(operation)
    } else {
        features.apply_op1_no_bwd(&operation)
    }
}

struct FeatureSampling {
    places: Vec<f32>,
    image_of: Vec<u32>,
}

impl FeatureSampling {
    /// Calls `visit` with each output place, its image and its neighbourhood, where that is not outside.
    #[inline(always)]
    fn visit(&self, size: ImageSize, mut visit: impl FnMut(usize, usize, Neighbourhood)) {
        let (x_range, y_range) = (-1.0..=size.width as f32, -1.0..=size.height as f32);
        for (index, place) in self.places.chunks_exact(2).enumerate() {
            let (x, y) = (place[0], place[1]);
            if x_range.contains(&x) && y_range.contains(&y) {
                visit(index, self.image_of[index / size.pixels()] as usize, size.around(x, y));
            }
        }
    }
}

impl CustomOp1 for FeatureSampling {
    fn name(&self) -> &'static str {
        "sample-features"
    }

    fn cpu_fwd(&self, features: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (images, height, width, channels) = layout.shape().dims4()?;
        let size = ImageSize { height, width };
        let count = self.places.len() / 2;
        if count != size.pixels() * self.image_of.len() || self.image_of.iter().any(|&image| image as usize >= images) {
            bail!("{count} places do not fit {images} images of {width}×{height}");
        }
        let values = slice(features, layout)?;
        let mut out = vec![0.0; count * channels];
        vectorized(
            #[inline(always)]
            || {
                self.visit(
                    size,
                    #[inline(always)]
                    |index, image, around| {
                        let out = &mut out[index * channels..(index + 1) * channels];
                        for (pixel, share) in around.pixels.into_iter().zip(around.shares()) {
                            let from = (image * size.pixels() + pixel) * channels;
                            for (out, value) in out.iter_mut().zip(&values[from..from + channels]) {
                                *out += share * value;
                            }
                        }
                    },
                );
            },
        );
        Ok((
            CpuStorage::F32(out),
            Shape::from((count / size.pixels(), height, width, channels)),
        ))
    }

    fn bwd(&self, features: &Tensor, _y: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let (_, height, width, channels) = features.dims4()?;
        let size = ImageSize { height, width };
        let mut sums = vec![0.0; features.elem_count()];
        with_values(gradient, |gradient| {
            vectorized(
                #[inline(always)]
                || {
                    self.visit(
                        size,
                        #[inline(always)]
                        |index, image, around| {
                            let gradient = &gradient[index * channels..(index + 1) * channels];
                            for (pixel, share) in around.pixels.into_iter().zip(around.shares()) {
                                let to = (image * size.pixels() + pixel) * channels;
                                for (sum, value) in sums[to..to + channels].iter_mut().zip(gradient) {
                                    *sum += share * value;
                                }
                            }
                        },
                    );
                },
            );
        })?;
        Ok(Some(Tensor::from_vec(sums, features.dims(), features.device())?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise};

    #[test]
    fn a_place_between_pixels_mixes_the_four_around_it() {
        let size = ImageSize { height: 2, width: 3 };
        let image = [0.0, 1.0, 2.0, 10.0, 11.0, 12.0];
        assert_eq!(size.around(1.5, 0.25).sample(&image), 4.0);
        assert_eq!(size.around(-3.0, 9.0).sample(&image), 10.0);
        assert_eq!(size.around(1.5, 0.25).slopes(&image), [1.0, 10.0]);
        assert_eq!(size.around(-3.0, 0.5).slopes(&image), [0.0, 10.0]);
    }

    #[test]
    fn sampled_features_pass_their_gradients_on() {
        let features = noise(&[2, 3, 4, 2], 1);
        let places: Vec<f32> = noise(&[3 * 12 * 2], 2).to_vec1::<f32>().unwrap();
        let places: Vec<f32> = places.iter().map(|place| 3.0 * place + 1.0).collect();
        assert_gradients(&[features], 1e-2, |inputs| {
            sample_features(&inputs[0], places.clone(), &[0, 1, 1])
        });
    }
}
