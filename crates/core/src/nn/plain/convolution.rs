//! The 3×3 convolution: candle's forward pass (one matrix product of all neighbourhoods), and a backward pass of two such products.

use candle_core::backend::BackendStorage as _;
use candle_core::{CpuStorage, CudaStorage, CustomOp3, Layout, Result, Shape, Tensor};

use crate::nn::ops::convolution::Convolution3;
use crate::nn::ops::image_geometry::ConvShape;

/// Taps in a row of the kernel.
const SIDE: usize = 3;

/// The convolution of x `[N, C, H, W]`, as [`Convolution3`] computes it: `[N, O, ⌈H / stride⌉, ⌈W / stride⌉]`. Errors: shapes that do
/// not fit.
pub(in crate::nn) fn convolution(layer: &Convolution3, x: &Tensor) -> Result<Tensor> {
    let (rows, outputs) = layer.weight.dims2()?;
    let taps = layer.weight.reshape((SIDE, SIDE, rows / (SIDE * SIDE), outputs))?;
    let kernel = taps.permute((3, 2, 0, 1))?.contiguous()?;
    let x = x.contiguous()?;
    let ConvShape { stride, dilation } = layer.shape;
    let sums = x.detach().conv2d(&kernel.detach(), dilation, stride, dilation, 1)?;
    let sums = x.apply_op3(&kernel, &sums, ConvolutionGradient(layer.shape))?;
    sums.broadcast_add(&layer.bias.reshape((1, outputs, 1, 1))?)
}

/// Gives its third input, the convolution of the first with the second, and passes its gradient on to these.
struct ConvolutionGradient(ConvShape);

impl CustomOp3 for ConvolutionGradient {
    fn name(&self) -> &'static str {
        "plain-convolution"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        sums: &CpuStorage,
        layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        Ok((sums.try_clone(layout)?, layout.shape().clone()))
    }

    fn cuda_fwd(
        &self,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
        sums: &CudaStorage,
        layout: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        Ok((sums.try_clone(layout)?, layout.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        kernel: &Tensor,
        _: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (_, _, height, width) = x.dims4()?;
        let gradient = spread(gradient, self.0.stride)?
            .narrow(2, 0, height)?
            .narrow(3, 0, width)?
            .contiguous()?;
        let for_x = x.track_op().then(|| self.for_input(&kernel.detach(), &gradient));
        let for_kernel = kernel.track_op().then(|| self.for_kernel(&x.detach(), &gradient));
        Ok((for_x.transpose()?, for_kernel.transpose()?, None))
    }
}

impl ConvolutionGradient {
    /// The convolution of the gradient with the kernel turned by half a turn.
    fn for_input(&self, kernel: &Tensor, gradient: &Tensor) -> Result<Tensor> {
        let (outputs, channels, _, _) = kernel.dims4()?;
        let taps = kernel.transpose(0, 1)?.contiguous()?.reshape((channels, outputs, ()))?;
        let last_first: Vec<u32> = (0..(SIDE * SIDE) as u32).rev().collect();
        let turned = taps.index_select(&Tensor::new(last_first, kernel.device())?, 2)?;
        let turned = turned.reshape((channels, outputs, SIDE, SIDE))?;
        let dilation = self.0.dilation;
        gradient.conv2d(&turned, dilation, 1, dilation, 1)
    }

    /// For each tap, the product of the shifted input with the gradient.
    fn for_kernel(&self, x: &Tensor, gradient: &Tensor) -> Result<Tensor> {
        let (items, channels, height, width) = x.dims4()?;
        let (outputs, border) = (gradient.dim(1)?, self.0.dilation);
        let x = x.pad_with_zeros(2, border, border)?.pad_with_zeros(3, border, border)?;
        let mut taps = Vec::with_capacity(SIDE * SIDE);
        for tap in 0..SIDE * SIDE {
            let (row, column) = (tap / SIDE * border, tap % SIDE * border);
            taps.push(x.narrow(2, row, height)?.narrow(3, column, width)?.contiguous()?);
        }
        let neighbours = Tensor::cat(&taps, 1)?.reshape((items, (), height * width))?;
        let gradient = gradient.flatten_from(2)?.transpose(1, 2)?;
        let sums = neighbours.matmul(&gradient)?.sum(0)?;
        let sums = sums.reshape((SIDE, SIDE, channels, outputs))?;
        sums.permute((3, 2, 0, 1))?.contiguous()
    }
}

/// The image with zeros between its places: `stride` times its sides.
fn spread(image: &Tensor, stride: usize) -> Result<Tensor> {
    if stride == 1 {
        return Ok(image.clone());
    }
    let (items, channels, height, width) = image.dims4()?;
    let columns = image.reshape((items, channels, height, width, 1))?;
    let columns = columns.pad_with_zeros(4, 0, stride - 1)?;
    let rows = columns.reshape((items, channels, height, 1, width * stride))?;
    let rows = rows.pad_with_zeros(3, 0, stride - 1)?;
    rows.reshape((items, channels, height * stride, width * stride))
}

#[cfg(test)]
mod tests {
    use candle_core::Var;
    use candle_nn::Module as _;

    use super::*;
    use crate::nn::gradient_check::noise;

    #[test]
    fn values_and_gradients_are_those_of_the_fused_convolution() {
        for shape in [ConvShape::PLAIN, ConvShape::HALVING, ConvShape::dilated(2)] {
            let vars =
                [noise(&[2, 6, 8, 3], 1), noise(&[27, 5], 2), noise(&[5], 3)].map(|x| Var::from_tensor(&x).unwrap());
            let [x, weight, bias] = [0, 1, 2].map(|index: usize| vars[index].as_tensor().clone());
            let layer = Convolution3 {
                weight,
                bias,
                shape,
                packed: None,
            };
            let channels_first = x.permute((0, 3, 1, 2)).unwrap();
            let plain = convolution(&layer, &channels_first)
                .unwrap()
                .permute((0, 2, 3, 1))
                .unwrap();
            let fused = layer.forward(&x).unwrap();
            assert_close(&plain, &fused);
            let weights = noise(fused.dims(), 4);
            let gradients = [plain, fused].map(|out| (out * &weights).unwrap().sum_all().unwrap().backward().unwrap());
            for var in &vars {
                assert_close(gradients[0].get(var).unwrap(), gradients[1].get(var).unwrap());
            }
        }
    }

    fn assert_close(a: &Tensor, b: &Tensor) {
        let most = (a - b).unwrap().abs().unwrap().max_all().unwrap();
        assert!(most.to_scalar::<f32>().unwrap() < 1e-4, "{most}");
    }
}
