//! A whole sequence of LSTM steps as one f32 operation with its own backward pass. Compared with one graph node per sum and
//! gate, it needs far fewer passes over memory, and each weight's gradient is one matrix product over all steps.

mod backward;
mod steps;

use std::sync::{Mutex, PoisonError};

use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};

use self::steps::{FeedbackLoop, Recurrence};
use super::lstm_cell::{Decoder, LstmState, PeepholeCell};
use crate::nn::tensors::{add_columns, matrix, slice, with_values};

/// Runs the cell over a sequence whose input `projection` `W_x x + b` `[T, B, 4H]` is already computed. Returns every h
/// `[T, B, H]` and the last c `[B, H]`.
pub(super) fn forward_sequence(
    cell: &PeepholeCell,
    projection: &Tensor,
    state: &LstmState,
) -> Result<(Tensor, Tensor)> {
    let steps = projection.dim(0)?;
    let start = Tensor::cat(&[&state.h, &state.c], 1)?;
    let all =
        Recurrence::new(cell, None, steps)?.apply(&projection.flatten(0, 1)?, &start, &cell.recurrent_weights())?;
    Ok((all.narrow(0, 0, steps)?, all.get(steps)?))
}

/// Runs a decoder on its own output. Returns features `[T, B, F]`. The first F rows of the cell's `w_x` belong to the
/// features; `projection` is the contribution of all other inputs and the bias, `[T, B, 4H]`, or `[4H]` if it is the same in
/// every step.
pub(super) fn decode_autoregressive(
    decoder: &Decoder,
    steps: usize,
    projection: &Tensor,
    first: &Tensor,
    state: &LstmState,
) -> Result<Tensor> {
    let Decoder { cell, output, residual } = *decoder;
    let w_x = cell.w_x.narrow(0, 0, first.dim(1)?)?;
    let feedback = FeedbackLoop {
        w_x: w_x.detach(),
        weight: output.weight.detach(),
        bias: output.bias.to_vec1()?,
        residual,
    };
    let start = Tensor::cat(&[&state.h, &state.c, first], 1)?;
    let projection = if projection.rank() == 1 {
        projection.clone()
    } else {
        projection.flatten(0, 1)?
    };
    let mut weights = cell.recurrent_weights();
    weights.extend([w_x, output.weight.clone(), output.bias.clone()]);
    Recurrence::new(cell, Some(feedback), steps)?.apply(&projection, &start, &weights)
}

impl PeepholeCell {
    /// The weights whose gradients the operation computes, in its order.
    fn recurrent_weights(&self) -> Vec<Tensor> {
        let mut weights = vec![self.w_h.clone()];
        weights.extend(self.peepholes.iter().cloned());
        weights
    }
}

impl Recurrence {
    fn new(cell: &PeepholeCell, feedback: Option<FeedbackLoop>, steps: usize) -> Result<Self> {
        let [i, f, o] = &cell.peepholes;
        let values = |tensor: &Tensor| tensor.to_vec1::<f32>();
        Ok(Self {
            steps,
            hidden: cell.hidden(),
            w_h: cell.w_h.detach(),
            peepholes: [values(i)?, values(f)?, values(o)?],
            feedback,
            trace: Mutex::new(None),
        })
    }

    /// Applies the operation. `weights` are an argument only to receive their gradients. They are joined in one vector,
    /// because an operation takes three arguments, and left out if no gradients are needed.
    fn apply(self, projection: &Tensor, start: &Tensor, weights: &[Tensor]) -> Result<Tensor> {
        let (projection, start) = (projection.contiguous()?, start.contiguous()?);
        if !weights.iter().chain([&projection, &start]).any(Tensor::track_op) {
            return projection.apply_op3_no_bwd(&start, &start, &self);
        }
        let flat = weights.iter().map(Tensor::flatten_all).collect::<Result<Vec<_>>>()?;
        projection.apply_op3(&start, &Tensor::cat(&flat, 0)?, self)
    }
}

impl CustomOp3 for Recurrence {
    fn name(&self) -> &'static str {
        "recurrence"
    }

    fn cpu_fwd(
        &self,
        projection: &CpuStorage,
        projection_layout: &Layout,
        start: &CpuStorage,
        start_layout: &Layout,
        _weights: &CpuStorage,
        _weights_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (projection, start) = (slice(projection, projection_layout)?, slice(start, start_layout)?);
        let trace = self.run(projection, start)?;
        let batch = start_layout.dims()[0];
        let result = if self.feedback.is_some() {
            let features = self.features();
            (
                trace.features[batch * features..].to_vec(),
                (self.steps, batch, features),
            )
        } else {
            let mut values = trace.h[batch * self.hidden..].to_vec();
            values.extend_from_slice(&trace.c[self.steps * batch * self.hidden..]);
            (values, (self.steps + 1, batch, self.hidden))
        };
        *self.trace.lock().unwrap_or_else(PoisonError::into_inner) = Some(trace);
        Ok((CpuStorage::F32(result.0), Shape::from(result.1)))
    }

    fn bwd(
        &self,
        projection: &Tensor,
        start: &Tensor,
        _weights: &Tensor,
        _result: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let trace = self.trace.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(trace) = trace.as_ref() else {
            bail!("the recurrence has no forward pass to differentiate; this is a bug");
        };
        let gradients = with_values(gradient, |gradient| self.backward(trace, gradient))??;
        let hidden = self.hidden;
        let sums = matrix(gradients.sums.clone(), 4 * hidden)?;
        let weights = self.weight_gradients(trace, &gradients, &sums)?;
        let projection = if projection.rank() == 1 {
            let mut columns = vec![0.0; 4 * hidden];
            add_columns(&mut columns, &gradients.sums);
            Tensor::from_vec(columns, 4 * hidden, projection.device())?
        } else {
            sums
        };
        let mut parts = vec![matrix(gradients.h, hidden)?, matrix(gradients.c, hidden)?];
        if self.feedback.is_some() {
            parts.push(matrix(gradients.first, start.dim(1)? - 2 * hidden)?);
        }
        Ok((Some(projection), Some(Tensor::cat(&parts, 1)?), Some(weights)))
    }
}
