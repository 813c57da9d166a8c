//! The convolution of an image with packed weights. The image is written into a larger one with a border of zeros; what is written may
//! be activated on the way. Several threads compute one image in strips of rows, each from a bordered image of its own: the sums of a
//! place are the same in any strip, to the bit.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use rayon::prelude::*;

use super::byte_convolution::{ByteConvolution, ByteKernel};
use super::image_geometry::{ImageGeometry, TAPS};
use super::modulation::activate;
use super::packed::{PackedWeights, PlaceInputs, StartSums, TapRun};
use super::scratch::with_buffers;
use super::winograd::{PatchWeights, TileSize, TiledConvolution};
use crate::nn::precision::Precision;
use crate::vectorized::{Instructions, vectorized_by};

/// Least multiply–adds of a strip. A smaller one takes hardly longer than it takes to wake a thread.
const LEAST_OF_STRIP: usize = 1 << 19;

/// The weights of a convolution.
#[derive(Debug)]
pub(in crate::nn) struct PackedKernel {
    outputs: usize,
    /// For each place on its own.
    places: Option<PackedWeights>,
    /// For tiles of places, of a convolution without a stride; largest tiles first.
    patches: Vec<PatchWeights>,
    /// Of 8 bits, instead of the others.
    bytes: Option<ByteKernel>,
}

impl PackedKernel {
    /// For images of any size: weights `[9 · C, O]` and a bias `[O]`.
    pub(super) fn new(weights: &[f32], bias: &[f32], stride: usize, precision: Precision) -> Self {
        if precision == Precision::Int8 {
            return Self {
                outputs: bias.len(),
                places: None,
                patches: Vec::new(),
                bytes: Some(ByteKernel::new(weights, bias)),
            };
        }
        let sizes = [TileSize::Four, TileSize::Two].into_iter().filter(|_| stride == 1);
        Self {
            outputs: bias.len(),
            places: Some(PackedWeights::new(weights, bias)),
            patches: sizes
                .map(|size| PatchWeights::new(size, weights, bias, precision))
                .collect(),
            bytes: None,
        }
    }

