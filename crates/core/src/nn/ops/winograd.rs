//! 3×3 convolutions with fewer products: Winograd's minimal filtering F(4×4, 3×3) and F(2×2, 3×3) (Lavin & Gray 2016). A channel's
//! outputs in a tile of 4×4 take 36 products with each input channel instead of 144; those in a tile of 2×2 take 16 instead of 36.
//!
//! A tile of T×T outputs reads a patch of (T + 2)×(T + 2) places, whose values are transformed into as many other values by additions
//! and factors; each is multiplied with its own matrix of weights, and the sums are transformed into the outputs. With a dilation of d,
//! the places of a tile and of its patch are d apart.

mod transforms;

use super::image_geometry::{ImageGeometry, TAPS};
use super::packed::{StartSums, lanes};
use super::row_weights::RowWeights;
use crate::nn::precision::Precision;
use transforms::{transformed_taps, write_outputs, write_patches};

/// Tiles that are computed together, so that what lies between the steps stays in the processor's cache.
const TILES_TOGETHER: usize = 16;
/// Values between the planes of a buffer, so that the planes do not map to the same sets of the cache.
const PLANE_PADDING: usize = 16;

/// How large tiles are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum TileSize {
    /// 2×2: sums are nearly as exact as those of all taps.
    Two,
    /// 4×4: for prediction only, since errors of rounding are about five times as large.
    Four,
}

impl TileSize {
    /// Outputs of a tile's side.
    pub(super) fn side(self) -> usize {
        match self {
            Self::Two => 2,
            Self::Four => 4,
        }
    }

    fn patch_side(self) -> usize {
        self.side() + 2
    }

    /// Whether such tiles can be used for an image: it consists of whole ones, and its channels fill vectors, as do the outputs of
    /// small tiles.
    pub(super) fn fits(self, image: ImageGeometry, outputs: usize) -> bool {
        let (side, lanes) = (self.side() * image.shape.dilation, lanes());
        image.shape.stride == 1
            && image.height.is_multiple_of(side)
            && image.width.is_multiple_of(side)
            && image.channels >= lanes
            && (self == Self::Four || outputs.is_multiple_of(lanes))
    }
}

/// The transformed weights of a convolution without a stride.
#[derive(Debug)]
pub(super) struct PatchWeights {
    size: TileSize,
    outputs: usize,
    /// Filled up with zeros to whole vectors, as the outputs of the matrices are.
    bias: Vec<f32>,
    /// One `[C, bias.len()]` for each value of a patch.
    matrices: Vec<RowWeights>,
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
    pub(super) fn new(size: TileSize, weights: &[f32], bias: &[f32], precision: Precision) -> Self {
        let (outputs, side) = (bias.len(), size.patch_side());
        let mut filled_bias = bias.to_vec();
        filled_bias.resize(outputs.next_multiple_of(lanes()), 0.0);
        let width = filled_bias.len();
        let tap_length = weights.len() / TAPS;
        let mut matrices = vec![vec![0.0; tap_length / outputs * width]; side * side];
        for at in 0..tap_length {
            // G w Gᵀ of the kernel from one channel to another.
            let row = |row: usize| {
                let taps = std::array::from_fn(|column| weights[(3 * row + column) * tap_length + at]);
                transformed_taps(size, taps)
            };
            let rows = [0, 1, 2].map(row);
            for column in 0..side {
                let column_of_taps = transformed_taps(size, rows.map(|row| row[column]));
                for (row, value) in column_of_taps.into_iter().take(side).enumerate() {
                    matrices[side * row + column][at / outputs * width + at % outputs] = value;
                }
            }
        }
        let none = vec![0.0; width];
        Self {
            size,
            outputs,
            bias: filled_bias,
            matrices: matrices
                .iter()
                .map(|matrix| RowWeights::new(matrix, &none, precision))
                .collect(),
        }
    }

    pub(super) fn size(&self) -> TileSize {
        self.size
    }
}

