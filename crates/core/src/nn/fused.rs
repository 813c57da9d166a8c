//! Operations with a forward and a backward pass of their own, written on plain slices: one pass over memory, where candle's
//! own operations would need several. candle has one trait for each number of inputs; [`FusedOperation`] is for all of them.

use candle_core::{CpuStorage, CustomOp3, DType, Device, Layout, Result, Shape, Tensor};

use super::tensors::{on_cpu, slice};

/// An operation on N f32 tensors, one to three.
pub(super) trait FusedOperation<const N: usize>: Send + Sync + 'static {
    /// Its name in candle's messages.
    const NAME: &'static str;

    /// Values and shape of the output. Errors: shapes that do not fit.
    fn forward(&self, inputs: [Operand; N]) -> Result<(Vec<f32>, Shape)>;

    /// The gradient of each input, from that of the output; `None` for an input that gets no gradient.
    fn backward(&self, inputs: [Operand; N], output: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; N]>;
}

/// A contiguous f32 tensor on the CPU, as an operation reads it.
#[derive(Clone, Copy)]
pub(super) struct Operand<'a> {
    pub(super) values: &'a [f32],
    pub(super) storage: &'a CpuStorage,
    pub(super) layout: &'a Layout,
    /// Whether its gradient is needed; known in the backward pass only.
    pub(super) is_tracked: bool,
}

impl<'a> Operand<'a> {
    fn new(storage: &'a CpuStorage, layout: &'a Layout, is_tracked: bool) -> Result<Self> {
        Ok(Self {
            values: slice(storage, layout)?,
            storage,
            layout,
            is_tracked,
        })
    }

    pub(super) fn dims(&self) -> &'a [usize] {
        self.layout.dims()
    }
}

/// The operation's output for these inputs. It passes gradients on if any input does.
pub(super) fn apply<const N: usize>(operation: impl FusedOperation<N>, inputs: [&Tensor; N]) -> Result<Tensor> {
    // candle's operation takes three tensors.
    let absent = Tensor::zeros(0, DType::F32, &Device::Cpu)?;
    let input = |index: usize| inputs.get(index).copied().unwrap_or(&absent).contiguous();
    input(0)?.apply_op3(&input(1)?, &input(2)?, Fused(operation))
}

struct Fused<O, const N: usize>(O);

impl<O: FusedOperation<N>, const N: usize> CustomOp3 for Fused<O, N> {
    fn name(&self) -> &'static str {
        O::NAME
    }

    fn cpu_fwd(
        &self,
        first: &CpuStorage,
        first_layout: &Layout,
        second: &CpuStorage,
        second_layout: &Layout,
        third: &CpuStorage,
        third_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let inputs = [
            Operand::new(first, first_layout, false)?,
            Operand::new(second, second_layout, false)?,
            Operand::new(third, third_layout, false)?,
        ];
        let (values, shape) = self.0.forward(std::array::from_fn(|index| inputs[index]))?;
        Ok((CpuStorage::F32(values), shape))
    }

    fn bwd(
        &self,
        first: &Tensor,
        second: &Tensor,
        third: &Tensor,
        output: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let gradient = gradient.contiguous()?;
        let tensors = [first, second, third, output, &gradient];
        let stored = tensors.map(Tensor::storage_and_layout);
        let operand = |index: usize| {
            let (storage, layout) = &stored[index];
            Operand::new(on_cpu(storage)?, layout, tensors[index].track_op())
        };
        let inputs = [operand(0)?, operand(1)?, operand(2)?];
        let inputs = std::array::from_fn(|index| inputs[index]);
        let mut gradients = (self
            .0
            .backward(inputs, operand(3)?, operand(4)?)?
            .into_iter()
            .zip(tensors))
        .map(|(values, input)| values.map(|values| Tensor::from_vec(values, input.dims(), &Device::Cpu)));
        let mut next = || gradients.next().flatten().transpose();
        Ok((next()?, next()?, next()?))
    }
}
