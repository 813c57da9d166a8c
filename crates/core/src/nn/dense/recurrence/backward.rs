//! The backward pass of a recurrence: from the gradient of its output to the gradients of the sums, the start and the
//! weights.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use candle_core::{Result, Tensor};

use super::steps::{Recurrence, RecurrenceTrace};
use crate::nn::dense::gates::{self, StepActivations, add_product};
use crate::nn::tensors::{add_columns, matrix, with_values};
use crate::vectorized::vectorized;

/// Gradients of the backward pass.
pub(super) struct RecurrenceGradients {
    /// Of the sums [T · B, 4H].
    pub(super) sums: Vec<f32>,
    /// Of h and c before the step, `[B, H]` each.
    pub(super) h: Vec<f32>,
    pub(super) c: Vec<f32>,
    /// Of the features after each step [T · B, F], and of the features before the first step `[B, F]`.
    pub(super) features: Vec<f32>,
    pub(super) first: Vec<f32>,
    /// Of the peepholes, `[H]` each.
    peepholes: [Vec<f32>; 3],
}

impl Recurrence {
    /// Propagates the gradient of the output backward through every step.
    pub(super) fn backward(&self, trace: &RecurrenceTrace, gradient: &[f32]) -> Result<RecurrenceGradients> {
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
                    let d_h = matrix(gradients.first.clone(), features)?.matmul(&feedback.weight.t()?)?;
                    with_values(&d_h, |d_h| add_columns(&mut gradients.h, d_h))?;
                    if !feedback.residual {
                        gradients.first.fill(0.0);
                    }
                }
            }
            self.backward_step(trace, &mut gradients, t, batch);
            let sums = &gradients.sums[t * batch * 4 * hidden..(t + 1) * batch * 4 * hidden];
            let sums = matrix(sums.to_vec(), 4 * hidden)?;
            with_values(&sums.matmul(&self.w_h.t()?)?, |h| gradients.h.copy_from_slice(h))?;
            if let Some(feedback) = &self.feedback {
                let d_features = sums.matmul(&feedback.w_x.t()?)?;
                with_values(&d_features, |d_features| add_columns(&mut gradients.first, d_features))?;
            }
        }
        Ok(gradients)
    }

    fn backward_step(&self, trace: &RecurrenceTrace, gradients: &mut RecurrenceGradients, t: usize, batch: usize) {
        let hidden = self.hidden;
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
                    gates::backward(step, self.peepholes(), &h[state.clone()], &mut c[state], d_sums);
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
        sums: &Tensor,
    ) -> Result<Tensor> {
        let (hidden, features) = (self.hidden, self.features());
        let batch = gradients.h.len() / hidden;
        let before = |values: &[f32], size: usize| matrix(values[..values.len() - batch * size].to_vec(), size);
        let mut parts = vec![before(&trace.h, hidden)?.t()?.matmul(sums)?.flatten_all()?];
        for peephole in &gradients.peepholes {
            parts.push(Tensor::from_slice(peephole, hidden, sums.device())?);
        }
        if self.feedback.is_some() {
            parts.push(before(&trace.features, features)?.t()?.matmul(sums)?.flatten_all()?);
            let after = matrix(trace.h[batch * hidden..].to_vec(), hidden)?;
            let change = matrix(gradients.features.clone(), features)?;
            parts.push(after.t()?.matmul(&change)?.flatten_all()?);
            let mut bias = vec![0.0; features];
            add_columns(&mut bias, &gradients.features);
            parts.push(Tensor::from_vec(bias, features, sums.device())?);
        }
        Tensor::cat(&parts, 0)
    }
}
