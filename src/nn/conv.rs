//! 3×3 convolutions of images stored row by row with their channels last (NHWC): the neighbours of each place become one
//! row of a matrix, and one matrix product gives all output channels. candle's own CPU convolution is several times
//! slower forth and back.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp1, CustomOp3, Layout, Result, Shape, Tensor, bail};
use pulp::Arch;

use super::tensors::{add_columns, slice, with_values};

/// Side of the kernel.
const SIDE: usize = 3;
/// Weights of one input channel for one output channel.
pub(super) const TAPS: usize = SIDE * SIDE;

/// How a convolution samples its input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ConvShape {
    /// Input places from one output place to the next.
    pub(super) stride: usize,
    /// Input places from one tap of the kernel to the next.
    pub(super) dilation: usize,
}

impl ConvShape {
    /// Every place, neighbours side by side.
    pub(super) const PLAIN: Self = Self { stride: 1, dilation: 1 };

    /// Every second place: half the sides.
    pub(super) const HALVING: Self = Self { stride: 2, dilation: 1 };

    /// Every place, neighbours `dilation` places apart.
    pub(super) const fn dilated(dilation: usize) -> Self {
        Self { stride: 1, dilation }
    }
}

/// The convolution `[N, H, W, C]` → `[N, ⌈H / stride⌉, ⌈W / stride⌉, O]`. Weight `[9 · C, O]`, taps row by row; bias `[O]`.
/// Places outside the image count as zero. Errors: shapes that do not fit.
pub(super) fn convolve(x: &Tensor, weight: &Tensor, bias: &Tensor, shape: ConvShape) -> Result<Tensor> {
    let wants_input_gradient = x.track_op();
    let operation = Convolution {
        shape,
        wants_input_gradient,
    };
    let x = x.contiguous()?;
    if wants_input_gradient || weight.track_op() || bias.track_op() {
        x.apply_op3(weight, bias, operation)
    } else {
        x.apply_op3_no_bwd(weight, bias, &operation)
    }
}

struct Convolution {
    shape: ConvShape,
    wants_input_gradient: bool,
}

/// Sizes of one image of a convolution.
#[derive(Clone, Copy)]
struct ImageGeometry {
    height: usize,
    width: usize,
    channels: usize,
    shape: ConvShape,
}

impl ImageGeometry {
    fn of(dims: (usize, usize, usize, usize), shape: ConvShape) -> Self {
        let (_, height, width, channels) = dims;
        Self {
            height,
            width,
            channels,
            shape,
        }
    }

    fn out_height(self) -> usize {
        self.height.div_ceil(self.shape.stride)
    }

    fn out_width(self) -> usize {
        self.width.div_ceil(self.shape.stride)
    }

    fn places(self) -> usize {
        self.out_height() * self.out_width()
    }

    fn inputs(self) -> usize {
        self.height * self.width * self.channels
    }

    fn columns(self) -> usize {
        TAPS * self.channels
    }

    /// Calls `visit` with the place of each run of values in the matrix, its length, and its place in the image; `None` outside
    /// the image. With neighbours side by side, the three of a row of the kernel are one run.
    #[inline(always)]
    fn visit(self, mut visit: impl FnMut(usize, usize, Option<usize>)) {
        let ConvShape { stride, dilation } = self.shape;
        let (channels, width) = (self.channels, self.width);
        let mut at = 0;
        for row in 0..self.out_height() {
            for column in 0..self.out_width() {
                for kernel_row in 0..SIDE {
                    let y = row * stride + kernel_row * dilation;
                    let first = (dilation..self.height + dilation)
                        .contains(&y)
                        .then(|| (y - dilation) * width);
                    let x = column * stride;
                    if let (1, 1.., Some(first)) = (dilation, x, first)
                        && x + 1 < width
                    {
                        visit(at, SIDE * channels, Some((first + x - 1) * channels));
                        at += SIDE * channels;
                        continue;
                    }
                    for kernel_column in 0..SIDE {
                        let x = x + kernel_column * dilation;
                        let is_inside = (dilation..width + dilation).contains(&x);
                        let place = first
                            .filter(|_| is_inside)
                            .map(|first| (first + x - dilation) * channels);
                        visit(at, channels, place);
                        at += channels;
                    }
                }
            }
        }
    }

    /// The neighbours of every place, one place a row.
    fn unfold(self, image: &[f32], matrix: &mut [f32]) {
        self.visit(|at, length, place| {
            let out = &mut matrix[at..at + length];
            match place {
                Some(place) => out.copy_from_slice(&image[place..place + length]),
                None => out.fill(0.0),
            }
        });
    }

