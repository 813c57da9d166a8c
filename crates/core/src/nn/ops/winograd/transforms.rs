//! The transforms of Winograd's minimal filtering. Those of tiles of 2×2 are Lavin & Gray's; those of tiles of 4×4 use the points
//! 0, ±1/√2, ±√2 and ∞ instead of their 0, ±1, ±2 and ∞, which makes the largest errors of rounding a quarter.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::f32::consts::{FRAC_1_SQRT_2, SQRT_2};

use pulp::{Arch, Simd, WithSimd};

use super::{Tile, TileSize, TiledConvolution, plane};
use crate::nn::ops::packed::StartSums;

/// Sides of the patches of small and of large tiles.
const SMALL: usize = 4;
const LARGE: usize = 6;

/// The filter transform G of the three taps of a row or column: as many values as a patch has in a row, then zeros.
pub(super) fn transformed_taps(size: TileSize, [first, second, third]: [f32; 3]) -> [f32; LARGE] {
    match size {
        TileSize::Two => {
            let ends = first + third;
            [first, 0.5 * (ends + second), 0.5 * (ends - second), third, 0.0, 0.0]
        }
        TileSize::Four => {
            let (near, near_odd) = ((2.0 * first + third) / -3.0, second * SQRT_2 / -3.0);
            let (far, far_odd) = ((first + 2.0 * third) / 6.0, second * SQRT_2 / 6.0);
            [
                first,
                near + near_odd,
                near - near_odd,
                far + far_odd,
                far - far_odd,
                third,
            ]
        }
    }
}

/// Writes the transformed patches of tiles of a bordered image to planes, one for each value of a patch.
pub(super) fn write_patches(convolution: &TiledConvolution, tiles: &[Tile], bordered: &[f32], planes: &mut [f32]) {
    let arch = Arch::new();
    match convolution.weights.size {
        TileSize::Two => arch.dispatch(Patches::<SMALL> {
            convolution,
            tiles,
            bordered,
            planes,
        }),
        TileSize::Four => arch.dispatch(Patches::<LARGE> {
            convolution,
            tiles,
            bordered,
            planes,
        }),
    }
}

/// Writes the outputs of tiles whose sums are in planes, one for each value of a patch.
pub(super) fn write_outputs(
    convolution: &TiledConvolution,
    tiles: &[Tile],
    planes: &[f32],
    out: &mut [f32],
    start: StartSums,
) {
    let arch = Arch::new();
    match convolution.weights.size {
        TileSize::Two => arch.dispatch(Outputs::<SMALL> {
            convolution,
            tiles,
            planes,
            out,
            start,
        }),
        TileSize::Four => arch.dispatch(Outputs::<LARGE> {
            convolution,
            tiles,
            planes,
            out,
            start,
        }),
    }
}

/// Vectors of a patch. Where a vector lies in two lines of the cache, it takes longer to read and to write.
#[repr(align(64))]
struct PatchValues<V, const SIDE: usize>([[V; SIDE]; SIDE]);

struct Patches<'a, const SIDE: usize> {
    convolution: &'a TiledConvolution<'a>,
    tiles: &'a [Tile],
    bordered: &'a [f32],
    planes: &'a mut [f32],
}

impl<const SIDE: usize> WithSimd for Patches<'_, SIDE> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let channels = self.convolution.image.channels;
        let mut values = PatchValues([[simd.splat_f32s(0.0); SIDE]; SIDE]);
        for (at, tile) in self.tiles.iter().enumerate() {
            for channel in (0..channels).step_by(S::F32_LANES) {
                // The last vector may overlap the one before.
                let channel = channel.min(channels - S::F32_LANES);
                self.patch(simd, tile.patch + channel, at * channels + channel, &mut values.0);
            }
        }
    }
}

// Indices instead of iterators and closures, which would leave the vectors in memory.
#[allow(clippy::needless_range_loop)]
impl<const SIDE: usize> Patches<'_, SIDE> {
    /// Some channels of a patch, which begins there in the image, to that place in the planes. `values` are overwritten: to fill new
    /// ones for each patch would take a call of `memset`.
    #[inline(always)]
    fn patch<S: Simd>(&mut self, simd: S, from: usize, to: usize, values: &mut [[S::f32s; SIDE]; SIDE]) {
        let image = self.convolution.image;
        let right = image.shape.dilation * image.channels;
        let down = image.pitch() * right;
        let plane = plane(self.tiles.len(), image.channels);
        for row in 0..SIDE {
            let mut of_row = [simd.splat_f32s(0.0); SIDE];
            for column in 0..SIDE {
                of_row[column] = vector::<S>(self.bordered, from + row * down + column * right);
            }
            values[row] = transformed_values(simd, of_row);
        }
        for column in 0..SIDE {
            let mut of_column = [simd.splat_f32s(0.0); SIDE];
            for row in 0..SIDE {
                of_column[row] = values[row][column];
            }
            of_column = transformed_values(simd, of_column);
            for row in 0..SIDE {
                let to = to + (SIDE * row + column) * plane;
                S::as_mut_simd_f32s(&mut self.planes[to..to + S::F32_LANES]).0[0] = of_column[row];
            }
        }
    }
}

/// A vector of a tile's outputs.
#[derive(Clone, Copy)]
struct OutputVector {
    tile: Tile,
    /// The first of them.
    output: usize,
    /// Where its sums begin in the planes.
    sums: usize,
}

struct Outputs<'a, const SIDE: usize> {
    convolution: &'a TiledConvolution<'a>,
    tiles: &'a [Tile],
    planes: &'a [f32],
    out: &'a mut [f32],
    start: StartSums,
}

