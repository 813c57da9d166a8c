//! Where the places, taps and border of a 3×3 convolution's image lie in memory.

use candle_core::{Layout, Shape};

use super::packed::TapRun;

/// Side of the kernel.
const SIDE: usize = 3;
/// Weights of one input channel for one output channel.
pub(in crate::nn) const TAPS: usize = SIDE * SIDE;

/// How a convolution samples its input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::nn) struct ConvShape {
    /// Input places from one output place to the next.
    pub(in crate::nn) stride: usize,
    /// Input places from one tap of the kernel to the next.
    pub(in crate::nn) dilation: usize,
}

impl ConvShape {
    /// Every place, neighbours side by side.
    pub(in crate::nn) const PLAIN: Self = Self { stride: 1, dilation: 1 };

    /// Every second place: half the sides.
    pub(in crate::nn) const HALVING: Self = Self { stride: 2, dilation: 1 };

    /// Every place, neighbours `dilation` places apart.
    pub(in crate::nn) const fn dilated(dilation: usize) -> Self {
        Self { stride: 1, dilation }
    }
}

/// Sizes of one image of a convolution.
#[derive(Clone, Copy)]
pub(super) struct ImageGeometry {
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) channels: usize,
    pub(super) shape: ConvShape,
}

/// Output places that one matrix product computes.
pub(super) struct PlaceBlock {
    /// The first row of output places.
    pub(super) row: usize,
    /// Where the kernel of the first place begins, in the values of the bordered image.
    pub(super) from: usize,
    /// Places, those that are not used included.
    pub(super) places: usize,
}

impl ImageGeometry {
    pub(super) fn of((_, height, width, channels): (usize, usize, usize, usize), shape: ConvShape) -> Self {
        Self {
            height,
            width,
            channels,
            shape,
        }
    }

    pub(super) fn out_height(self) -> usize {
        self.height.div_ceil(self.shape.stride)
    }

    pub(super) fn out_width(self) -> usize {
        self.width.div_ceil(self.shape.stride)
    }

    pub(super) fn places(self) -> usize {
        self.out_height() * self.out_width()
    }

    pub(super) fn inputs(self) -> usize {
        self.height * self.width * self.channels
    }

    /// Places in a row of the bordered image: `dilation` more on each side.
    pub(super) fn pitch(self) -> usize {
        self.width + 2 * self.shape.dilation
    }

    /// Where the first place inside the border begins.
    pub(super) fn inside(self) -> usize {
        self.shape.dilation * (self.pitch() + 1) * self.channels
    }

    /// All output places. Without a stride they are one block, in which the borders between rows count as places.
    pub(super) fn blocks(self) -> impl Iterator<Item = PlaceBlock> {
        let ConvShape { stride, dilation } = self.shape;
        let count = if stride == 1 { 1 } else { self.out_height() };
        (0..count).map(move |row| PlaceBlock {
            row,
            from: row * stride * self.pitch() * self.channels,
            places: match stride {
                1 => self.height * self.pitch() - 2 * dilation,
                _ => self.out_width(),
            },
        })
    }

    /// The taps: whole rows of the kernel where they are neighbours.
    pub(super) fn runs(self) -> impl Iterator<Item = TapRun> {
        let (channels, dilation) = (self.channels, self.shape.dilation);
        let columns = if dilation == 1 { 1 } else { SIDE };
        (0..SIDE).flat_map(move |row| {
            (0..columns).map(move |column| TapRun {
                offset: (row * self.pitch() + column) * dilation * channels,
                first: (row * SIDE + column) * channels,
                length: SIDE / columns * channels,
            })
        })
    }

    /// The matrix of a run's values at the places of a block, one place a row.
    pub(super) fn neighbours(self, block: &PlaceBlock, run: &TapRun) -> Layout {
        let steps = vec![self.shape.stride * self.channels, 1];
        Layout::new(Shape::from((block.places, run.length)), steps, block.from + run.offset)
    }
}
