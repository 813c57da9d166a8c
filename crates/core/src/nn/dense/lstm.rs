//! An LSTM over a sequence of inputs, or over its own output.

use candle_core::Tensor;
use candle_nn::Module as _;

use super::lstm_cell::{Decoder, LstmState, PeepholeCell};
use super::recurrence::{decode_autoregressive, forward_sequence};
use crate::nn::error::NnError;
use crate::nn::ops::linear::{Activation, Linear};

/// Runs the cell over a sequence x `[B, T, D]` from `state`. Returns the outputs `[B, T, H]` and the last state.
pub fn unroll(cell: &PeepholeCell, x: &Tensor, state: &LstmState) -> Result<(Tensor, LstmState), NnError> {
    let (outputs, c) = forward_sequence(cell, &input_projection(cell, x, 0)?, state)?;
    let h = outputs.get(outputs.dim(0)? - 1)?;
    Ok((outputs.transpose(0, 1)?.contiguous()?, LstmState { h, c }))
}

/// The input projection `w_x x + b` of x `[B, T, D]`, with the rows of `w_x` from `first_row`: one matrix product for all
/// steps, `[T, B, 4H]`.
fn input_projection(cell: &PeepholeCell, x: &Tensor, first_row: usize) -> Result<Tensor, NnError> {
    let (batch, steps, inputs) = x.dims3()?;
    let rows = x.transpose(0, 1)?.contiguous()?.flatten(0, 1)?;
    let w_x = cell.w_x.narrow(0, first_row, inputs)?;
    let sums = Linear::new(w_x, cell.bias.clone(), Activation::None).forward(&rows)?;
    Ok(sums.reshape((steps, batch, 4 * cell.hidden()))?)
}

impl Decoder<'_> {
    /// Features `[B, steps, F]` that follow `first` `[B, F]`. Step k also gets `conditions` `[B, steps, A + S]` at k.
    pub(super) fn run(
        &self,
        steps: usize,
        first: &Tensor,
        conditions: Option<&Tensor>,
        state: &LstmState,
    ) -> Result<Tensor, NnError> {
        let projection = match conditions {
            Some(conditions) => input_projection(self.cell, conditions, first.dim(1)?)?,
            None => self.cell.bias.clone(),
        };
        let features = decode_autoregressive(self, steps, &projection, first, state)?;
        Ok(features.transpose(0, 1)?.contiguous()?)
    }
}