    /// For images of one size only, with sums that are exact enough for gradients.
    pub(super) fn of_image(weights: &[f32], bias: &[f32], image: ImageGeometry) -> Self {
        let tiles = Some(TileSize::Two).filter(|size| size.fits(image, bias.len()));
        Self {
            outputs: bias.len(),
            places: tiles.is_none().then(|| PackedWeights::new(weights, bias)),
            patches: tiles
                .into_iter()
                .map(|size| PatchWeights::new(size, weights, bias, Precision::F32))
                .collect(),
            bytes: None,
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

impl Written<'_> {
    /// Writes neighbouring places `[places, channels]`, activated exactly or roughly.
    #[inline(always)]
    fn write<const ROUGHLY: bool>(self, from: &[f32], to: &mut [f32], channels: usize, instructions: Instructions) {
        match self {
            Written::Plain => to.copy_from_slice(from),
            Written::Silu => {
                for (to, &from) in to.iter_mut().zip(from) {
                    *to = activate::<ROUGHLY>(from, instructions);
                }
            }
            Written::Modulated(modulation) => {
                let (scale, shift) = modulation.split_at(channels);
                for (to, from) in to.chunks_exact_mut(channels).zip(from.chunks_exact(channels)) {
                    for (((to, from), scale), shift) in to.iter_mut().zip(from).zip(scale).zip(shift) {
                        *to = activate::<ROUGHLY>(instructions.multiply_add(*from, 1.0 + scale, *shift), instructions);
                    }
                }
            }
        }
    }
}

/// A convolution of images with a border of zeros.
pub(super) struct BorderedConvolution<'a> {
    /// The rows that one thread computes, as an image.
    strip: ImageGeometry,
    form: Form<'a>,
}

/// How the sums of a strip are computed.
enum Form<'a> {
    Tiles(TiledConvolution<'a>),
    Places(&'a PackedWeights, Vec<TapRun>),
    Bytes(ByteConvolution<'a>),
}

impl<'a> BorderedConvolution<'a> {
    /// Computes each image on one thread.
    pub(super) fn new(packed: &'a PackedKernel, image: ImageGeometry) -> Self {
        Self::in_strips(packed, image, 1)
    }

    /// Computes each image in at most that many strips, on the threads of the pool that it is called in.
    pub(super) fn in_strips(packed: &'a PackedKernel, image: ImageGeometry, strips: usize) -> Self {
        // A strip takes at least `LEAST_OF_STRIP` multiply–adds.
        let strips = strips.min(image.places() * TAPS * image.channels * packed.outputs / LEAST_OF_STRIP);
        if let Some(bytes) = &packed.bytes {
            return Self {
                strip: image,
                form: Form::Bytes(ByteConvolution::new(bytes, image, strips)),
            };
        }
        let mut patches = packed.patches.iter();
        let patches = patches.find(|patches| patches.size().fits(image, packed.outputs));
        let places = || {
            packed
                .places
                .as_ref()
                .expect("a kernel packed for another image is a bug")
        };
        let rows = match patches {
            Some(patches) => patches.size().side() * image.shape.dilation,
            None => image.shape.stride,
        };
        // All have the same rows.
        let strips = (2..=strips).filter(|strips| image.height.is_multiple_of(strips * rows));
        let strip = ImageGeometry {
            height: image.height / strips.max().unwrap_or(1),
            ..image
        };
        let form = match patches {
            Some(patches) => Form::Tiles(TiledConvolution::new(patches, strip)),
            None => Form::Places(places(), strip.runs().collect()),
        };
        Self { strip, form }
    }

    /// Computes one item.
    pub(super) fn forward(&self, x: &[f32], out: &mut [f32], start: StartSums, written: Written) {
        if let Form::Bytes(bytes) = &self.form {
            if matches!(written, Written::Plain) {
                return bytes.forward(x, out, start);
            }
            return with_buffers([x.len(), 0, 0], |[activated, ..]| {
                vectorized_by(
                    #[inline(always)]
                    |instructions| written.write::<true>(x, activated, self.strip.channels, instructions),
                );
                bytes.forward(activated, out, start);
            });
        }
        let length = self.strip.places() * self.outputs();
        if out.len() == length {
            return self.forward_strip(x, (0, out), start, written);
        }
        let strips = out.par_chunks_exact_mut(length).enumerate();
        strips.for_each(|strip| self.forward_strip(x, strip, start, written));
    }

    /// Computes the strip of an item with this number.
    fn forward_strip(&self, x: &[f32], (nth, out): (usize, &mut [f32]), start: StartSums, written: Written) {
        let bordered = (self.strip.height + 2 * self.strip.shape.dilation) * self.strip.pitch() * self.strip.channels;
        let [patches, products] = self.buffers();
        with_buffers([bordered, patches, products], |[bordered, patches, products]| {
            self.write(bordered, x, nth * self.strip.height, written);
            self.convolve(bordered, [patches, products], out, start);
        });
    }

    fn outputs(&self) -> usize {
        match &self.form {
            Form::Tiles(tiled) => tiled.outputs(),
            Form::Places(places, _) => places.outputs(),
            Form::Bytes(bytes) => bytes.outputs(),
        }
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
            Form::Places(..) | Form::Bytes(_) => [0; 2],
        }
    }

    fn convolve(&self, bordered: &[f32], buffers: [&mut [f32]; 2], out: &mut [f32], start: StartSums) {
        let ImageGeometry { channels, shape, .. } = self.strip;
        let (places, runs) = match &self.form {
            Form::Tiles(tiled) => return tiled.forward(bordered, buffers, out, start),
            Form::Places(places, runs) => (places, runs),
            Form::Bytes(_) => unreachable!("bytes with a border from elsewhere are a bug"),
        };
        let row_length = self.strip.out_width() * places.outputs();
        for (row, out) in out.chunks_exact_mut(row_length).enumerate() {
            let inputs = PlaceInputs {
                values: &bordered[row * shape.stride * self.strip.pitch() * channels..],
                step: shape.stride * channels,
                runs,
            };
            places.multiply(inputs, out, start);
        }
    }

    /// Writes the rows of an item from `first` on that a strip reads. Places outside the item are zero.
    fn write(&self, bordered: &mut [f32], x: &[f32], first: usize, written: Written) {
        let (channels, dilation) = (self.strip.channels, self.strip.shape.dilation);
        let (length, pitch) = (self.strip.width * channels, self.strip.pitch() * channels);
        vectorized_by(
            #[inline(always)]
            |instructions| {
                for (row, to) in bordered.chunks_exact_mut(pitch).enumerate() {
                    let from = (first + row).checked_sub(dilation);
                    let Some(from) = from.and_then(|row| x.get(row * length..(row + 1) * length)) else {
                        to.fill(0.0);
                        continue;
                    };
                    let (left, to) = to.split_at_mut(dilation * channels);
                    let (to, right) = to.split_at_mut(length);
                    left.fill(0.0);
                    right.fill(0.0);
                    written.write::<false>(from, to, channels, instructions);
                }
            },
        );
    }
}
