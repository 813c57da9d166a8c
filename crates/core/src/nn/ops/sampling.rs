//! Bilinear sampling of images at places that lie between pixels.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Shape, Tensor, bail};

use super::gathering::{OfPlaces, SAMPLED_TOGETHER, corners, read_together};
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::vectorized::{Instructions, vectorized, whole};

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

    /// Whether a place lies on a pixel.
    #[inline(always)]
    pub(in crate::nn) fn shows(self, [x, y]: [f32; 2]) -> bool {
        (-0.5..=self.width as f32 - 0.5).contains(&x) && (-0.5..=self.height as f32 - 0.5).contains(&y)
    }

    /// How far a place lies outside the middles of the border's pixels: columns plus rows.
    #[inline(always)]
    pub(in crate::nn) fn outside(self, [x, y]: [f32; 2]) -> f32 {
        let beyond = |at: f32, side: usize| (-at).max(at - (side as f32 - 1.0)).max(0.0);
        beyond(x, self.width) + beyond(y, self.height)
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

/// A column or row as −1 to 1.
pub(in crate::nn) fn centred(at: usize, side: usize) -> f32 {
    (2.0 * at as f32 + 1.0) / side as f32 - 1.0
}

/// A place for each pixel of an image, as columns and rows.
#[derive(Clone, Copy)]
pub(in crate::nn) enum PixelPlaces<'a> {
    /// `[P, 2]`.
    Pairs(&'a [f32]),
    /// `[P]` each.
    Axes([&'a [f32]; 2]),
}

impl PixelPlaces<'_> {
    #[inline(always)]
    pub(in crate::nn) fn at(self, pixel: usize) -> [f32; 2] {
        match self {
            Self::Pairs(pairs) => [pairs[2 * pixel], pairs[2 * pixel + 1]],
            Self::Axes([x, y]) => [x[pixel], y[pixel]],
        }
    }

    /// Those of neighbouring pixels from one on; zeros after the last pixel.
    #[inline(always)]
    pub(in crate::nn) fn together(self, first: usize) -> [OfPlaces; 2] {
        let pairs = match self {
            Self::Axes([x, y]) => return [read_together(x, first), read_together(y, first)],
            Self::Pairs(pairs) => &pairs[2 * first..],
        };
        let mut read = [0.0; 2 * SAMPLED_TOGETHER];
        match pairs.first_chunk() {
            Some(pairs) => read = *pairs,
            None => read[..pairs.len()].copy_from_slice(pairs),
        }
        let mut together = [[0.0; SAMPLED_TOGETHER]; 2];
        for at in 0..SAMPLED_TOGETHER {
            [together[0][at], together[1][at]] = [read[2 * at], read[2 * at + 1]];
        }
        together
    }
}

/// An image of one channel, sampled in a vectorized loop.
#[derive(Clone, Copy)]
pub(in crate::nn) struct SampledImage<'a> {
    pub(in crate::nn) size: ImageSize,
    pub(in crate::nn) pixels: &'a [f32],
    /// Those of the loop.
    pub(in crate::nn) instructions: Instructions,
}

impl SampledImage<'_> {
    /// The values at several places: what [`ImageSize::around`] and [`Neighbourhood::sample`] give, to the bit.
    #[inline(always)]
    pub(in crate::nn) fn sample(self, [x, y]: &[OfPlaces; 2]) -> OfPlaces {
        let ImageSize { height, width } = self.size;
        let (last_x, last_y) = ((width - 1) as f32, (height - 1) as f32);
        let (most_left, most_top) = (width.saturating_sub(2) as i32, height.saturating_sub(2) as i32);
        let (mut first, mut right, mut lower) = (
            [0i32; SAMPLED_TOGETHER],
            [0.0; SAMPLED_TOGETHER],
            [0.0; SAMPLED_TOGETHER],
        );
        for at in 0..SAMPLED_TOGETHER {
            let (inside_x, inside_y) = (x[at].clamp(0.0, last_x), y[at].clamp(0.0, last_y));
            let (left, top) = (whole(inside_x).min(most_left), whole(inside_y).min(most_top));
            first[at] = top * width as i32 + left;
            right[at] = inside_x - left as f32;
            lower[at] = inside_y - top as f32;
        }
        let step_x = usize::from(width > 1);
        let step_y = if height > 1 { width } else { 0 };
        let [a, b, c, d] = corners(self.pixels, &first, [step_x, step_y], self.instructions);
        let mut values = [0.0; SAMPLED_TOGETHER];
        for at in 0..SAMPLED_TOGETHER {
            let upper = a[at] + (b[at] - a[at]) * right[at];
            values[at] = upper + (c[at] + (d[at] - c[at]) * right[at] - upper) * lower[at];
        }
        values
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
    let image_of = image_of.to_vec();
    apply(FeatureSampling { places, image_of }, [features])
}

struct FeatureSampling {
    places: Vec<f32>,
    image_of: Vec<u32>,
}

impl FeatureSampling {
    /// Calls `visit` with each output place, each pixel (among those of all images) around it, and that one's share. A
    /// place outside has none.
    #[inline(always)]
    fn visit(&self, size: ImageSize, mut visit: impl FnMut(usize, usize, f32)) {
        let (x_range, y_range) = (-1.0..=size.width as f32, -1.0..=size.height as f32);
        for (index, place) in self.places.chunks_exact(2).enumerate() {
            let (x, y) = (place[0], place[1]);
            if !x_range.contains(&x) || !y_range.contains(&y) {
                continue;
            }
            let around = size.around(x, y);
            let first = self.image_of[index / size.pixels()] as usize * size.pixels();
            for (pixel, share) in around.pixels.into_iter().zip(around.shares()) {
                visit(index, first + pixel, share);
            }
        }
    }
}

impl FusedOperation<1> for FeatureSampling {
    const NAME: &'static str = "sample-features";

    fn forward(&self, [features]: [Operand; 1]) -> Result<(Vec<f32>, Shape)> {
        let (images, height, width, channels) = features.layout.shape().dims4()?;
        let size = ImageSize { height, width };
        let (count, items) = (self.places.len() / 2, self.image_of.len());
        if count != size.pixels() * items || self.image_of.iter().any(|&image| image as usize >= images) {
            bail!("{count} places do not fit {images} images of {width}×{height}");
        }
        let of_place = |place: usize| place * channels..(place + 1) * channels;
        let mut out = vec![0.0; count * channels];
        vectorized(
            #[inline(always)]
            || {
                self.visit(
                    size,
                    #[inline(always)]
                    |index, pixel, share| {
                        add_scaled(&mut out[of_place(index)], &features.values[of_place(pixel)], share);
                    },
                );
            },
        );
        Ok((out, Shape::from((items, height, width, channels))))
    }

    fn backward(&self, [features]: [Operand; 1], _output: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 1]> {
        let (_, height, width, channels) = features.layout.shape().dims4()?;
        let of_place = |place: usize| place * channels..(place + 1) * channels;
        let mut sums = vec![0.0; features.values.len()];
        vectorized(
            #[inline(always)]
            || {
                self.visit(
                    ImageSize { height, width },
                    #[inline(always)]
                    |index, pixel, share| {
                        add_scaled(&mut sums[of_place(pixel)], &gradient.values[of_place(index)], share);
                    },
                );
            },
        );
        Ok([Some(sums)])
    }
}

/// Adds `share` times the values to the sums.
#[inline(always)]
fn add_scaled(sums: &mut [f32], values: &[f32], share: f32) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += share * value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise};
    use crate::vectorized::vectorized_by;

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
    fn places_sampled_together_have_the_bits_of_each() {
        for size in [ImageSize { height: 5, width: 7 }, ImageSize { height: 1, width: 1 }] {
            let image = noise(&[size.pixels()], 1).to_vec1::<f32>().unwrap();
            let places = noise(&[2, SAMPLED_TOGETHER], 2).affine(4.0, 3.0).unwrap();
            let [x, y] = [0, 1].map(|axis| {
                let of_places = places.get(axis).unwrap().to_vec1::<f32>().unwrap();
                OfPlaces::try_from(of_places).unwrap()
            });
            let together = |instructions| {
                let image = SampledImage {
                    size,
                    pixels: &image,
                    instructions,
                };
                image.sample(&[x, y])
            };
            for together in [together(Instructions::PLAIN), vectorized_by(together)] {
                for at in 0..SAMPLED_TOGETHER {
                    assert_eq!(together[at], size.around(x[at], y[at]).sample(&image));
                }
            }
        }
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
