//! An LSTM over time: driven by a sequence, or by its own output. f32 goes through one fused operation
//! (`recurrence`); other types, which only tests use, go step by step through [`PeepholeCell::step`].

use candle_core::{DType, Tensor};

use super::NnError;
use super::dense::{Activation, Dense};
use super::lstm_cell::{LstmState, PeepholeCell};
use super::recurrence::{decode_autoregressive, forward_sequence};

/// Runs the cell over a sequence x `[B, T, D]` from `state`: the outputs `[B, T, H]` and the last state.
pub fn unroll(cell: &PeepholeCell, x: &Tensor, state: &LstmState) -> Result<(Tensor, LstmState), NnError> {
    let (batch, steps, _) = x.dims3()?;
    if x.dtype() == DType::F32 {
        let (outputs, c) = forward_sequence(cell, &drive(cell, x, 0)?, state)?;
        let h = outputs.get(steps - 1)?;
        return Ok((outputs.transpose(0, 1)?.contiguous()?, LstmState { h, c }));
    }
    let mut state = state.clone();
    let mut outputs = Vec::with_capacity(batch);
    for t in 0..steps {
        state = cell.step(&x.get_on_dim(1, t)?.contiguous()?, &state)?;
        outputs.push(state.h.clone());
    }
    Ok((Tensor::stack(&outputs, 1)?, state))
}

/// What x `[B, T, D]` adds to the cell's sums through `w_x` from row `first_row`, bias included: one product for all steps,
/// `[T, B, 4H]`.
fn drive(cell: &PeepholeCell, x: &Tensor, first_row: usize) -> Result<Tensor, NnError> {
    let (batch, steps, inputs) = x.dims3()?;
    let rows = x.transpose(0, 1)?.contiguous()?.flatten(0, 1)?;
    let w_x = cell.w_x.narrow(0, first_row, inputs)?;
    let sums = Dense::new(w_x, cell.bias.clone(), Activation::Linear).forward(&rows)?;
    Ok(sums.reshape((steps, batch, 4 * cell.hidden()))?)
}

/// An LSTM that feeds its output back.
#[derive(Clone, Copy, Debug)]
pub struct Decoder<'a> {
    /// The cell; its inputs are the features, then the conditions.
    pub cell: &'a PeepholeCell,
    /// From the cell's output to features.
    pub output: &'a Dense,
    /// Whether the output is a change of the features before, or the features themselves.
    pub residual: bool,
}

impl Decoder<'_> {
    /// Features [B, steps, F] that follow `first` `[B, F]`; step k also takes `conditions` [B, steps, C] at k.
    pub fn run(
        &self,
        steps: usize,
        first: &Tensor,
        conditions: Option<&Tensor>,
        state: &LstmState,
    ) -> Result<Tensor, NnError> {
        if first.dtype() == DType::F32 {
            let drive = match conditions {
                Some(conditions) => drive(self.cell, conditions, first.dim(1)?)?,
                None => self.cell.bias.clone(),
            };
            let features = decode_autoregressive(self, steps, &drive, first, state)?;
            return Ok(features.transpose(0, 1)?.contiguous()?);
        }
        let mut state = state.clone();
        let mut features = vec![first.clone()];
        for k in 0..steps {
            let input = match conditions {
                Some(conditions) => Tensor::cat(&[&features[k], &conditions.get_on_dim(1, k)?], 1)?,
                None => features[k].clone(),
            };
            state = self.cell.step(&input, &state)?;
            let output = self.output.forward(&state.h)?;
            features.push(if self.residual {
                (&features[k] + output)?
            } else {
                output
            });
        }
        Ok(Tensor::stack(&features[1..], 1)?)
    }
}
