//! The backward pass of a recurrence: from the gradient of its output to the gradients of the sums, the start and the
//! weights.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use candle_core::{CpuStorage, Layout, Result};

use super::steps::{Recurrence, RecurrenceTrace};
use crate::nn::dense::gates::{self, StepActivations, add_product};
use crate::nn::tensors::{add_columns, product, rows_times};
use crate::vectorized::vectorized;

/// Gradients of the backward pass.
pub(super) struct RecurrenceGradients {
    /// The gradient of the sums [T · B, 4H].
    pub(super) sums: Vec<f32>,
    /// The gradients of h and c before the step, `[B, H]` each.
    pub(super) h: Vec<f32>,
    pub(super) c: Vec<f32>,
    /// The gradients of the features after each step [T · B, F], and of the features before the first step `[B, F]`.
    pub(super) features: Vec<f32>,
    pub(super) first: Vec<f32>,
    /// The gradients of the peepholes, `[H]` each.
    peepholes: [Vec<f32>; 3],
}

impl Recurrence {
    /// Propagates the gradient of the output backward through every step.
    pub(super) fn propagate(&self, trace: &RecurrenceTrace, gradient: &[f32]) -> Result<RecurrenceGradients> {
        let (hidden, features, steps) = (self.hidden, self.features(), self.steps);
        let batch = trace.h.len() / ((steps + 1) * hidden);
        let rows = batch * hidden;
        let mut gradients = RecurrenceGradients {
            sums: vec![0.0; steps * batch * 4 * hidden],
            h: vec![0.0; rows],
            c: vec![0.0; rows],
            features: vec![0.0; steps * batch * features],
            first: vec![0.0; batch * features],
            peepholes: std::array::from_fn(|_| vec![0.0; hidden]),
        };
        if self.feedback.is_none() {
            gradients.c.copy_from_slice(&gradient[steps * rows..]);
        }
        for t in (0..steps).rev() {
            match &self.feedback {
                None => add_columns(&mut gradients.h, &gradient[t * rows..(t + 1) * rows]),
                Some(feedback) => {
                    let step = t * batch * features..(t + 1) * batch * features;
                    add_columns(&mut gradients.first, &gradient[step.clone()]);
                    gradients.features[step].copy_from_slice(&gradients.first);
                    let d_h = rows_times(&gradients.first, &feedback.weight.t()?)?;
                    add_columns(&mut gradients.h, &d_h);
                    if !feedback.residual {
                        gradients.first.fill(0.0);
                    }
                }
            }
            self.backward_step(trace, &mut gradients, t, batch);
            let sums = &gradients.sums[t * batch * 4 * hidden..(t + 1) * batch * 4 * hidden];
            gradients.h = rows_times(sums, &self.w_h.t()?)?;
            if let Some(feedback) = &self.feedback {
                add_columns(&mut gradients.first, &rows_times(sums, &feedback.w_x.t()?)?);
            }
        }
        Ok(gradients)
    }

    fn backward_step(&self, trace: &RecurrenceTrace, gradients: &mut RecurrenceGradients, t: usize, batch: usize) {
        let (hidden, peepholes) = (self.hidden, self.peepholes());
        let RecurrenceGradients {
            sums,
            h,
            c,
            peepholes: [p_i, p_f, p_o],
            ..
        } = gradients;
        vectorized(
            #[inline(always)]
            || {
                for row in 0..batch {
                    let before = (t * batch + row) * hidden;
                    let after = before + batch * hidden;
                    let step = StepActivations {
                        activations: &trace.activations[4 * before..4 * (before + hidden)],
                        c_before: &trace.c[before..before + hidden],
                        c: &trace.c[after..after + hidden],
                    };
                    let d_sums = &mut sums[4 * before..4 * (before + hidden)];
                    let state = row * hidden..(row + 1) * hidden;
                    gates::backward(step, peepholes, &h[state.clone()], &mut c[state], d_sums);
                    add_product(p_i, &d_sums[..hidden], step.c_before);
                    add_product(p_f, &d_sums[hidden..2 * hidden], step.c_before);
                    add_product(p_o, &d_sums[3 * hidden..], step.c);
                }
            },
        );
    }

    /// Gradients of the weights, in the order in which the weights were joined.
    pub(super) fn weight_gradients(
        &self,
        trace: &RecurrenceTrace,
        gradients: &RecurrenceGradients,
    ) -> Result<Vec<f32>> {
        let (hidden, features) = (self.hidden, self.features());
        let batch = gradients.h.len() / hidden;
        let (h_before, h_after) = (&trace.h[..trace.h.len() - batch * hidden], &trace.h[batch * hidden..]);
        let mut weights = transposed_times((h_before, hidden), (&gradients.sums, 4 * hidden))?;
        weights.extend(gradients.peepholes.iter().flatten());
        if self.feedback.is_some() {
            let before = &trace.features[..trace.features.len() - batch * features];
            weights.extend(transposed_times((before, features), (&gradients.sums, 4 * hidden))?);
            weights.extend(transposed_times((h_after, hidden), (&gradients.features, features))?);
            let mut bias = vec![0.0; features];
            add_columns(&mut bias, &gradients.features);
            weights.extend(bias);
        }
        Ok(weights)
    }
}

/// The product of a transposed matrix with another, both given by their rows and the length of a row.
fn transposed_times((left, columns): (&[f32], usize), (right, width): (&[f32], usize)) -> Result<Vec<f32>> {
    let rows = left.len() / columns;
    let left_layout = Layout::contiguous((rows, columns)).transpose(0, 1)?;
    let [left, right] = [left, right].map(|values| CpuStorage::F32(values.to_vec()));
    product((&left, &left_layout), (&right, &Layout::contiguous((rows, width))))
}
