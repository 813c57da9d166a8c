//! An LSTM over a sequence of inputs, or over its own output. f32 uses one fused operation (`recurrence`). Other types,
//! which only tests use, call [`PeepholeCell::step`] for each step.

use candle_core::{DType, Tensor};

use super::NnError;
use super::dense::{Activation, Dense};
use super::lstm_cell::{LstmState, PeepholeCell};
use super::recurrence::{decode_autoregressive, forward_sequence};

/// Runs the cell over a sequence x `[B, T, D]` from `state`. Returns the outputs `[B, T, H]` and the last state.
pub fn unroll(cell: &PeepholeCell, x: &Tensor, state: &LstmState) -> Result<(Tensor, LstmState), NnError> {
    let (batch, steps, _) = x.dims3()?;
    if x.dtype() == DType::F32 {
        let (outputs, c) = forward_sequence(cell, &input_projection(cell, x, 0)?, state)?;
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

/// The input projection `w_x x + b` of x `[B, T, D]`, with the rows of `w_x` from `first_row`: one matrix product for all
/// steps, `[T, B, 4H]`.
fn input_projection(cell: &PeepholeCell, x: &Tensor, first_row: usize) -> Result<Tensor, NnError> {
    let (batch, steps, inputs) = x.dims3()?;
    let rows = x.transpose(0, 1)?.contiguous()?.flatten(0, 1)?;
    let w_x = cell.w_x.narrow(0, first_row, inputs)?;
    let sums = Dense::new(w_x, cell.bias.clone(), Activation::Linear).forward(&rows)?;
    Ok(sums.reshape((steps, batch, 4 * cell.hidden()))?)
}

/// An autoregressive LSTM decoder: each step gets the output of the step before.
#[derive(Clone, Copy, Debug)]
pub struct Decoder<'a> {
    /// The cell. Its inputs are the features, then the conditioning inputs.
    pub cell: &'a PeepholeCell,
    /// The layer from the cell's output to features.
    pub output: &'a Dense,
    /// Whether the output is added to the previous features, instead of replacing them.
    pub residual: bool,
}

impl Decoder<'_> {
    /// Features `[B, steps, F]` that follow `first` `[B, F]`. Step k also gets `conditions` `[B, steps, A + S]` at k.
    pub fn run(
        &self,
        steps: usize,
        first: &Tensor,
        conditions: Option<&Tensor>,
        state: &LstmState,
    ) -> Result<Tensor, NnError> {
        if first.dtype() == DType::F32 {
            let projection = match conditions {
                Some(conditions) => input_projection(self.cell, conditions, first.dim(1)?)?,
                None => self.cell.bias.clone(),
            };
            let features = decode_autoregressive(self, steps, &projection, first, state)?;
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