    /// Adds each row's values to the places that [`ImageGeometry::unfold`] reads them from.
    fn fold(self, matrix: &[f32], image: &mut [f32]) {
        Arch::new().dispatch(
            #[inline(always)]
            || {
                self.visit(
                    #[inline(always)]
                    |at, length, place| {
                        if let Some(place) = place {
                            let sums = &mut image[place..place + length];
                            for (sum, value) in sums.iter_mut().zip(&matrix[at..at + length]) {
                                *sum += value;
                            }
                        }
                    },
                );
            },
        );
    }
}

impl CustomOp3 for Convolution {
    fn name(&self) -> &'static str {
        "convolution"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let dims = x_layout.shape().dims4()?;
        let image = ImageGeometry::of(dims, self.shape);
        let (rows, outputs) = weight_layout.shape().dims2()?;
        if rows != image.columns() {
            bail!(
                "a convolution of {} channels takes {} weights, got {rows}",
                image.channels,
                image.columns()
            );
        }
        let (values, bias) = (slice(x, x_layout)?, slice(bias, bias_layout)?);
        let mut sums = Vec::with_capacity(dims.0 * image.places() * outputs);
        let layout = Layout::contiguous((image.places(), rows));
        let mut matrix = CpuStorage::F32(vec![0.0; image.places() * rows]);
        for values in values.chunks_exact(image.inputs()) {
            unfold_into(&mut matrix, image, values);
            let product = matrix.matmul(weight, (1, image.places(), outputs, rows), &layout, weight_layout)?;
            let CpuStorage::F32(product) = product else {
                bail!("a convolution takes f32 tensors");
            };
            sums.extend_from_slice(&product);
        }
        Arch::new().dispatch(
            #[inline(always)]
            || {
                for row in sums.chunks_exact_mut(outputs) {
                    add_columns(row, bias);
                }
            },
        );
        let shape = (dims.0, image.out_height(), image.out_width(), outputs);
        Ok((CpuStorage::F32(sums), Shape::from(shape)))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        _y: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let image = ImageGeometry::of(x.dims4()?, self.shape);
        let (rows, outputs) = weight.dims2()?;
        let (weight, gradient) = (weight.detach(), gradient.contiguous()?);
        let (places, device) = (image.places(), x.device());
        let mut for_bias = vec![0.0; outputs];
        let mut for_weight = vec![0.0; rows * outputs];
        let mut for_x = if self.wants_input_gradient {
            vec![0.0; x.elem_count()]
        } else {
            Vec::new()
        };
        let (weight_storage, weight_layout) = weight.storage_and_layout();
        let candle_core::Storage::Cpu(weight_storage) = &*weight_storage else {
            bail!("a convolution takes tensors on the CPU");
        };
        let transposed_weight = weight_layout.transpose(0, 1)?;
        let matrix_layout = Layout::contiguous((places, rows));
        let transposed_matrix = matrix_layout.transpose(0, 1)?;
        let gradient_layout = Layout::contiguous((places, outputs));
        let mut matrix = CpuStorage::F32(vec![0.0; places * rows]);
        with_values(x, |values| {
            with_values(&gradient, |gradient| -> Result<()> {
                add_all_columns(&mut for_bias, gradient);
                let images = values
                    .chunks_exact(image.inputs())
                    .zip(gradient.chunks_exact(places * outputs));
                for (index, (values, gradient)) in images.enumerate() {
                    let gradient = CpuStorage::F32(gradient.to_vec());
                    unfold_into(&mut matrix, image, values);
                    let sizes = (1, rows, outputs, places);
                    let product = matrix.matmul(&gradient, sizes, &transposed_matrix, &gradient_layout)?;
                    add_to(&mut for_weight, &product);
                    if self.wants_input_gradient {
                        let sizes = (1, places, rows, outputs);
                        let product = gradient.matmul(weight_storage, sizes, &gradient_layout, &transposed_weight)?;
                        let from = index * image.inputs();
                        if let CpuStorage::F32(product) = &product {
                            image.fold(product, &mut for_x[from..from + image.inputs()]);
                        }
                    }
                }
                Ok(())
            })
        })???;
        let for_x = self
            .wants_input_gradient
            .then(|| Tensor::from_vec(for_x, x.dims(), device))
            .transpose()?;
        Ok((
            for_x,
            Some(Tensor::from_vec(for_weight, (rows, outputs), device)?),
            Some(Tensor::from_vec(for_bias, bias.dims(), device)?),
        ))
    }
}

fn unfold_into(matrix: &mut CpuStorage, image: ImageGeometry, values: &[f32]) {
    if let CpuStorage::F32(matrix) = matrix {
        image.unfold(values, matrix);
    }
}

fn add_all_columns(sums: &mut [f32], values: &[f32]) {
    Arch::new().dispatch(
        #[inline(always)]
        || add_columns(sums, values),
    );
}

fn add_to(sums: &mut [f32], values: &CpuStorage) {
    if let CpuStorage::F32(values) = values {
        for (sum, value) in sums.iter_mut().zip(values) {
            *sum += value;
        }
    }
}

