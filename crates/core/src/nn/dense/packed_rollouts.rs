//! Rollouts with packed weights: the steps of `lstm` and `recurrence`, in buffers that are reused, without what a backward pass needs.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use std::cell::Cell;

use super::gates;
use super::lstm_cell::PackedCell;
use crate::nn::ops::row_weights::RowWeights;
use crate::nn::tensors::add_columns;
use crate::vectorized::vectorized;

/// The layers that predict.
pub(super) struct PackedLayers<'a> {
    pub(super) encoder: &'a PackedCell,
    pub(super) predictor: &'a PackedCell,
    /// From the predictor's output to features.
    pub(super) output: &'a RowWeights,
    /// Whether the output is added to the previous features, instead of replacing them.
    pub(super) residual: bool,
}

/// What is predicted from.
pub(super) struct PackedInputs<'a> {
    /// The features of B windows `[B, context, F]`.
    pub(super) features: &'a [f32],
    pub(super) context: usize,
    /// The window of each of N rollouts.
    pub(super) windows: &'a [u32],
    /// What each step gets beside the features `[N, steps, A + S]`; empty if nothing.
    pub(super) conditions: &'a [f32],
    pub(super) steps: usize,
}

/// Values of the largest buffer that a thread keeps, 16 MiB.
const MOST_VALUES: usize = 1 << 22;

/// What a thread keeps from one prediction to the next: new buffers would be filled with zeros as a whole, these only where they grow.
#[derive(Default)]
struct Buffers {
    encoder: CellBuffers,
    predictor: CellBuffers,
    /// The features that each rollout predicted last, and their change `[N, F]`.
    last: Vec<f32>,
    change: Vec<f32>,
    /// What they add to the predictor's sums `[N, 4H]`.
    fed_back: Vec<f32>,
}

/// Of a cell with some rows.
#[derive(Default)]
struct CellBuffers {
    /// `[rows, H]` each; `next_c` is room for the next `c`.
    h: Vec<f32>,
    c: Vec<f32>,
    next_c: Vec<f32>,
    /// What the inputs of all steps add to the sums `[rows, steps, 4H]`.
    projection: Vec<f32>,
    /// What `h` adds to them `[rows, 4H]`.
    recurrent: Vec<f32>,
}

thread_local! {
    static KEPT: Cell<Buffers> = Cell::default();
}

