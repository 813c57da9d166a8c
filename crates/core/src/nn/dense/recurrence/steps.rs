//! The forward pass of a recurrence: one step after another, with the values that the backward pass needs.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use std::sync::OnceLock;

use candle_core::{Result, Tensor};

use crate::nn::dense::gates;
use crate::nn::tensors::{add_columns, rows_times};
use crate::vectorized::vectorized;

/// The output layer of an autoregressive decoder; its output is an input of the cell's next step.
pub(in crate::nn::dense) struct FeedbackLoop {
    /// Weights from the features to the cell's sums `[F, 4H]`.
    pub(in crate::nn::dense) w_x: Tensor,
    /// Weights from the cell's output to the features `[H, F]`.
    pub(in crate::nn::dense) weight: Tensor,
    /// Bias of the features `[F]`.
    pub(in crate::nn::dense) bias: Vec<f32>,
    /// Whether the layer's output is added to the previous features, instead of replacing them.
    pub(in crate::nn::dense) residual: bool,
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
pub(in crate::nn::dense) struct Recurrence {
    pub(super) steps: usize,
    pub(super) hidden: usize,
    pub(super) w_h: Tensor,
    pub(super) peepholes: [Vec<f32>; 3],
    pub(super) feedback: Option<FeedbackLoop>,
    pub(super) trace: OnceLock<RecurrenceTrace>,
}

impl Recurrence {
    pub(super) fn features(&self) -> usize {
        self.feedback.as_ref().map_or(0, |feedback| feedback.bias.len())
    }

    /// Diagonals of `W_ci`, `W_cf`, `W_co`, `[H]` each.
    pub(super) fn peepholes(&self) -> [&[f32]; 3] {
        self.peepholes.each_ref().map(Vec::as_slice)
    }

    /// Computes all steps from `start` `[B, H + H + F]`.
    pub(super) fn run(&self, projection: &[f32], start: &[f32]) -> Result<RecurrenceTrace> {
        let (hidden, features) = (self.hidden, self.features());
        let batch = start.len() / (2 * hidden + features);
        let mut trace = RecurrenceTrace::new(start, [hidden, features], self.steps);
        for t in 0..self.steps {
            // A step's part of values with this many in a row.
            let range = |t: usize, size: usize| t * batch * size..(t + 1) * batch * size;
            let recurrent = rows_times(&trace.h[range(t, hidden)], &self.w_h)?;
            let fed_back = match &self.feedback {
                Some(feedback) => rows_times(&trace.features[range(t, features)], &feedback.w_x)?,
                None => Vec::new(),
            };
            let projection = if projection.len() == 4 * hidden {
                projection
            } else {
                &projection[range(t, 4 * hidden)]
            };
            self.advance(&mut trace, t, [projection, &recurrent, &fed_back]);
            if let Some(feedback) = &self.feedback {
                let change = rows_times(&trace.h[range(t + 1, hidden)], &feedback.weight)?;
                feedback.advance(&mut trace.features[t * batch * features..], &change);
            }
        }
        Ok(trace)
    }

    /// Computes step `t` from the parts of its sums.
    fn advance(&self, trace: &mut RecurrenceTrace, t: usize, parts: [&[f32]; 3]) {
        let (hidden, peepholes) = (self.hidden, self.peepholes());
        let batch = trace.h.len() / ((self.steps + 1) * hidden);
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
                    gates::forward(sums, c_before, peepholes, c, h);
                }
            },
        );
    }
}

impl FeedbackLoop {
    /// Computes the features after a step; `features` begin with those before it.
    fn advance(&self, features: &mut [f32], change: &[f32]) {
        let count = self.bias.len();
        let (before, after) = features.split_at_mut(change.len());
        let rows = after.chunks_exact_mut(count).zip(change.chunks_exact(count));
        for ((after, change), before) in rows.zip(before.chunks_exact(count)) {
            after.copy_from_slice(change);
            add_columns(after, &self.bias);
            if self.residual {
                add_columns(after, before);
            }
        }
    }
}

impl RecurrenceTrace {
    /// Allocates memory for all steps and writes the state before the first step.
    fn new(start: &[f32], [hidden, features]: [usize; 2], steps: usize) -> Self {
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
