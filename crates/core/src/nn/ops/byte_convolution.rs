//! The convolution of an image with weights of 8 bits. Its activated values become bytes with one scale and zero, in an image with a
//! border of zeros; the sums of each place are computed directly from them.

use rayon::prelude::*;

use super::image_geometry::{ConvShape, ImageGeometry, TAPS};
use super::packed::{StartSums, TapRun};
use super::reduced::{ByteRange, Group, PlaceGroups, ReducedWeights, inputs_of_group};
use super::scratch::with_groups;
use crate::nn::precision::Precision;

/// The weights of a convolution.
#[derive(Debug)]
pub(super) struct ByteKernel {
    weights: ReducedWeights,
}

impl ByteKernel {
    /// Of weights `[9 · C, O]` and a bias `[O]`.
    pub(super) fn new(weights: &[f32], bias: &[f32]) -> Self {
        let channels = weights.len() / (TAPS * bias.len()).max(1);
        Self {
            weights: ReducedWeights::new(weights, bias, channels, Precision::Int8),
        }
    }
}

/// The convolution of images of one size.
pub(super) struct ByteConvolution<'a> {
    kernel: &'a ByteKernel,
    /// Its channels are groups.
    grouped: ImageGeometry,
    channels: usize,
    runs: Vec<TapRun>,
    /// Rows of outputs that one thread computes.
    rows: usize,
}

impl<'a> ByteConvolution<'a> {
    /// Computes each image in at most that many parts, on the threads of the pool that it is called in.
    pub(super) fn new(kernel: &'a ByteKernel, image: ImageGeometry, parts: usize) -> Self {
        let channels = image.channels.div_ceil(inputs_of_group(Precision::Int8));
        let grouped = ImageGeometry { channels, ..image };
        Self {
            kernel,
            grouped,
            channels: image.channels,
            runs: grouped.runs().collect(),
            rows: image.out_height().div_ceil(parts.max(1)),
        }
    }

    pub(super) fn outputs(&self) -> usize {
        self.kernel.weights.outputs()
    }

    /// Computes one item of activated values.
    pub(super) fn forward(&self, activated: &[f32], out: &mut [f32], start: StartSums) {
        let ImageGeometry { height, shape, .. } = self.grouped;
        let length = (height + 2 * shape.dilation) * self.grouped.pitch() * self.grouped.channels;
        let range = ByteRange::of(activated);
        with_groups(length, |groups| {
            self.write(activated, range, groups);
            let groups = &*groups;
            let row = self.grouped.out_width() * self.kernel.weights.outputs();
            if self.rows == self.grouped.out_height() {
                return self.convolve(groups, range, (0, out), start);
            }
            let parts = out.par_chunks_mut(self.rows * row).enumerate();
            parts.for_each(|(part, out)| self.convolve(groups, range, (part * self.rows, out), start));
        });
    }

    /// Computes rows of outputs from `first` on.
    fn convolve(&self, groups: &[Group], range: ByteRange, (first, out): (usize, &mut [f32]), start: StartSums) {
        let ConvShape { stride, .. } = self.grouped.shape;
        let row_length = self.grouped.out_width() * self.kernel.weights.outputs();
        for (row, out) in out.chunks_exact_mut(row_length).enumerate() {
            let inputs = PlaceGroups {
                groups: &groups[(first + row) * stride * self.grouped.pitch() * self.grouped.channels..],
                step: stride * self.grouped.channels,
                runs: &self.runs,
                ranges: &[range],
            };
            self.kernel.weights.multiply(inputs, out, start);
        }
    }

    /// Writes an item with its border.
    fn write(&self, activated: &[f32], range: ByteRange, groups: &mut [Group]) {
        let ImageGeometry {
            width, channels, shape, ..
        } = self.grouped;
        let row = self.grouped.pitch() * channels;
        let (above, rest) = groups.split_at_mut(shape.dilation * row);
        above.fill([range.zero; 4]);
        let mut values = activated.chunks_exact(width * self.channels);
        for groups in rest.chunks_exact_mut(row) {
            let Some(values) = values.next() else {
                groups.fill([range.zero; 4]);
                continue;
            };
            let (left, groups) = groups.split_at_mut(shape.dilation * channels);
            let (inside, right) = groups.split_at_mut(width * channels);
            left.fill([range.zero; 4]);
            right.fill([range.zero; 4]);
            range.write(values, self.channels, inside);
        }
    }
}
