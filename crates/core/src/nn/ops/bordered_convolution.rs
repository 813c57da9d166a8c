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
    /// For each place on its own.
    places: PackedWeights,
    /// For tiles of 2×2 places, of a convolution without a stride.
    patches: Option<PatchWeights>,
}

impl PackedKernel {
    /// Of weights `[9 · C, O]` and a bias `[O]`.
    pub(super) fn new(weights: &[f32], bias: &[f32], stride: usize) -> Self {
        Self {
            places: PackedWeights::new(weights, bias),
            patches: (stride == 1).then(|| PatchWeights::new(weights, bias)),
        }
    }

    pub(super) fn outputs(&self) -> usize {
        self.places.outputs()
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
    packed: &'a PackedKernel,
    image: ImageGeometry,
    runs: Vec<TapRun>,
    /// Where the weights fit.
    tiled: Option<TiledConvolution<'a>>,
}

impl<'a> BorderedConvolution<'a> {
    pub(super) fn new(packed: &'a PackedKernel, image: ImageGeometry) -> Self {
        let patches = packed.patches.as_ref().filter(|patches| patches.fit(image));
        Self {
            tiled: patches.map(|patches| TiledConvolution::new(patches, image)),
            packed,
            image,
            runs: image.runs().collect(),
        }
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
        self.tiled.as_ref().map_or([0; 2], TiledConvolution::buffers)
    }

    fn convolve(&self, bordered: &[f32], buffers: [&mut [f32]; 2], out: &mut [f32], start: StartSums) {
        match &self.tiled {
            Some(tiled) => tiled.forward(bordered, buffers, out, start),
            None => self.convolve_places(bordered, out, start),
        }
    }

    fn convolve_places(&self, bordered: &[f32], out: &mut [f32], start: StartSums) {
        let ImageGeometry { channels, shape, .. } = self.image;
        let row_length = self.image.out_width() * self.packed.places.outputs();
        for (row, out) in out.chunks_exact_mut(row_length).enumerate() {
            let inputs = PlaceInputs {
                values: &bordered[row * shape.stride * self.image.pitch() * channels..],
                step: shape.stride * channels,
                runs: &self.runs,
            };
            self.packed.places.multiply(inputs, out, start);
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
