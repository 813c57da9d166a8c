//! A whole sequence of LSTM steps as one f32 operation with its own backward pass. Compared with one graph node per sum and
//! gate, it needs far fewer passes over memory, and each weight's gradient is one matrix product over all steps.

mod backward;
mod steps;

use std::sync::OnceLock;

use candle_core::{Result, Shape, Tensor, bail};

pub(super) use self::steps::{FeedbackLoop, Recurrence};
use super::lstm_cell::PeepholeCell;
use crate::nn::fused::{self, FusedOperation, Operand};
use crate::nn::tensors::add_columns;

impl PeepholeCell {
    /// The weights whose gradients the operation computes, in its order.
    pub(super) fn recurrent_weights(&self) -> Vec<Tensor> {
        let peepholes = self.peepholes.iter();
        std::iter::once(&self.w_h).chain(peepholes).cloned().collect()
    }
}

impl Recurrence {
    pub(super) fn new(cell: &PeepholeCell, feedback: Option<FeedbackLoop>, steps: usize) -> Result<Self> {
        let [i, f, o] = &cell.peepholes;
        Ok(Self {
            steps,
            hidden: cell.hidden(),
            w_h: cell.w_h.detach(),
            peepholes: [i.to_vec1()?, f.to_vec1()?, o.to_vec1()?],
            feedback,
            trace: OnceLock::new(),
        })
    }

    /// Applies the operation to the contribution of the inputs and the bias, `projection` `[T · B, 4H]`, or `[4H]` if it is
    /// the same in every step, and to `start` `[B, H + H + F]`. Gives the features `[T, B, F]` with feedback, else every h
    /// and the last c `[T + 1, B, H]`.
    ///
    /// `weights` are an argument only to receive their gradients. They are joined in one vector, because an operation takes
    /// three arguments, and left out if no gradients are needed.
    pub(super) fn apply(self, projection: &Tensor, start: &Tensor, weights: &[Tensor]) -> Result<Tensor> {
        if !weights.iter().chain([projection, start]).any(Tensor::track_op) {
            return fused::apply(self, [projection, start, start]);
        }
        let flat = weights.iter().map(Tensor::flatten_all).collect::<Result<Vec<_>>>()?;
        fused::apply(self, [projection, start, &Tensor::cat(&flat, 0)?])
    }
}

impl FusedOperation<3> for Recurrence {
    const NAME: &'static str = "recurrence";

    fn forward(&self, [projection, start, _weights]: [Operand; 3]) -> Result<(Vec<f32>, Shape)> {
        let trace = self.run(projection.values, start.values)?;
        let (steps, hidden, features) = (self.steps, self.hidden, self.features());
        let batch = start.dims()[0];
        let (values, shape) = if self.feedback.is_some() {
            let features_after = trace.features[batch * features..].to_vec();
            (features_after, (steps, batch, features))
        } else {
            let mut values = trace.h[batch * hidden..].to_vec();
            values.extend_from_slice(&trace.c[steps * batch * hidden..]);
            (values, (steps + 1, batch, hidden))
        };
        if self.trace.set(trace).is_err() {
            bail!("a recurrence that runs twice is a bug");
        }
        Ok((values, Shape::from(shape)))
    }

    fn backward(
        &self,
        [projection, ..]: [Operand; 3],
        _output: Operand,
        gradient: Operand,
    ) -> Result<[Option<Vec<f32>>; 3]> {
        let Some(trace) = self.trace.get() else {
            bail!("the recurrence has no forward pass to differentiate; this is a bug");
        };
        let gradients = self.propagate(trace, gradient.values)?;
        let weights = self.weight_gradients(trace, &gradients)?;
        let (hidden, features) = (self.hidden, self.features());
        let mut start = Vec::new();
        for row in 0..gradients.h.len() / hidden {
            start.extend_from_slice(&gradients.h[row * hidden..(row + 1) * hidden]);
            start.extend_from_slice(&gradients.c[row * hidden..(row + 1) * hidden]);
            start.extend_from_slice(&gradients.first[row * features..(row + 1) * features]);
        }
        let sums = if projection.dims().len() == 1 {
            let mut columns = vec![0.0; 4 * hidden];
            add_columns(&mut columns, &gradients.sums);
            columns
        } else {
            gradients.sums
        };
        Ok([sums, start, weights].map(Some))
    }
}
