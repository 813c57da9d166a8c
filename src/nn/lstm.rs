//! An LSTM over time.

use candle_core::Tensor;

use super::NnError;
use super::lstm_cell::{LstmState, PeepholeCell};

/// Runs the cell over a sequence x [B, T, D] from `state`: the outputs [B, T, H] and the last state.
pub fn unroll(cell: &PeepholeCell, x: &Tensor, state: LstmState) -> Result<(Tensor, LstmState), NnError> {
    let mut state = state;
    let mut outputs = Vec::with_capacity(x.dim(1)?);
    for t in 0..x.dim(1)? {
        state = cell.step(&x.get_on_dim(1, t)?.contiguous()?, &state)?;
        outputs.push(state.h.clone());
    }
    Ok((Tensor::stack(&outputs, 1)?, state))
}