impl<const SIDE: usize> WithSimd for Outputs<'_, SIDE> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let width = self.convolution.weights.bias.len();
        let mut values = PatchValues([[simd.splat_f32s(0.0); SIDE]; SIDE]);
        for (at, tile) in self.tiles.iter().enumerate() {
            for output in (0..width).step_by(S::F32_LANES) {
                let outputs = OutputVector {
                    tile: *tile,
                    output,
                    sums: at * width + output,
                };
                self.tile(simd, outputs, &mut values.0);
            }
        }
    }
}

#[allow(clippy::needless_range_loop)]
impl<const SIDE: usize> Outputs<'_, SIDE> {
    /// Writes some outputs of a tile. `values` are overwritten.
    #[inline(always)]
    fn tile<S: Simd>(&mut self, simd: S, outputs: OutputVector, values: &mut [[S::f32s; SIDE]; SIDE]) {
        let OutputVector {
            tile,
            output,
            sums: from,
        } = outputs;
        let (image, weights) = (self.convolution.image, self.convolution.weights);
        let bias = vector::<S>(&weights.bias, output);
        let right = image.shape.dilation * weights.outputs;
        let down = image.width * right;
        let length = S::F32_LANES.min(weights.outputs - output);
        let plane = plane(self.tiles.len(), weights.bias.len());
        for row in 0..SIDE {
            let mut of_row = [simd.splat_f32s(0.0); SIDE];
            for column in 0..SIDE {
                of_row[column] = vector::<S>(self.planes, from + (SIDE * row + column) * plane);
            }
            values[row] = sums(simd, of_row);
        }
        for column in 0..SIDE - 2 {
            let mut of_column = [simd.splat_f32s(0.0); SIDE];
            for row in 0..SIDE {
                of_column[row] = values[row][column];
            }
            of_column = sums(simd, of_column);
            for row in 0..SIDE - 2 {
                let to = tile.output + row * down + column * right + output;
                self.write(simd, to, length, simd.add_f32s(of_column[row], bias));
            }
        }
    }

    #[inline(always)]
    fn write<S: Simd>(&mut self, simd: S, to: usize, length: usize, value: S::f32s) {
        let out = &mut self.out[to..to + length];
        let value = match self.start {
            StartSums::Bias => value,
            StartSums::Output => simd.add_f32s(value, simd.partial_load_f32s(out)),
        };
        match S::as_mut_simd_f32s(out) {
            ([whole], _) => *whole = value,
            (_, part) => simd.partial_store_f32s(part, value),
        }
    }
}

#[inline(always)]
fn vector<S: Simd>(values: &[f32], from: usize) -> S::f32s {
    S::as_simd_f32s(&values[from..from + S::F32_LANES]).0[0]
}

/// The data transform Bᵀ of a row or column of a patch.
#[inline(always)]
fn transformed_values<S: Simd, const SIDE: usize>(simd: S, values: [S::f32s; SIDE]) -> [S::f32s; SIDE] {
    let mut transformed = values;
    if SIDE == SMALL {
        transformed[0] = simd.sub_f32s(values[0], values[2]);
        transformed[1] = simd.add_f32s(values[1], values[2]);
        transformed[2] = simd.sub_f32s(values[2], values[1]);
        transformed[3] = simd.sub_f32s(values[1], values[3]);
        return transformed;
    }
    let times = |factor: f32, value, added| simd.mul_add_e_f32s(simd.splat_f32s(factor), value, added);
    let near = times(-2.0, values[2], values[4]);
    let near_odd = times(
        -SQRT_2,
        values[1],
        simd.mul_f32s(simd.splat_f32s(FRAC_1_SQRT_2), values[3]),
    );
    let far = times(-0.5, values[2], values[4]);
    let far_odd = times(
        -FRAC_1_SQRT_2,
        values[1],
        simd.mul_f32s(simd.splat_f32s(SQRT_2), values[3]),
    );
    transformed[0] = times(-2.5, values[2], simd.add_f32s(values[0], values[4]));
    transformed[1] = simd.add_f32s(near, near_odd);
    transformed[2] = simd.sub_f32s(near, near_odd);
    transformed[3] = simd.add_f32s(far, far_odd);
    transformed[4] = simd.sub_f32s(far, far_odd);
    transformed[5] = times(-2.5, values[3], simd.add_f32s(values[1], values[5]));
    transformed
}

/// The output transform Aᵀ of a row or column of sums: two values less, then unspecified ones.
#[inline(always)]
fn sums<S: Simd, const SIDE: usize>(simd: S, values: [S::f32s; SIDE]) -> [S::f32s; SIDE] {
    let mut sums = values;
    let (near, near_odd) = (simd.add_f32s(values[1], values[2]), simd.sub_f32s(values[1], values[2]));
    if SIDE == SMALL {
        sums[0] = simd.add_f32s(simd.add_f32s(values[0], values[1]), values[2]);
        sums[1] = simd.sub_f32s(near_odd, values[3]);
        return sums;
    }
    let times = |factor: f32, value, added| simd.mul_add_e_f32s(simd.splat_f32s(factor), value, added);
    let (far, far_odd) = (simd.add_f32s(values[3], values[4]), simd.sub_f32s(values[3], values[4]));
    sums[0] = simd.add_f32s(values[0], simd.add_f32s(near, far));
    sums[1] = times(SQRT_2, far_odd, simd.mul_f32s(simd.splat_f32s(FRAC_1_SQRT_2), near_odd));
    sums[2] = times(2.0, far, simd.mul_f32s(simd.splat_f32s(0.5), near));
    sums[3] = times(2.0 * SQRT_2, far_odd, times(0.5 * FRAC_1_SQRT_2, near_odd, values[5]));
    sums
}