impl<'a> TiledConvolution<'a> {
    /// For an image that [fits](TileSize::fits).
    pub(super) fn new(weights: &'a PatchWeights, image: ImageGeometry) -> Self {
        let (outputs, dilation) = (weights.outputs, image.shape.dilation);
        let firsts = |side: usize| {
            let tiles = (0..side).step_by(weights.size.side() * dilation);
            tiles.flat_map(move |first| first..first + dilation)
        };
        let tile = |row: usize, column: usize| Tile {
            patch: (row * image.pitch() + column) * image.channels,
            output: (row * image.width + column) * outputs,
        };
        let mut tiles = Vec::with_capacity(image.places() / weights.size.side().pow(2));
        for row in firsts(image.height) {
            tiles.extend(firsts(image.width).map(|column| tile(row, column)));
        }
        Self { weights, image, tiles }
    }

    pub(super) fn outputs(&self) -> usize {
        self.weights.outputs
    }

    /// Lengths of the two buffers that [`Self::forward`] needs.
    pub(super) fn buffers(&self) -> [usize; 2] {
        let (together, values) = (TILES_TOGETHER.min(self.tiles.len()), self.weights.matrices.len());
        [self.image.channels, self.weights.bias.len()].map(|channels| values * plane(together, channels))
    }

    /// Computes one image, which has a border, into `out` `[H, W, O]`. The buffers get planes, one for each value of a patch, of
    /// the tiles that are computed together: `[tiles, C]` and `[tiles, bias.len()]`, each with a padding.
    pub(super) fn forward(
        &self,
        bordered: &[f32],
        [all_patches, all_products]: [&mut [f32]; 2],
        out: &mut [f32],
        start: StartSums,
    ) {
        let (channels, width) = (self.image.channels, self.weights.bias.len());
        for tiles in self.tiles.chunks(TILES_TOGETHER) {
            write_patches(self, tiles, bordered, all_patches);
            let planes = all_patches.chunks_exact(plane(tiles.len(), channels));
            let sums = all_products.chunks_exact_mut(plane(tiles.len(), width));
            for (matrix, (patches, products)) in self.weights.matrices.iter().zip(planes.zip(sums)) {
                matrix.multiply_rows(&patches[..tiles.len() * channels], &mut products[..tiles.len() * width]);
            }
            write_outputs(self, tiles, all_products, out, start);
        }
    }
}

/// From one plane of a buffer to the next, in values.
fn plane(tiles: usize, channels: usize) -> usize {
    tiles * channels + PLANE_PADDING
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::noise;
    use crate::nn::ops::image_geometry::ConvShape;

    #[test]
    fn tiles_give_the_sums_of_all_taps() {
        for (size, dilation, height, width, channels, outputs) in [
            (TileSize::Two, 1, 2, 2, 16, 16),
            (TileSize::Two, 1, 6, 4, 37, 16),
            (TileSize::Two, 2, 8, 4, 17, 32),
            (TileSize::Two, 4, 16, 16, 20, 48),
            (TileSize::Four, 1, 4, 4, 16, 16),
            (TileSize::Four, 1, 8, 4, 37, 4),
            (TileSize::Four, 2, 16, 8, 17, 25),
            (TileSize::Four, 4, 16, 16, 20, 48),
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
            let weights_of_patches = PatchWeights::new(size, &weights, &bias, Precision::F32);
            assert!(size.fits(image, outputs));
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
        assert!(TileSize::Two.fits(image(4, 16, ConvShape::PLAIN), 16));
        assert!(
            !TileSize::Two.fits(image(5, 16, ConvShape::PLAIN), 16)
                && !TileSize::Two.fits(image(4, 0, ConvShape::PLAIN), 16)
        );
        assert!(
            !TileSize::Two.fits(image(4, 16, ConvShape::HALVING), 16)
                && !TileSize::Two.fits(image(4, 16, ConvShape::dilated(4)), 16)
        );
    }
}
