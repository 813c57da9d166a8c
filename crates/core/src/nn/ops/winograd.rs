//! 3×3 convolutions with fewer products: Winograd's minimal filtering F(2×2, 3×3) (Lavin & Gray 2016). Four outputs of a channel
//! take 16 products with each input channel instead of 36.
//!
//! Outputs are computed in tiles of 2×2. A tile reads a patch of 4×4 places, whose values are transformed into 16 other values by
//! additions; each is multiplied with its own matrix of weights, and additions transform the 16 sums into the four outputs. With a dilation
//! of d, the places of a tile and of its patch are d apart.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use pulp::{Arch, Simd, WithSimd};

use super::image_geometry::{ImageGeometry, TAPS};
use super::packed::{PackedWeights, StartSums, lanes};

/// Values of a patch of 4×4 places, and matrices of weights.
const PATCH: usize = 16;
/// Tiles that are computed together, so that what lies between the steps stays in the processor's cache.
const TILES_TOGETHER: usize = 16;
/// Values between the planes of a buffer, so that the planes do not map to the same sets of the cache.
const PLANE_PADDING: usize = 16;

/// The transformed weights of a convolution without a stride.
#[derive(Debug)]
pub(super) struct PatchWeights {
    bias: Vec<f32>,
    /// One `[C, O]` for each value of a patch.
    matrices: Vec<PackedWeights>,
}

/// Where a tile lies, in values.
#[derive(Clone, Copy)]
struct Tile {
    /// Its patch begins here in the bordered image.
    patch: usize,
    /// Its first output.
    output: usize,
}

/// The convolution of images of one size.
pub(super) struct TiledConvolution<'a> {
    weights: &'a PatchWeights,
    image: ImageGeometry,
    tiles: Vec<Tile>,
}

impl PatchWeights {
    /// Of weights `[9 · C, O]` and a bias `[O]`.
    pub(super) fn new(weights: &[f32], bias: &[f32]) -> Self {
        let outputs = bias.len();
        let tap_length = weights.len() / TAPS;
        let none = vec![0.0; outputs];
        let mut matrices = vec![vec![0.0; tap_length]; PATCH];
        for at in 0..tap_length {
            // G w Gᵀ of the kernel from one channel to another.
            let row = |row: usize| {
                transformed_taps(std::array::from_fn(|column| {
                    weights[(3 * row + column) * tap_length + at]
                }))
            };
            let rows = [0, 1, 2].map(row);
            for column in 0..4 {
                let column_of_taps = transformed_taps(rows.map(|row| row[column]));
                for (row, value) in column_of_taps.into_iter().enumerate() {
                    matrices[4 * row + column][at] = value;
                }
            }
        }
        Self {
            bias: bias.to_vec(),
            matrices: matrices
                .iter()
                .map(|matrix| PackedWeights::new(matrix, &none))
                .collect(),
        }
    }

    /// Whether tiles can be used for an image: it consists of whole ones, and its channels and the outputs fill vectors.
    pub(super) fn fit(image: ImageGeometry, outputs: usize) -> bool {
        let (side, lanes) = (2 * image.shape.dilation, lanes());
        image.shape.stride == 1
            && image.height.is_multiple_of(side)
            && image.width.is_multiple_of(side)
            && image.channels >= lanes
            && outputs.is_multiple_of(lanes)
    }
}

/// The filter transform G of the three taps of a row or column.
fn transformed_taps([first, second, third]: [f32; 3]) -> [f32; 4] {
    let ends = first + third;
    [first, 0.5 * (ends + second), 0.5 * (ends - second), third]
}

impl<'a> TiledConvolution<'a> {
    /// For an image that [fits](PatchWeights::fit).
    pub(super) fn new(weights: &'a PatchWeights, image: ImageGeometry) -> Self {
        let (outputs, dilation) = (weights.bias.len(), image.shape.dilation);
        let firsts = |side: usize| {
            let tiles = (0..side).step_by(2 * dilation);
            tiles.flat_map(move |first| first..first + dilation)
        };
        let tile = |row: usize, column: usize| Tile {
            patch: (row * image.pitch() + column) * image.channels,
            output: (row * image.width + column) * outputs,
        };
        let tiles: Vec<Tile> = firsts(image.height)
            .flat_map(|row| firsts(image.width).map(move |column| tile(row, column)))
            .collect();
        Self { weights, image, tiles }
    }

    /// Lengths of the two buffers that [`Self::forward`] needs.
    pub(super) fn buffers(&self) -> [usize; 2] {
        let together = TILES_TOGETHER.min(self.tiles.len());
        [self.image.channels, self.weights.bias.len()].map(|channels| PATCH * plane(together, channels))
    }