impl PackedLayers<'_> {
    /// Writes the features `[N, steps, F]` of the rollouts.
    pub(super) fn predict(&self, inputs: &PackedInputs, out: &mut [f32]) {
        let mut buffers = KEPT.take();
        self.read(inputs, &mut buffers.encoder);
        self.begin(inputs, &mut buffers);
        self.decode(out, inputs.steps, &mut buffers);
        let Buffers { encoder, predictor, .. } = &buffers;
        if encoder.projection.len().max(predictor.projection.len()) <= MOST_VALUES {
            KEPT.set(buffers);
        }
    }

    /// The encoder's state after the context.
    fn read(&self, inputs: &PackedInputs, buffers: &mut CellBuffers) {
        let frames = inputs.features.len() / self.output.outputs();
        buffers.resize(frames / inputs.context, inputs.context, self.encoder.hidden());
        buffers.h.fill(0.0);
        buffers.c.fill(0.0);
        self.encoder
            .projection
            .multiply_rows(inputs.features, &mut buffers.projection);
        for step in 0..inputs.context {
            let step = Step {
                index: step,
                of: inputs.context,
                // They add nothing.
                starts_from_zeros: step == 0,
            };
            self.encoder.advance(buffers, step, &[]);
        }
    }

    /// The state of each rollout before its first step: that of its window.
    fn begin(&self, inputs: &PackedInputs, buffers: &mut Buffers) {
        let (hidden, width) = (self.predictor.hidden(), self.output.outputs());
        let rollouts = inputs.windows.len();
        let Buffers {
            encoder,
            predictor,
            last,
            ..
        } = buffers;
        predictor.resize(rollouts, inputs.steps, hidden);
        last.resize(rollouts * width, 0.0);
        // The last values of each window.
        let copy = |to: &mut [f32], from: &[f32], count: usize, step: usize| {
            for (to, &window) in to.chunks_exact_mut(count).zip(inputs.windows) {
                let end = (window as usize + 1) * step;
                to.copy_from_slice(&from[end - count..end]);
            }
        };
        copy(&mut predictor.h, &encoder.h, hidden, hidden);
        copy(&mut predictor.c, &encoder.c, hidden, hidden);
        copy(last, inputs.features, width, inputs.context * width);
        if inputs.conditions.is_empty() {
            let sums = predictor.projection.chunks_exact_mut(4 * hidden);
            sums.for_each(|sums| sums.copy_from_slice(&self.predictor.bias));
        } else {
            self.predictor
                .projection
                .multiply_rows(inputs.conditions, &mut predictor.projection);
        }
    }

    /// Writes the features of each step.
    fn decode(&self, out: &mut [f32], steps: usize, buffers: &mut Buffers) {
        let Buffers {
            predictor,
            last,
            change,
            fed_back,
            ..
        } = buffers;
        let width = self.output.outputs();
        let rollouts = last.len() / width;
        change.resize(last.len(), 0.0);
        fed_back.resize(rollouts * 4 * self.predictor.hidden(), 0.0);
        for step in 0..steps {
            let mut added = &[][..];
            if let Some(weights) = &self.predictor.fed_back {
                weights.multiply_rows(last, fed_back);
                added = fed_back;
            }
            let of_step = Step {
                index: step,
                of: steps,
                starts_from_zeros: false,
            };
            self.predictor.advance(predictor, of_step, added);
            self.output.multiply_rows(&predictor.h, change);
            if self.residual {
                add_columns(last, change);
            } else {
                last.copy_from_slice(change);
            }
            let out = out[step * width..].chunks_mut(steps * width);
            for (out, last) in out.zip(last.chunks_exact(width)) {
                out[..width].copy_from_slice(last);
            }
        }
    }
}

impl CellBuffers {
    fn resize(&mut self, rows: usize, steps: usize, hidden: usize) {
        for state in [&mut self.h, &mut self.c, &mut self.next_c] {
            state.resize(rows * hidden, 0.0);
        }
        self.projection.resize(rows * steps * 4 * hidden, 0.0);
        self.recurrent.resize(rows * 4 * hidden, 0.0);
    }
}

/// A step of a sequence.
#[derive(Clone, Copy)]
struct Step {
    index: usize,
    /// The steps of the sequence.
    of: usize,
    /// Whether `h` is zero before it.
    starts_from_zeros: bool,
}

impl PackedCell {
    fn hidden(&self) -> usize {
        self.bias.len() / 4
    }

    /// Computes one step of all rows. `fed_back` is added to the sums, unless it is empty.
    fn advance(&self, buffers: &mut CellBuffers, step: Step, fed_back: &[f32]) {
        let hidden = self.hidden();
        let CellBuffers {
            h,
            c,
            next_c,
            projection,
            recurrent,
        } = buffers;
        let mut others = [&[][..], fed_back];
        if !step.starts_from_zeros {
            self.recurrent.multiply_rows(h, recurrent);
            others[0] = recurrent;
        }
        let peepholes = self.peepholes.each_ref().map(Vec::as_slice);
        vectorized(
            #[inline(always)]
            || {
                let rows = projection[step.index * 4 * hidden..].chunks_mut(step.of * 4 * hidden);
                let states = h.chunks_exact_mut(hidden).zip(c.chunks_exact(hidden));
                let states = states.zip(next_c.chunks_exact_mut(hidden));
                for (row, (sums, ((h, c), next_c))) in rows.zip(states).enumerate() {
                    let sums = &mut sums[..4 * hidden];
                    for other in others.iter().filter(|other| !other.is_empty()) {
                        add_columns(sums, &other[row * 4 * hidden..][..4 * hidden]);
                    }
                    gates::forward(sums, c, peepholes, next_c, h);
                }
            },
        );
        std::mem::swap(c, next_c);
    }
}
