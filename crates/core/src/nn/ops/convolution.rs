//! 3×3 convolutions of images stored row by row with their channels last (NHWC). With a border of zeros around the image,
//! the neighbours of all places in one row of the kernel are a matrix whose rows overlap in memory, so one matrix product a
//! kernel row gives all output channels, and nothing is copied. candle's own CPU convolution is several times slower forth
//! and back.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use candle_nn::Module;

use crate::nn::tensors::{add_columns, slice, with_values};
use crate::vectorized::vectorized;

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

/// The convolution `[N, H, W, C]` → `[N, ⌈H / stride⌉, ⌈W / stride⌉, O]`. Weight `[9 · C, O]`, taps row by row; bias `[O]`.
/// Places outside the image count as zero. Errors: shapes that do not fit.
fn convolve(x: &Tensor, weight: &Tensor, bias: &Tensor, shape: ConvShape) -> Result<Tensor> {
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

/// A layer that is a 3×3 convolution.
#[derive(Clone, Debug)]
pub(in crate::nn) struct Convolution3 {
    weight: Tensor,
    bias: Tensor,
    shape: ConvShape,
}

impl Convolution3 {
    /// A layer of weight `[9 · C, O]` and bias `[O]`.
    pub(in crate::nn) fn new(weight: Tensor, bias: Tensor, shape: ConvShape) -> Self {
        Self { weight, bias, shape }
    }

    /// Whether gradients go to the weight.
    pub(in crate::nn) fn is_trained(&self) -> bool {
        self.weight.track_op()
    }
}

impl Module for Convolution3 {
    /// The convolution of x, see [`convolve`].
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        convolve(x, &self.weight, &self.bias, self.shape)
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

/// Output places that one matrix product computes.
struct PlaceBlock {
    /// The first row of output places.
    row: usize,
    /// Where the kernel of the first place begins, in the values of the bordered image.
    from: usize,
    /// Places, those that are not used included.
    places: usize,
}

/// Taps of the kernel whose values lie side by side.
struct TapRun {
    /// From the beginning of the kernel, in the values of the bordered image.
    offset: usize,
    /// Rows of the weight.
    first: usize,
    length: usize,
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

    /// Places in a row of the bordered image: `dilation` more on each side.
    fn pitch(self) -> usize {
        self.width + 2 * self.shape.dilation
    }

    /// The image of zeros with its border.
    fn bordered(self) -> CpuStorage {
        let height = self.height + 2 * self.shape.dilation;
        CpuStorage::F32(vec![0.0; height * self.pitch() * self.channels])
    }

    /// Where the first place inside the border begins.
    fn inside(self) -> usize {
        self.shape.dilation * (self.pitch() + 1) * self.channels
    }

    /// Writes an image into a bordered one. An image of `spread` times smaller sides is spread over every `spread`th place.
    fn write(self, image: &[f32], spread: usize, bordered: &mut CpuStorage) {
        let CpuStorage::F32(bordered) = bordered else { return };
        let length = self.width.div_ceil(spread) * self.channels;
        for (row, values) in image.chunks_exact(length).enumerate() {
            let from = self.inside() + row * spread * self.pitch() * self.channels;
            if spread == 1 {
                bordered[from..from + length].copy_from_slice(values);
                continue;
            }
            for (column, value) in values.chunks_exact(self.channels).enumerate() {
                let from = from + column * spread * self.channels;
                bordered[from..from + self.channels].copy_from_slice(value);
            }
        }
    }

    /// All output places. Without a stride they are one block, in which the borders between rows count as places.
    fn blocks(self) -> impl Iterator<Item = PlaceBlock> {
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
    fn runs(self) -> impl Iterator<Item = TapRun> {
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
    fn neighbours(self, block: &PlaceBlock, run: &TapRun) -> Layout {
        let steps = vec![self.shape.stride * self.channels, 1];
        Layout::new(Shape::from((block.places, run.length)), steps, block.from + run.offset)
    }

    /// Adds the convolution of a bordered image to `sums` `[places, outputs]`. The weight begins at `from` in its storage.
    fn add_to(self, sums: &mut [f32], bordered: &CpuStorage, weight: &CpuStorage, from: usize) -> Result<()> {
        let outputs = sums.len() / self.places();
        let used = self.out_width() * outputs;
        for block in self.blocks() {
            let pitch = if self.shape.stride == 1 {
                self.pitch() * outputs
            } else {
                used
            };
            for run in self.runs() {
                let weights = Layout::contiguous_with_offset((run.length, outputs), from + run.first * outputs);
                let sizes = (1, block.places, outputs, run.length);
                let product = bordered.matmul(weight, sizes, &self.neighbours(&block, &run), &weights)?;
                let CpuStorage::F32(product) = product else {
                    bail!("a convolution takes f32 tensors");
                };
                let rows = sums[block.row * used..].chunks_exact_mut(used);
                for (sums, product) in rows.zip(product.chunks(pitch)) {
                    add(sums, &product[..used]);
                }
            }
        }
        Ok(())
    }
}

/// Adds values to sums.
fn add(sums: &mut [f32], values: &[f32]) {
    vectorized(
        #[inline(always)]
        || {
            for (sum, value) in sums.iter_mut().zip(values) {
                *sum += value;
            }
        },
    );
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
        let taps = TAPS * image.channels;
        if !weight_layout.is_contiguous() {
            bail!("a convolution takes contiguous weights");
        }
        if rows != taps {
            bail!(
                "a convolution of {} channels takes {taps} rows of weights, got {rows}",
                image.channels
            );
        }
        let (values, bias) = (slice(x, x_layout)?, slice(bias, bias_layout)?);
        let mut sums = bias.repeat(dims.0 * image.places());
        let mut bordered = image.bordered();
        let images = values.chunks_exact(image.inputs());
        for (values, sums) in images.zip(sums.chunks_exact_mut(image.places() * outputs)) {
            image.write(values, 1, &mut bordered);
            image.add_to(sums, &bordered, weight, weight_layout.start_offset())?;
        }
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
        let device = x.device();
        let mut for_bias = vec![0.0; outputs];
        let mut for_weight = vec![0.0; rows * outputs];
        let mut for_x = self.wants_input_gradient.then(|| vec![0.0; x.elem_count()]);
        let turned = CpuStorage::F32(with_values(weight, |weight| turned_kernel(weight, image.channels))?);
        with_values(x, |values| {
            with_values(gradient, |gradient| -> Result<()> {
                add_all_columns(&mut for_bias, gradient);
                let mut backward = Backward::new(image, outputs);
                let gradients = gradient.chunks_exact(image.places() * outputs);
                for (index, (values, gradient)) in values.chunks_exact(image.inputs()).zip(gradients).enumerate() {
                    backward.read(values, gradient);
                    backward.add_weight_gradient(&mut for_weight)?;
                    if let Some(for_x) = &mut for_x {
                        let for_x = &mut for_x[index * image.inputs()..(index + 1) * image.inputs()];
                        backward.spread.add_to(for_x, &backward.gradient, &turned, 0)?;
                    }
                }
                Ok(())
            })
        })???;
        let for_x = for_x
            .map(|for_x| Tensor::from_vec(for_x, x.dims(), device))
            .transpose()?;
        Ok((
            for_x,
            Some(Tensor::from_vec(for_weight, (rows, outputs), device)?),
            Some(Tensor::from_vec(for_bias, bias.dims(), device)?),
        ))
    }
}

/// An image and the gradient of its convolution, both with borders.
struct Backward {
    image: ImageGeometry,
    bordered: CpuStorage,
    /// The gradient's image: as large as the input, so that a convolution of it gives the input's gradient.
    spread: ImageGeometry,
    gradient: CpuStorage,
}

impl Backward {
    fn new(image: ImageGeometry, outputs: usize) -> Self {
        let spread = ImageGeometry {
            channels: outputs,
            shape: ConvShape::dilated(image.shape.dilation),
            ..image
        };
        Self {
            image,
            bordered: image.bordered(),
            spread,
            gradient: spread.bordered(),
        }
    }

    fn read(&mut self, values: &[f32], gradient: &[f32]) {
        self.image.write(values, 1, &mut self.bordered);
        self.spread.write(gradient, self.image.shape.stride, &mut self.gradient);
    }

    /// Adds the gradient of the weight `[9 · C, O]`. What is no output place has a gradient of zero.
    fn add_weight_gradient(&self, sums: &mut [f32]) -> Result<()> {
        let (image, outputs) = (self.image, self.spread.channels);
        let stride = image.shape.stride;
        for block in image.blocks() {
            let from = self.spread.inside() + block.row * stride * self.spread.pitch() * outputs;
            let steps = vec![stride * outputs, 1];
            let gradients = Layout::new(Shape::from((block.places, outputs)), steps, from);
            for run in image.runs() {
                let neighbours = image.neighbours(&block, &run).transpose(0, 1)?;
                let sizes = (1, run.length, outputs, block.places);
                let product = self.bordered.matmul(&self.gradient, sizes, &neighbours, &gradients)?;
                if let CpuStorage::F32(product) = product {
                    add(&mut sums[run.first * outputs..], &product);
                }
            }
        }
        Ok(())
    }
}

/// The weight `[9 · O, C]` of the convolution that turns the output's gradient into the input's.
fn turned_kernel(weight: &[f32], channels: usize) -> Vec<f32> {
    let outputs = weight.len() / (TAPS * channels);
    let mut turned = vec![0.0; weight.len()];
    for (row, weights) in weight.chunks_exact(outputs).enumerate() {
        let (tap, channel) = (TAPS - 1 - row / channels, row % channels);
        for (output, weight) in weights.iter().enumerate() {
            turned[(tap * outputs + output) * channels + channel] = *weight;
        }
    }
    turned
}

fn add_all_columns(sums: &mut [f32], values: &[f32]) {
    vectorized(
        #[inline(always)]
        || add_columns(sums, values),
    );
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
}