    /// Computes one image, which has a border of zeros, into `out` `[H, W, O]`. The buffers get planes, one for each value of a patch, of
    /// the tiles that are computed together: `[tiles, C]` and `[tiles, O]`, each with a padding.
    pub(super) fn forward(
        &self,
        bordered: &[f32],
        [all_patches, all_products]: [&mut [f32]; 2],
        out: &mut [f32],
        start: StartSums,
    ) {
        let (channels, outputs) = (self.image.channels, self.weights.bias.len());
        for tiles in self.tiles.chunks(TILES_TOGETHER) {
            Arch::new().dispatch(Patches {
                bordered,
                image: self.image,
                tiles,
                planes: all_patches,
            });
            let planes = all_patches.chunks_exact(plane(tiles.len(), channels));
            let sums = all_products.chunks_exact_mut(plane(tiles.len(), outputs));
            for (matrix, (patches, products)) in self.weights.matrices.iter().zip(planes.zip(sums)) {
                matrix.multiply_rows(
                    &patches[..tiles.len() * channels],
                    &mut products[..tiles.len() * outputs],
                );
            }
            Arch::new().dispatch(Outputs {
                products: all_products,
                image: self.image,
                tiles,
                bias: &self.weights.bias,
                start,
                out,
            });
        }
    }
}

/// From one plane of a buffer to the next, in values.
#[inline(always)]
fn plane(tiles: usize, channels: usize) -> usize {
    tiles * channels + PLANE_PADDING
}

/// Transforms the patches of tiles.
struct Patches<'a> {
    bordered: &'a [f32],
    image: ImageGeometry,
    tiles: &'a [Tile],
    planes: &'a mut [f32],
}

impl WithSimd for Patches<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let channels = self.image.channels;
        for (at, tile) in self.tiles.iter().enumerate() {
            for channel in (0..channels).step_by(S::F32_LANES) {
                // The last vector may overlap the one before.
                let channel = channel.min(channels - S::F32_LANES);
                self.patch(simd, tile.patch + channel, at * channels + channel);
            }
        }
    }
}

// Loops and closures over vectors would leave them in memory, so all rows and columns are named.
impl Patches<'_> {
    /// Some channels of a patch, which begins there in the image, to that place in the planes.
    #[inline(always)]
    fn patch<S: Simd>(&mut self, simd: S, from: usize, to: usize) {
        let (pitch, dilation) = (self.image.pitch() * self.image.channels, self.image.shape.dilation);
        let down = pitch * dilation;
        let rows = [
            self.row(simd, from),
            self.row(simd, from + down),
            self.row(simd, from + 2 * down),
            self.row(simd, from + 3 * down),
        ];
        self.column(simd, [rows[0][0], rows[1][0], rows[2][0], rows[3][0]], to, 0);
        self.column(simd, [rows[0][1], rows[1][1], rows[2][1], rows[3][1]], to, 1);
        self.column(simd, [rows[0][2], rows[1][2], rows[2][2], rows[3][2]], to, 2);
        self.column(simd, [rows[0][3], rows[1][3], rows[2][3], rows[3][3]], to, 3);
    }

    #[inline(always)]
    fn row<S: Simd>(&self, simd: S, from: usize) -> [S::f32s; 4] {
        let right = self.image.shape.dilation * self.image.channels;
        let values = [
            vector::<S>(self.bordered, from),
            vector::<S>(self.bordered, from + right),
            vector::<S>(self.bordered, from + 2 * right),
            vector::<S>(self.bordered, from + 3 * right),
        ];
        transformed_values(simd, values)
    }

    #[inline(always)]
    fn column<S: Simd>(&mut self, simd: S, values: [S::f32s; 4], to: usize, column: usize) {
        let plane = plane(self.tiles.len(), self.image.channels);
        let [first, second, third, fourth] = transformed_values(simd, values);
        let to = to + column * plane;
        set_vector::<S>(self.planes, to, first);
        set_vector::<S>(self.planes, to + 4 * plane, second);
        set_vector::<S>(self.planes, to + 8 * plane, third);
        set_vector::<S>(self.planes, to + 12 * plane, fourth);
    }
}

/// Transforms the sums of tiles into outputs.
struct Outputs<'a> {
    products: &'a [f32],
    image: ImageGeometry,
    tiles: &'a [Tile],
    bias: &'a [f32],
    start: StartSums,
    out: &'a mut [f32],
}

impl WithSimd for Outputs<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let outputs = self.bias.len();
        for (at, tile) in self.tiles.iter().enumerate() {
            for output in (0..outputs).step_by(S::F32_LANES) {
                let bias = vector::<S>(self.bias, output);
                self.tile(simd, at * outputs + output, tile.output + output, bias);
            }
        }
    }
}

