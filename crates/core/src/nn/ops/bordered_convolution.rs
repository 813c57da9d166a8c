//! The convolution of an image with packed weights. The image is written into a larger one with a border of zeros; what is written may
//! be activated on the way.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use super::image_geometry::ImageGeometry;
use super::modulation::activate;
use super::packed::{PackedWeights, PlaceInputs, StartSums, TapRun};
use super::scratch::with_buffers;
use super::winograd::{PatchWeights, TiledConvolution};
use crate::vectorized::vectorized;

/// The weights of a convolution.
#[derive(Debug)]
pub(in crate::nn) struct PackedKernel {
    outputs: usize,
    /// For each place on its own.
    places: Option<PackedWeights>,
    /// For tiles of 2×2 places, of a convolution without a stride.
    patches: Option<PatchWeights>,
}

impl PackedKernel {
    /// For images of any size: weights `[9 · C, O]` and a bias `[O]`.
    pub(super) fn new(weights: &[f32], bias: &[f32], stride: usize) -> Self {
        Self {
            outputs: bias.len(),
            places: Some(PackedWeights::new(weights, bias)),
            patches: (stride == 1).then(|| PatchWeights::new(weights, bias)),
        }
    }

    /// For images of one size only.
    pub(super) fn of_image(weights: &[f32], bias: &[f32], image: ImageGeometry) -> Self {
        let is_tiled = PatchWeights::fit(image, bias.len());
        Self {
            outputs: bias.len(),
            places: (!is_tiled).then(|| PackedWeights::new(weights, bias)),
            patches: is_tiled.then(|| PatchWeights::new(weights, bias)),
        }
    }

    pub(super) fn outputs(&self) -> usize {
        self.outputs
    }
}

/// How an item's values are written into the bordered image.
#[derive(Clone, Copy)]
pub(super) enum Written<'a> {
    Plain,
    Silu,
    /// Scales and shifts.
    Modulated(&'a [f32]),
}

/// A convolution of images with a border of zeros.
pub(super) struct BorderedConvolution<'a> {
    image: ImageGeometry,
    form: Form<'a>,
}

/// How the sums are computed.
enum Form<'a> {
    Tiles(TiledConvolution<'a>),
    Places(&'a PackedWeights, Vec<TapRun>),
}

impl<'a> BorderedConvolution<'a> {
    pub(super) fn new(packed: &'a PackedKernel, image: ImageGeometry) -> Self {
        let patches = packed.patches.as_ref();
        let patches = patches.filter(|_| PatchWeights::fit(image, packed.outputs));
        let places = || {
            packed
                .places
                .as_ref()
                .expect("a kernel packed for another image is a bug")
        };
        let form = match patches {
            Some(patches) => Form::Tiles(TiledConvolution::new(patches, image)),
            None => Form::Places(places(), image.runs().collect()),
        };
        Self { image, form }
    }

    /// Computes one item.
    pub(super) fn forward(&self, x: &[f32], out: &mut [f32], start: StartSums, written: Written) {
        let bordered = (self.image.height + 2 * self.image.shape.dilation) * self.image.pitch() * self.image.channels;
        let [patches, products] = self.buffers();
        with_buffers([bordered, patches, products], |[bordered, patches, products]| {
            self.write(bordered, x, written);
            self.convolve(bordered, [patches, products], out, start);
        });
    }

    /// Computes one item that has its border.
    pub(super) fn forward_bordered(&self, bordered: &[f32], out: &mut [f32]) {
        let [patches, products] = self.buffers();
        with_buffers([patches, products, 0], |[patches, products, _]| {
            self.convolve(bordered, [patches, products], out, StartSums::Bias);
        });
    }

    fn buffers(&self) -> [usize; 2] {
        match &self.form {
            Form::Tiles(tiled) => tiled.buffers(),
            Form::Places(..) => [0; 2],
        }
    }

    fn convolve(&self, bordered: &[f32], buffers: [&mut [f32]; 2], out: &mut [f32], start: StartSums) {
        let ImageGeometry { channels, shape, .. } = self.image;
        let (places, runs) = match &self.form {
            Form::Tiles(tiled) => return tiled.forward(bordered, buffers, out, start),
            Form::Places(places, runs) => (places, runs),
        };
        let row_length = self.image.out_width() * places.outputs();
        for (row, out) in out.chunks_exact_mut(row_length).enumerate() {
            let inputs = PlaceInputs {
                values: &bordered[row * shape.stride * self.image.pitch() * channels..],
                step: shape.stride * channels,
                runs,
            };
            places.multiply(inputs, out, start);
        }
    }

    /// Writes an item with its border.
    fn write(&self, bordered: &mut [f32], x: &[f32], written: Written) {
        let image = self.image;
        let (length, pitch) = (image.width * image.channels, image.pitch() * image.channels);
        vectorized(
            #[inline(always)]
            || {
                let (above, rest) = bordered.split_at_mut(image.inside());
                above.fill(0.0);
                let (rows, below) = rest.split_at_mut(image.height * pitch);
                below.fill(0.0);
                for (to, from) in rows.chunks_exact_mut(pitch).zip(x.chunks_exact(length)) {
                    let (to, between) = to.split_at_mut(length);
                    between.fill(0.0);
                    match written {
                        Written::Plain => to.copy_from_slice(from),
                        Written::Silu => {
                            for (to, &from) in to.iter_mut().zip(from) {
                                *to = activate(from);
                            }
                        }
                        Written::Modulated(modulation) => {
                            let (scale, shift) = modulation.split_at(image.channels);
                            let places = to.chunks_exact_mut(image.channels);
                            for (to, from) in places.zip(from.chunks_exact(image.channels)) {
                                for (((to, from), scale), shift) in to.iter_mut().zip(from).zip(scale).zip(shift) {
                                    *to = activate(from * (1.0 + scale) + shift);
                                }
                            }
                        }
                    }
                }
            },
        );
    }
}
