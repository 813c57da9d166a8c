//! 3×3 convolutions of images stored row by row with their channels last (NHWC). candle's own CPU convolution is several times slower in
//! both passes.
//!
//! The weights' gradient: with a border of zeros around the image, the neighbours of all places in one row of the kernel are a matrix
//! whose rows overlap in memory, so one matrix product a kernel row gives it, and nothing is copied.

use std::sync::Arc;

use candle_core::{CpuStorage, Layout, Result, Shape, Tensor, bail};
use candle_nn::Module;

use super::bordered_convolution::{BorderedConvolution, PackedKernel, Written};
use super::image_geometry::{ConvShape, ImageGeometry, TAPS};
use super::packed::StartSums;
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::nn::precision::Precision;
use crate::nn::tensors::{product, sum_columns, with_values};

/// A layer that is a 3×3 convolution of weight `[9 · C, O]`, taps row by row, and bias `[O]`.
#[derive(Clone, Debug)]
pub(in crate::nn) struct Convolution3 {
    pub(in crate::nn) weight: Tensor,
    pub(in crate::nn) bias: Tensor,
    pub(in crate::nn) shape: ConvShape,
    /// For prediction, which then does not use the tensors.
    pub(in crate::nn) packed: Option<Arc<PackedKernel>>,
}

impl Convolution3 {
    /// Packs the weights as they are now.
    pub(in crate::nn) fn pack(&mut self, precision: Precision) -> Result<()> {
        let stride = self.shape.stride;
        let packed = with_values(&self.weight, |weights| {
            with_values(&self.bias, |bias| {
                PackedKernel::new(weights, bias, stride, precision.of_convolutions())
            })
        })??;
        self.packed = Some(Arc::new(packed));
        Ok(())
    }
}

impl Module for Convolution3 {
    /// The convolution `[N, H, W, C]` → `[N, ⌈H / stride⌉, ⌈W / stride⌉, O]`. Places outside the image count as zero.
    /// Errors: shapes that do not fit.
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        apply(self.shape, [x, &self.weight, &self.bias])
    }
}

/// An image with a border of zeros around it.
struct BorderedImage {
    geometry: ImageGeometry,
    values: CpuStorage,
}

impl BorderedImage {
    /// An image of zeros.
    fn new(geometry: ImageGeometry) -> Self {
        let height = geometry.height + 2 * geometry.shape.dilation;
        let values = CpuStorage::F32(vec![0.0; height * geometry.pitch() * geometry.channels]);
        Self { geometry, values }
    }

    /// Writes an image inside the border. An image of `spread` times smaller sides is spread over every `spread`th place.
    fn write(&mut self, image: &[f32], spread: usize) {
        let (geometry, channels) = (self.geometry, self.geometry.channels);
        let CpuStorage::F32(bordered) = &mut self.values else {
            return;
        };
        let length = geometry.width.div_ceil(spread) * channels;
        for (row, values) in image.chunks_exact(length).enumerate() {
            let from = geometry.inside() + row * spread * geometry.pitch() * channels;
            if spread == 1 {
                bordered[from..from + length].copy_from_slice(values);
                continue;
            }
            for (column, value) in values.chunks_exact(channels).enumerate() {
                let from = from + column * spread * channels;
                bordered[from..from + channels].copy_from_slice(value);
            }
        }
    }

    /// Adds the gradient of the weight `[9 · C, O]` to `sums`, from that of the image's convolution, which is spread over an
    /// image as large as this one. What is no output place has a gradient of zero.
    fn add_weight_gradient(&self, sums: &mut [f32], gradient: &Self) -> Result<()> {
        let (geometry, spread) = (self.geometry, gradient.geometry);
        let (stride, outputs) = (geometry.shape.stride, spread.channels);
        for block in geometry.blocks() {
            let from = spread.inside() + block.row * stride * spread.pitch() * outputs;
            let gradients = Layout::new(Shape::from((block.places, outputs)), vec![stride * outputs, 1], from);
            for run in geometry.runs() {
                let neighbours = geometry.neighbours(&block, &run).transpose(0, 1)?;
                let product = product((&self.values, &neighbours), (&gradient.values, &gradients))?;
                sum_columns(&mut sums[run.first * outputs..][..product.len()], &product);
            }
        }
        Ok(())
    }
}

impl FusedOperation<3> for ConvShape {
    const NAME: &'static str = "convolution";

