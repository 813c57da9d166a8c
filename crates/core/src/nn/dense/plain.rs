//! Equations (1)–(5) of the paper in candle's own tensor operations, on any device. The fused recurrence computes the same.

use candle_core::{Result, Tensor};

use super::lstm_cell::{Decoder, DecoderInputs, LstmState, PeepholeCell};
use crate::nn::plain::layers::{linear, sigmoid};

/// One step from the sums of the inputs and the bias, `[B, 4H]`.
fn step(cell: &PeepholeCell, inputs: &Tensor, state: &LstmState) -> Result<LstmState> {
    let sums = (inputs + state.h.matmul(&cell.w_h)?)?;
    let hidden = cell.hidden();
    let part = |index: usize| sums.narrow(1, index * hidden, hidden);
    let [w_i, w_f, w_o] = &cell.peepholes;
    let gate = |sums: Tensor, peephole: &Tensor, c: &Tensor| sigmoid(&(sums + c.broadcast_mul(peephole)?)?);
    let i = gate(part(0)?, w_i, &state.c)?;
    let f = gate(part(1)?, w_f, &state.c)?;
    let c = ((f * &state.c)? + (i * part(2)?.tanh()?)?)?;
    let o = gate(part(3)?, w_o, &c)?;
    Ok(LstmState { h: (o * c.tanh()?)?, c })
}

/// The contribution of inputs `[B, T, D]` to the sums, and the bias, step by step: `[T, B, 4H]`. `first_row`: of the input weights.
fn projection(cell: &PeepholeCell, x: &Tensor, first_row: usize) -> Result<Tensor> {
    let (batch, steps, inputs) = x.dims3()?;
    let rows = x.transpose(0, 1)?.contiguous()?.flatten(0, 1)?;
    let weight = cell.w_x.narrow(0, first_row, inputs)?.contiguous()?;
    let sums = rows.matmul(&weight)?.broadcast_add(&cell.bias)?;
    sums.reshape((steps, batch, ()))
}

/// Runs the cell over a sequence x `[B, T, D]` from `state`. Returns the outputs `[B, T, H]` and the last state.
pub(super) fn unroll(cell: &PeepholeCell, x: &Tensor, state: &LstmState) -> Result<(Tensor, LstmState)> {
    let inputs = projection(cell, x, 0)?;
    let (mut state, mut outputs) = (state.clone(), Vec::new());
    for t in 0..x.dim(1)? {
        state = step(cell, &inputs.get(t)?, &state)?;
        outputs.push(state.h.clone());
    }
    Ok((Tensor::stack(&outputs, 1)?, state))
}

/// The features `[B, steps, F]` that a decoder gives.
pub(super) fn decode(decoder: &Decoder, inputs: DecoderInputs, state: &LstmState) -> Result<Tensor> {
    let Decoder { cell, output, residual } = *decoder;
    let DecoderInputs {
        steps,
        first,
        conditions,
    } = inputs;
    let width = first.dim(1)?;
    // The first rows belong to the features.
    let w_x = cell.w_x.narrow(0, 0, width)?.contiguous()?;
    let known = conditions
        .map(|conditions| projection(cell, conditions, width))
        .transpose()?;
    let (mut state, mut previous, mut features) = (state.clone(), first.clone(), Vec::new());
    for t in 0..steps {
        let fed_back = previous.matmul(&w_x)?;
        let sums = match &known {
            Some(known) => (fed_back + known.get(t)?)?,
            None => fed_back.broadcast_add(&cell.bias)?,
        };
        state = step(cell, &sums, &state)?;
        let change = linear(output, &state.h)?;
        previous = if residual { (previous + change)? } else { change };
        features.push(previous.clone());
    }
    Tensor::stack(&features, 1)
}
