//! A whole sequence of LSTM steps as one f32 operation with its own backward pass. Compared with one graph node per sum and
//! gate, it needs far fewer passes over memory, and each weight's gradient is one matrix product over all steps.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

mod backward;

use std::sync::{Mutex, PoisonError};

use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};

use super::gates::{self, Peepholes};
use super::lstm::Decoder;
use super::lstm_cell::{LstmState, PeepholeCell};
use super::tensors::{add_columns, matrix, slice, with_values};
use crate::vectorized::vectorized;

/// The output layer of an autoregressive decoder; its output is an input of the cell's next step.
#[derive(Clone)]
struct FeedbackLoop {
    /// Weights from the features to the cell's sums `[F, 4H]`.
    w_x: Tensor,
    /// Weights from the cell's output to the features `[H, F]`.
    weight: Tensor,
    /// Bias of the features `[F]`.
    bias: Vec<f32>,
    /// Whether the layer's output is added to the previous features, instead of replacing them.
    residual: bool,
}

/// Values of all steps that the backward pass needs. Rows: the B rows of the first step, then those of the next step, …
struct RecurrenceTrace {
    /// [T · B, 4H].
    activations: Vec<f32>,
    /// [(T + 1) · B, H].
    h: Vec<f32>,
    /// [(T + 1) · B, H].
    c: Vec<f32>,
    /// [(T + 1) · B, F].
    features: Vec<f32>,
}

struct Recurrence {
    steps: usize,
    hidden: usize,
    w_h: Tensor,
    peepholes: [Vec<f32>; 3],
    feedback: Option<FeedbackLoop>,
    trace: Mutex<Option<RecurrenceTrace>>,
}

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

    fn features(&self) -> usize {
        self.feedback.as_ref().map_or(0, |feedback| feedback.bias.len())
    }

    fn peepholes(&self) -> Peepholes<'_> {
        let [i, f, o] = &self.peepholes;
        Peepholes { i, f, o }
    }

    /// Computes all steps from `start` `[B, H + H + F]`.
    fn run(&self, projection: &[f32], start: &[f32]) -> Result<RecurrenceTrace> {
        let (hidden, features) = (self.hidden, self.features());
        let batch = start.len() / (2 * hidden + features);
        let mut trace = RecurrenceTrace::new(start, [hidden, hidden, features], self.steps);
        for t in 0..self.steps {
            let before = t * batch..(t + 1) * batch;
            let h = matrix(trace.h[before.start * hidden..before.end * hidden].to_vec(), hidden)?;
            let recurrent = h.matmul(&self.w_h)?;
            let projected_features = match &self.feedback {
                Some(feedback) => {
                    let previous = trace.features[before.start * features..before.end * features].to_vec();
                    Some(matrix(previous, features)?.matmul(&feedback.w_x)?)
                }
                None => None,
            };
            let projection = if projection.len() == 4 * hidden {
                projection
            } else {
                &projection[before.start * 4 * hidden..before.end * 4 * hidden]
            };
            let mut advance = |parts: [&[f32]; 3]| self.advance(&mut trace, t, batch, parts);
            with_values(&recurrent, |recurrent| {
                if let Some(projected_features) = &projected_features {
                    with_values(projected_features, |projected_features| {
                        advance([projection, recurrent, projected_features]);
                    })
                } else {
                    advance([projection, recurrent, &[]]);
                    Ok(())
                }
            })??;
            if let Some(feedback) = &self.feedback {
                let h = matrix(
                    trace.h[before.end * hidden..(before.end + batch) * hidden].to_vec(),
                    hidden,
                )?;
                let change = h.matmul(&feedback.weight)?;
                feedback.advance(&mut trace.features, before.start * features, &change)?;
            }
        }
        Ok(trace)
    }

    /// Computes step `t` from the parts of its sums.
    fn advance(&self, trace: &mut RecurrenceTrace, t: usize, batch: usize, parts: [&[f32]; 3]) {
        let hidden = self.hidden;
        let RecurrenceTrace { activations, h, c, .. } = trace;
        let (c_before, c) = c[t * batch * hidden..].split_at_mut(batch * hidden);
        let h = &mut h[(t + 1) * batch * hidden..];
        let sums = &mut activations[t * batch * 4 * hidden..(t + 1) * batch * 4 * hidden];
        vectorized(
            #[inline(always)]
            || {
                let states = c_before
                    .chunks_exact(hidden)
                    .zip(c.chunks_exact_mut(hidden))
                    .zip(h.chunks_exact_mut(hidden));
                for (row, (sums, ((c_before, c), h))) in sums.chunks_exact_mut(4 * hidden).zip(states).enumerate() {
                    for part in parts.iter().filter(|part| !part.is_empty()) {
                        let from = if part.len() == 4 * hidden { 0 } else { row * 4 * hidden };
                        add_columns(sums, &part[from..from + 4 * hidden]);
                    }
                    gates::forward(sums, c_before, self.peepholes(), c, h);
                }
            },
        );
    }
}

impl FeedbackLoop {
    /// Computes the features after the step whose input features start at index `from`.
    fn advance(&self, features: &mut [f32], from: usize, change: &Tensor) -> Result<()> {
        let bias = &self.bias;
        with_values(change, |change| {
            let (before, after) = features[from..].split_at_mut(change.len());
            for ((after, change), before) in after
                .chunks_exact_mut(bias.len())
                .zip(change.chunks_exact(bias.len()))
                .zip(before.chunks_exact(bias.len()))
            {
                after.copy_from_slice(change);
                add_columns(after, bias);
                if self.residual {
                    add_columns(after, before);
                }
            }
        })
    }
}

impl RecurrenceTrace {
    /// Allocates memory for all steps and writes the state before the first step.
    fn new(start: &[f32], sizes: [usize; 3], steps: usize) -> Self {
        let [hidden, _, features] = sizes;
        let width = 2 * hidden + features;
        let batch = start.len() / width;
        let mut trace = Self {
            activations: vec![0.0; steps * batch * 4 * hidden],
            h: vec![0.0; (steps + 1) * batch * hidden],
            c: vec![0.0; (steps + 1) * batch * hidden],
            features: vec![0.0; (steps + 1) * batch * features],
        };
        for (row, start) in start.chunks_exact(width).enumerate() {
            let (h, rest) = start.split_at(hidden);
            let (c, first) = rest.split_at(hidden);
            trace.h[row * hidden..(row + 1) * hidden].copy_from_slice(h);
            trace.c[row * hidden..(row + 1) * hidden].copy_from_slice(c);
            trace.features[row * features..(row + 1) * features].copy_from_slice(first);
        }
        trace
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
