//! Equations (1)–(5) of the paper on rows of plain numbers, and their backward pass. The tests compare
//! values and gradients with the same equations on tensors.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use crate::nn::ops::activation::{sigmoid, tanh};

/// One step of one row. `sums` `[4H]` contains `W_x x + W_h h + b` and is overwritten with the activations i, f, tanh(·),
/// o. `c_before` is the cell state before the step; `c` and `h` `[H]` receive the new state. The peepholes' weights are the
/// diagonals of `W_ci`, `W_cf` and `W_co`, `[H]` each.
#[inline(always)]
pub(super) fn forward(sums: &mut [f32], c_before: &[f32], [w_i, w_f, w_o]: [&[f32]; 3], c: &mut [f32], h: &mut [f32]) {
    let hidden = c.len();
    let (i, rest) = sums.split_at_mut(hidden);
    let (f, rest) = rest.split_at_mut(hidden);
    let (g, o) = rest.split_at_mut(hidden);
    gate(i, w_i, c_before);
    gate(f, w_f, c_before);
    for g in &mut *g {
        *g = tanh(*g);
    }
    for ((((c, c_before), i), f), g) in c.iter_mut().zip(c_before).zip(&*i).zip(&*f).zip(&*g) {
        *c = f * c_before + i * g;
    }
    gate(o, w_o, c);
    for ((h, o), c) in h.iter_mut().zip(&*o).zip(&*c) {
        *h = o * tanh(*c);
    }
}

/// σ(sum + peephole · c), in place.
#[inline(always)]
fn gate(sums: &mut [f32], peephole: &[f32], c: &[f32]) {
    for ((sum, w), c) in sums.iter_mut().zip(peephole).zip(c) {
        *sum = sigmoid(*sum + w * c);
    }
}

/// Values of one row's step that the backward pass needs.
#[derive(Clone, Copy)]
pub(super) struct StepActivations<'a> {
    /// i, f, tanh(·), o `[4H]`.
    pub(super) activations: &'a [f32],
    /// Cell state before the step `[H]`.
    pub(super) c_before: &'a [f32],
    /// Cell state after the step `[H]`.
    pub(super) c: &'a [f32],
}

/// The backward pass of one row's step. `d_h` `[H]` is the gradient of h. `d_c` `[H]` is the gradient of c from later
/// steps and is overwritten with the gradient of `c_before`. `d_sums` `[4H]` receives the gradient of the sums.
#[inline(always)]
pub(super) fn backward(
    step: StepActivations,
    [w_i, w_f, w_o]: [&[f32]; 3],
    d_h: &[f32],
    d_c: &mut [f32],
    d_sums: &mut [f32],
) {
    let StepActivations {
        activations,
        c_before,
        c,
    } = step;
    let hidden = c.len();
    let (i, rest) = activations.split_at(hidden);
    let (f, rest) = rest.split_at(hidden);
    let (g, o) = rest.split_at(hidden);
    let (d_i, rest) = d_sums.split_at_mut(hidden);
    let (d_f, rest) = rest.split_at_mut(hidden);
    let (d_g, d_o) = rest.split_at_mut(hidden);
    // d_g holds tanh(c) until d_o and d_c have been computed.
    for (d_g, c) in d_g.iter_mut().zip(c) {
        *d_g = tanh(*c);
    }
    for (((d_o, d_h), o), tanh_c) in d_o.iter_mut().zip(d_h).zip(o).zip(&*d_g) {
        *d_o = d_h * tanh_c * o * (1.0 - o);
    }
    for (((d_c, d_h), o), tanh_c) in d_c.iter_mut().zip(d_h).zip(o).zip(&*d_g) {
        *d_c += d_h * o * (1.0 - tanh_c * tanh_c);
    }
    add_product(d_c, d_o, w_o);
    for (((d_i, d_c), i), g) in d_i.iter_mut().zip(&*d_c).zip(i).zip(g) {
        *d_i = d_c * g * i * (1.0 - i);
    }
    for (((d_f, d_c), f), c_before) in d_f.iter_mut().zip(&*d_c).zip(f).zip(c_before) {
        *d_f = d_c * c_before * f * (1.0 - f);
    }
    for (((d_g, d_c), i), g) in d_g.iter_mut().zip(&*d_c).zip(i).zip(g) {
        *d_g = d_c * i * (1.0 - g * g);
    }
    for (d_c, f) in d_c.iter_mut().zip(f) {
        *d_c *= f;
    }
    add_product(d_c, d_i, w_i);
    add_product(d_c, d_f, w_f);
}

/// sums += a · b, element by element.
#[inline(always)]
pub(super) fn add_product(sums: &mut [f32], a: &[f32], b: &[f32]) {
    for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
        *sum += a * b;
    }
}