/// Spreads 4 · C channels over twice the sides: `[N, H, W, 4 · C]` → `[N, 2H, 2W, C]`. Channel group `2 · row + column` goes
/// to that row and column of each 2×2 block.
pub(super) fn pixel_shuffle(x: &Tensor) -> Result<Tensor> {
    PixelShuffle { is_inverse: false }.apply(x)
}

/// The inverse of [`pixel_shuffle`]: `[N, 2H, 2W, C]` → `[N, H, W, 4 · C]`.
pub(super) fn pixel_unshuffle(x: &Tensor) -> Result<Tensor> {
    PixelShuffle { is_inverse: true }.apply(x)
}

#[derive(Clone, Copy)]
struct PixelShuffle {
    is_inverse: bool,
}

impl PixelShuffle {
    fn apply(self, x: &Tensor) -> Result<Tensor> {
        let x = x.contiguous()?;
        if x.track_op() {
            x.apply_op1(self)
        } else {
            x.apply_op1_no_bwd(&self)
        }
    }
}

impl CustomOp1 for PixelShuffle {
    fn name(&self) -> &'static str {
        "pixel-shuffle"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (count, height, width, channels) = layout.shape().dims4()?;
        let values = slice(x, layout)?;
        let mut out = vec![0.0; values.len()];
        // Rows, columns and channels on the fine side.
        let (rows, columns, depth) = if self.is_inverse {
            (height, width, channels)
        } else {
            (2 * height, 2 * width, channels / 4)
        };
        let half = columns / 2 * 4 * depth;
        for row in 0..count * rows {
            // Both rows of a block lie in the same row of blocks; sides are even, so items need no care.
            let blocks = row / 2 * half + row % 2 * 2 * depth;
            for column in 0..columns {
                let coarse = blocks + column / 2 * 4 * depth + column % 2 * depth;
                let fine = (row * columns + column) * depth;
                let (from, to) = if self.is_inverse {
                    (fine, coarse)
                } else {
                    (coarse, fine)
                };
                out[to..to + depth].copy_from_slice(&values[from..from + depth]);
            }
        }
        let shape = if self.is_inverse {
            (count, height / 2, width / 2, 4 * channels)
        } else {
            (count, rows, columns, depth)
        };
        Ok((CpuStorage::F32(out), Shape::from(shape)))
    }

    fn bwd(&self, _x: &Tensor, _y: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let inverse = Self {
            is_inverse: !self.is_inverse,
        };
        Ok(Some(inverse.apply(&gradient.detach())?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise};

    const SHAPES: [ConvShape; 3] = [ConvShape::PLAIN, ConvShape::HALVING, ConvShape::dilated(2)];

    #[test]
    fn convolution_agrees_with_candle() {
        for shape in SHAPES {
            let (x, weight, bias) = (noise(&[2, 6, 5, 3], 1), noise(&[27, 4], 2), noise(&[4], 3));
            let ours = convolve(&x, &weight, &bias, shape).unwrap();
            // candle: channels first, weights [O, C, 3, 3].
            let kernel = weight.reshape((3, 3, 3, 4)).unwrap().permute((3, 2, 0, 1)).unwrap();
            let image = x.permute((0, 3, 1, 2)).unwrap().contiguous().unwrap();
            let theirs = image
                .conv2d(
                    &kernel.contiguous().unwrap(),
                    shape.dilation,
                    shape.stride,
                    shape.dilation,
                    1,
                )
                .unwrap();
            let theirs = theirs.permute((0, 2, 3, 1)).unwrap().broadcast_add(&bias).unwrap();
            assert_eq!(ours.dims(), theirs.dims());
            let most = (ours - theirs).unwrap().abs().unwrap().max_all().unwrap();
            assert!(most.to_scalar::<f32>().unwrap() < 1e-5, "{shape:?}: {most}");
        }
    }

    #[test]
    fn convolution_gradients_agree_with_differences() {
        for shape in SHAPES {
            let inputs = [noise(&[2, 5, 6, 3], 1), noise(&[27, 4], 2), noise(&[4], 3)];
            assert_gradients(&inputs, 1e-2, |inputs| {
                convolve(&inputs[0], &inputs[1], &inputs[2], shape)
            });
        }
    }

    #[test]
    fn pixel_shuffle_is_undone_by_its_inverse() {
        let x = noise(&[2, 3, 2, 8], 4);
        let fine = pixel_shuffle(&x).unwrap();
        assert_eq!(fine.dims(), [2, 6, 4, 2]);
        let back = pixel_unshuffle(&fine).unwrap();
        assert_eq!(
            back.flatten_all().unwrap().to_vec1::<f32>().unwrap(),
            x.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        );
        assert_gradients(&[x], 1e-2, |inputs| pixel_shuffle(&inputs[0]));
    }
}
