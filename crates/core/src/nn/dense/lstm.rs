//! An LSTM over a sequence of inputs, or over its own output.

use candle_core::Tensor;
use candle_nn::Module as _;

use super::lstm_cell::{Decoder, DecoderInputs, LstmState, PeepholeCell};
use super::recurrence::{FeedbackLoop, Recurrence};
use crate::nn::error::NnError;
use crate::nn::ops::linear::Linear;

/// Runs the cell over a sequence x `[B, T, D]` from `state`. Returns the outputs `[B, T, H]` and the last state.
pub fn unroll(cell: &PeepholeCell, x: &Tensor, state: &LstmState) -> Result<(Tensor, LstmState), NnError> {
    let steps = x.dim(1)?;
    let start = Tensor::cat(&[&state.h, &state.c], 1)?;
    let recurrence = Recurrence::new(cell, None, steps)?;
    let all = recurrence.apply(&input_projection(cell, x, 0)?, &start, &cell.recurrent_weights())?;
    let outputs = all.narrow(0, 0, steps)?;
    let (h, c) = (outputs.get(steps - 1)?, all.get(steps)?);
    Ok((outputs.transpose(0, 1)?.contiguous()?, LstmState { h, c }))
}

/// The input projection `w_x x + b` of x `[B, T, D]`, with the rows of `w_x` from `first_row`: one matrix product for all
/// steps, `[T · B, 4H]`.
fn input_projection(cell: &PeepholeCell, x: &Tensor, first_row: usize) -> Result<Tensor, NnError> {
    let rows = x.transpose(0, 1)?.contiguous()?.flatten(0, 1)?;
    let layer = Linear {
        weight: cell.w_x.narrow(0, first_row, x.dim(2)?)?,
        bias: cell.bias.clone(),
        has_tanh: false,
        packed: None,
    };
    Ok(layer.forward(&rows)?)
}

impl Decoder<'_> {
    /// The features `[B, steps, F]` of all steps.
    pub(super) fn run(&self, inputs: DecoderInputs, state: &LstmState) -> Result<Tensor, NnError> {
        let DecoderInputs {
            steps,
            first,
            conditions,
        } = inputs;
        let Self { cell, output, residual } = *self;
        let projection = match conditions {
            Some(conditions) => input_projection(cell, conditions, first.dim(1)?)?,
            None => cell.bias.clone(),
        };
        let start = Tensor::cat(&[&state.h, &state.c, first], 1)?;
        // The first rows belong to the features.
        let w_x = cell.w_x.narrow(0, 0, first.dim(1)?)?;
        let feedback = FeedbackLoop {
            w_x: w_x.detach(),
            weight: output.weight.detach(),
            bias: output.bias.to_vec1()?,
            residual,
        };
        let mut weights = cell.recurrent_weights();
        weights.extend([w_x, output.weight.clone(), output.bias.clone()]);
        let features = Recurrence::new(cell, Some(feedback), steps)?.apply(&projection, &start, &weights)?;
        Ok(features.transpose(0, 1)?.contiguous()?)
    }
}
