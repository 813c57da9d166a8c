//! The forward pass of a recurrence: one step after another, with the values that the backward pass needs.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use std::sync::Mutex;

use candle_core::{Result, Tensor};

use crate::nn::dense::gates::{self, Peepholes};
use crate::nn::tensors::{add_columns, matrix, with_values};
use crate::vectorized::vectorized;

/// The output layer of an autoregressive decoder; its output is an input of the cell's next step.
#[derive(Clone)]
pub(super) struct FeedbackLoop {
    /// Weights from the features to the cell's sums `[F, 4H]`.
    pub(super) w_x: Tensor,
    /// Weights from the cell's output to the features `[H, F]`.
    pub(super) weight: Tensor,
    /// Bias of the features `[F]`.
    pub(super) bias: Vec<f32>,
    /// Whether the layer's output is added to the previous features, instead of replacing them.
    pub(super) residual: bool,
}

/// Values of all steps that the backward pass needs. Rows: the B rows of the first step, then those of the next step, …
pub(super) struct RecurrenceTrace {
    /// [T · B, 4H].
    pub(super) activations: Vec<f32>,
    /// [(T + 1) · B, H].
    pub(super) h: Vec<f32>,
    /// [(T + 1) · B, H].
    pub(super) c: Vec<f32>,
    /// [(T + 1) · B, F].
    pub(super) features: Vec<f32>,
}

/// An LSTM over all steps of a sequence, or of its own output.
pub(super) struct Recurrence {
    pub(super) steps: usize,
    pub(super) hidden: usize,
    pub(super) w_h: Tensor,
    pub(super) peepholes: [Vec<f32>; 3],
    pub(super) feedback: Option<FeedbackLoop>,
    pub(super) trace: Mutex<Option<RecurrenceTrace>>,
}

impl Recurrence {
    pub(super) fn features(&self) -> usize {
        self.feedback.as_ref().map_or(0, |feedback| feedback.bias.len())
    }

    pub(super) fn peepholes(&self) -> Peepholes<'_> {
        let [i, f, o] = &self.peepholes;
        Peepholes { i, f, o }
    }

    /// Computes all steps from `start` `[B, H + H + F]`.
    pub(super) fn run(&self, projection: &[f32], start: &[f32]) -> Result<RecurrenceTrace> {
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