    fn forward(&self, [x, weight, bias]: [Operand; 3]) -> Result<(Vec<f32>, Shape)> {
        let dims = x.layout.shape().dims4()?;
        let image = ImageGeometry::of(dims, *self);
        let (rows, outputs) = weight.layout.shape().dims2()?;
        let (channels, taps) = (image.channels, TAPS * image.channels);
        if rows != taps {
            bail!("a convolution of {channels} channels takes {taps} rows of weights, got {rows}");
        }
        if bias.values.len() != outputs {
            bail!(
                "a bias of {} does not fit weights of {outputs} outputs",
                bias.values.len()
            );
        }
        let kernel = PackedKernel::of_image(weight.values, bias.values, image);
        let convolution = BorderedConvolution::new(&kernel, image);
        let mut sums = vec![0.0; dims.0 * image.places() * outputs];
        let images = x.values.chunks_exact(image.inputs());
        for (values, sums) in images.zip(sums.chunks_exact_mut(image.places() * outputs)) {
            convolution.forward(values, sums, StartSums::Bias, Written::Plain);
        }
        Ok((
            sums,
            Shape::from((dims.0, image.out_height(), image.out_width(), outputs)),
        ))
    }

    fn backward(
        &self,
        [x, weight, bias]: [Operand; 3],
        _output: Operand,
        gradient: Operand,
    ) -> Result<[Option<Vec<f32>>; 3]> {
        let image = ImageGeometry::of(x.layout.shape().dims4()?, *self);
        let outputs = bias.values.len();
        // As large as the input, so that a convolution of it gives the input's gradient.
        let spread = ImageGeometry {
            channels: outputs,
            shape: Self::dilated(self.dilation),
            ..image
        };
        let (mut bordered, mut bordered_gradient) = (BorderedImage::new(image), BorderedImage::new(spread));
        let flipped = flipped_kernel(weight.values, image.channels);
        let flipped = PackedKernel::of_image(&flipped, &vec![0.0; image.channels], spread);
        let convolution = BorderedConvolution::new(&flipped, spread);
        let mut for_bias = vec![0.0; outputs];
        let mut for_weight = vec![0.0; weight.values.len()];
        let mut for_x = x.is_tracked.then(|| vec![0.0; x.values.len()]);
        sum_columns(&mut for_bias, gradient.values);
        let gradients = gradient.values.chunks_exact(image.places() * outputs);
        for (index, (values, gradient)) in x.values.chunks_exact(image.inputs()).zip(gradients).enumerate() {
            bordered.write(values, 1);
            bordered_gradient.write(gradient, self.stride);
            bordered.add_weight_gradient(&mut for_weight, &bordered_gradient)?;
            if let Some(for_x) = &mut for_x {
                let for_x = &mut for_x[index * image.inputs()..(index + 1) * image.inputs()];
                convolution.forward_bordered(bordered_gradient.values.as_slice()?, for_x);
            }
        }
        Ok([for_x, Some(for_weight), Some(for_bias)])
    }
}

/// The weight `[9 · O, C]` of the convolution that turns the output's gradient into the input's.
fn flipped_kernel(weight: &[f32], channels: usize) -> Vec<f32> {
    let outputs = weight.len() / (TAPS * channels);
    let mut flipped = vec![0.0; weight.len()];
    for (row, weights) in weight.chunks_exact(outputs).enumerate() {
        let (tap, channel) = (TAPS - 1 - row / channels, row % channels);
        for (output, weight) in weights.iter().enumerate() {
            flipped[(tap * outputs + output) * channels + channel] = *weight;
        }
    }
    flipped
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise};

    /// With sides, channels and outputs: places on their own, then tiles.
    const CASES: [(ConvShape, [usize; 2], usize, usize); 6] = [
        (ConvShape::PLAIN, [6, 5], 3, 4),
        (ConvShape::HALVING, [6, 5], 3, 4),
        (ConvShape::dilated(2), [6, 5], 3, 4),
        (ConvShape::PLAIN, [4, 6], 16, 32),
        (ConvShape::HALVING, [4, 6], 16, 16),
        (ConvShape::dilated(2), [4, 8], 16, 16),
    ];

    fn inputs([height, width]: [usize; 2], channels: usize, outputs: usize) -> [Tensor; 3] {
        [
            noise(&[2, height, width, channels], 1),
            noise(&[TAPS * channels, outputs], 2),
            noise(&[outputs], 3),
        ]
    }

    #[test]
    fn convolution_agrees_with_candle() {
        for (shape, sides, channels, outputs) in CASES {
            let [x, weight, bias] = inputs(sides, channels, outputs);
            let ours = apply(shape, [&x, &weight, &bias]).unwrap();
            // candle: channels first, weights [O, C, 3, 3].
            let kernel = weight.reshape((3, 3, channels, outputs)).unwrap();
            let kernel = kernel.permute((3, 2, 0, 1)).unwrap();
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
            assert!(most.to_scalar::<f32>().unwrap() < 2e-5, "{shape:?}: {most}");
        }
    }

    #[test]
    fn convolution_gradients_agree_with_differences() {
        for (shape, sides, channels, outputs) in CASES {
            assert_gradients(&inputs(sides, channels, outputs), 1e-2, |inputs| {
                apply(shape, [&inputs[0], &inputs[1], &inputs[2]])
            });
        }
    }
}