impl Outputs<'_> {
    /// Some outputs of a tile, whose sums are at that place in the planes, to there.
    #[inline(always)]
    fn tile<S: Simd>(&mut self, simd: S, from: usize, to: usize, bias: S::f32s) {
        let (outputs, dilation) = (self.bias.len(), self.image.shape.dilation);
        let row = 4 * plane(self.tiles.len(), outputs);
        let rows = [
            self.row(simd, from),
            self.row(simd, from + row),
            self.row(simd, from + 2 * row),
            self.row(simd, from + 3 * row),
        ];
        self.column(simd, [rows[0][0], rows[1][0], rows[2][0], rows[3][0]], to, bias);
        let right = to + dilation * outputs;
        self.column(simd, [rows[0][1], rows[1][1], rows[2][1], rows[3][1]], right, bias);
    }

    #[inline(always)]
    fn row<S: Simd>(&self, simd: S, from: usize) -> [S::f32s; 2] {
        let plane = plane(self.tiles.len(), self.bias.len());
        let values = [
            vector::<S>(self.products, from),
            vector::<S>(self.products, from + plane),
            vector::<S>(self.products, from + 2 * plane),
            vector::<S>(self.products, from + 3 * plane),
        ];
        sums(simd, values)
    }

    #[inline(always)]
    fn column<S: Simd>(&mut self, simd: S, values: [S::f32s; 4], to: usize, bias: S::f32s) {
        let down = self.image.width * self.image.shape.dilation * self.bias.len();
        let [upper, lower] = sums(simd, values);
        self.write(simd, to, simd.add_f32s(upper, bias));
        self.write(simd, to + down, simd.add_f32s(lower, bias));
    }

    #[inline(always)]
    fn write<S: Simd>(&mut self, simd: S, to: usize, value: S::f32s) {
        let value = match self.start {
            StartSums::Bias => value,
            StartSums::Output => simd.add_f32s(value, vector::<S>(self.out, to)),
        };
        set_vector::<S>(self.out, to, value);
    }
}

#[inline(always)]
fn vector<S: Simd>(values: &[f32], from: usize) -> S::f32s {
    S::as_simd_f32s(&values[from..from + S::F32_LANES]).0[0]
}

#[inline(always)]
fn set_vector<S: Simd>(values: &mut [f32], from: usize, vector: S::f32s) {
    S::as_mut_simd_f32s(&mut values[from..from + S::F32_LANES]).0[0] = vector;
}

/// The data transform Bᵀ of four values.
#[inline(always)]
fn transformed_values<S: Simd>(simd: S, [first, second, third, fourth]: [S::f32s; 4]) -> [S::f32s; 4] {
    [
        simd.sub_f32s(first, third),
        simd.add_f32s(second, third),
        simd.sub_f32s(third, second),
        simd.sub_f32s(second, fourth),
    ]
}

/// The output transform Aᵀ of four sums.
#[inline(always)]
fn sums<S: Simd>(simd: S, [first, second, third, fourth]: [S::f32s; 4]) -> [S::f32s; 2] {
    [
        simd.add_f32s(simd.add_f32s(first, second), third),
        simd.sub_f32s(simd.sub_f32s(second, third), fourth),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::noise;
    use crate::nn::ops::image_geometry::ConvShape;

    #[test]
    fn tiles_give_the_sums_of_all_taps() {
        for (dilation, height, width, channels, outputs) in [
            (1, 2, 2, 16, 16),
            (1, 6, 4, 37, 16),
            (2, 8, 4, 17, 32),
            (4, 16, 16, 20, 48),
        ] {
            let image = ImageGeometry {
                height,
                width,
                channels,
                shape: ConvShape::dilated(dilation),
            };
            let values = |count: usize, seed: u64| noise(&[count], seed).to_vec1::<f32>().unwrap();
            let (x, weights, bias) = (
                values(image.inputs(), 1),
                values(TAPS * channels * outputs, 2),
                values(outputs, 3),
            );
            let mut bordered = vec![0.0; (height + 2 * dilation) * image.pitch() * channels];
            for (row, values) in x.chunks_exact(width * channels).enumerate() {
                bordered[image.inside() + row * image.pitch() * channels..][..values.len()].copy_from_slice(values);
            }
            let weights_of_patches = PatchWeights::new(&weights, &bias);
            assert!(PatchWeights::fit(image, outputs));
            let tiled = TiledConvolution::new(&weights_of_patches, image);
            let held = values(height * width * outputs, 4);
            let mut out = held.clone();
            let [mut patches, mut products] = tiled.buffers().map(|length| vec![0.0; length]);
            tiled.forward(&bordered, [&mut patches, &mut products], &mut out, StartSums::Output);
            for (index, (found, held)) in out.iter().zip(&held).enumerate() {
                let (place, output) = (index / outputs, index % outputs);
                let first = (place / width * image.pitch() + place % width) * channels;
                let products = (0..TAPS * channels).map(|input| {
                    let (tap, channel) = (input / channels, input % channels);
                    let neighbour = (tap / 3 * image.pitch() + tap % 3) * dilation * channels;
                    bordered[first + neighbour + channel] * weights[input * outputs + output]
                });
                let expected = held + bias[output] + products.sum::<f32>();
                assert!((found - expected).abs() < 2e-5, "{found} {expected}");
            }
        }
        let image = |height, channels, shape| ImageGeometry {
            height,
            width: 4,
            channels,
            shape,
        };
        assert!(PatchWeights::fit(image(4, 16, ConvShape::PLAIN), 16));
        assert!(
            !PatchWeights::fit(image(5, 16, ConvShape::PLAIN), 16)
                && !PatchWeights::fit(image(4, 0, ConvShape::PLAIN), 16)
        );
        assert!(
            !PatchWeights::fit(image(4, 16, ConvShape::HALVING), 16)
                && !PatchWeights::fit(image(4, 16, ConvShape::dilated(4)), 16)
        );
    }
}
