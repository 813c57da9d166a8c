//! The way back of a recurrence: from the gradient of its output to those of the sums, the start and the weights.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Tensor};
use pulp::Arch;

use super::super::gates::{self, StepActivations, add_product};
use super::super::tensors::{add_columns, matrix, with_values};
use super::{Recurrence, RecurrenceTrace};

/// Gradients on the way back.
pub(super) struct RecurrenceGradients {
    /// Of the sums [T · B, 4H].
    pub(super) sums: Vec<f32>,
    /// Of h and c before the step, `[B, H]` each.
    pub(super) h: Vec<f32>,
    pub(super) c: Vec<f32>,
    /// Of the features after each step [T · B, F], and of those before the first `[B, F]`.
    pub(super) features: Vec<f32>,
    pub(super) first: Vec<f32>,
    /// Of the peepholes, `[H]` each.
    peepholes: [Vec<f32>; 3],
}

impl Recurrence {
    /// From the gradient of the output back through every step.
    pub(super) fn back(&self, trace: &RecurrenceTrace, gradient: &[f32]) -> Result<RecurrenceGradients> {
        let (hidden, features, steps) = (self.hidden, self.features(), self.steps);
        let batch = trace.h.len() / ((steps + 1) * hidden);
        let rows = batch * hidden;
        let mut back = RecurrenceGradients {
            sums: vec![0.0; steps * batch * 4 * hidden],
            h: vec![0.0; rows],
            c: vec![0.0; rows],
            features: vec![0.0; steps * batch * features],
            first: vec![0.0; batch * features],
            peepholes: std::array::from_fn(|_| vec![0.0; hidden]),
        };
        if self.feedback.is_none() {
            back.c.copy_from_slice(&gradient[steps * rows..]);
        }
        for t in (0..steps).rev() {
            match &self.feedback {
                None => add_columns(&mut back.h, &gradient[t * rows..(t + 1) * rows]),
                Some(feedback) => {
                    let step = t * batch * features..(t + 1) * batch * features;
                    add_columns(&mut back.first, &gradient[step.clone()]);
                    back.features[step].copy_from_slice(&back.first);
                    let through = matrix(back.first.clone(), features)?.matmul(&feedback.weight.t()?)?;
                    with_values(&through, |through| add_columns(&mut back.h, through))?;
                    if !feedback.residual {
                        back.first.fill(0.0);
                    }
                }
            }
            self.step_back(trace, &mut back, t, batch);
            let sums = &back.sums[t * batch * 4 * hidden..(t + 1) * batch * 4 * hidden];
            let sums = matrix(sums.to_vec(), 4 * hidden)?;
            with_values(&sums.matmul(&self.w_h.t()?)?, |h| back.h.copy_from_slice(h))?;
            if let Some(feedback) = &self.feedback {
                let fed = sums.matmul(&feedback.w_x.t()?)?;
                with_values(&fed, |fed| add_columns(&mut back.first, fed))?;
            }
        }
        Ok(back)
    }

    fn step_back(&self, trace: &RecurrenceTrace, back: &mut RecurrenceGradients, t: usize, batch: usize) {
        let hidden = self.hidden;
        let RecurrenceGradients {
            sums,
            h,
            c,
            peepholes: [p_i, p_f, p_o],
            ..
        } = back;
        Arch::new().dispatch(
            #[inline(always)]
            || {
                for row in 0..batch {
                    let before = (t * batch + row) * hidden;
                    let after = before + batch * hidden;
                    let kept = StepActivations {
                        activations: &trace.activations[4 * before..4 * (before + hidden)],
                        c_before: &trace.c[before..before + hidden],
                        c: &trace.c[after..after + hidden],
                    };
                    let d_sums = &mut sums[4 * before..4 * (before + hidden)];
                    let state = row * hidden..(row + 1) * hidden;
                    gates::backward(kept, self.peepholes(), &h[state.clone()], &mut c[state], d_sums);
                    add_product(p_i, &d_sums[..hidden], kept.c_before);
                    add_product(p_f, &d_sums[hidden..2 * hidden], kept.c_before);
                    add_product(p_o, &d_sums[3 * hidden..], kept.c);
                }
            },
        );
    }

    /// Gradients of the weights in the order in which they were joined.
    pub(super) fn weights_back(
        &self,
        trace: &RecurrenceTrace,
        back: &RecurrenceGradients,
        sums: &Tensor,
    ) -> Result<Tensor> {
        let (hidden, features) = (self.hidden, self.features());
        let batch = back.h.len() / hidden;
        let past = |values: &[f32], side: usize| matrix(values[..values.len() - batch * side].to_vec(), side);
        let mut parts = vec![past(&trace.h, hidden)?.t()?.matmul(sums)?.flatten_all()?];
        for peephole in &back.peepholes {
            parts.push(Tensor::from_slice(peephole, hidden, sums.device())?);
        }
        if self.feedback.is_some() {
            parts.push(past(&trace.features, features)?.t()?.matmul(sums)?.flatten_all()?);
            let after = matrix(trace.h[batch * hidden..].to_vec(), hidden)?;
            let change = matrix(back.features.clone(), features)?;
            parts.push(after.t()?.matmul(&change)?.flatten_all()?);
            let mut bias = vec![0.0; features];
            add_columns(&mut bias, &back.features);
            parts.push(Tensor::from_vec(bias, features, sums.device())?);
        }
        Tensor::cat(&parts, 0)
    }
}
