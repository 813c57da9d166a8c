//! One step of the LSTM cell with diagonal peepholes (paper, equations 1–5; Graves 2013).

use candle_core::Tensor;

use super::NnError;

/// The state of an LSTM between two steps.
#[derive(Clone, Debug)]
pub struct LstmState {
    /// Output of the units, h `[B, H]`.
    pub h: Tensor,
    /// Cell state, c `[B, H]`.
    pub c: Tensor,
}

/// The weights of one LSTM layer. Gate order: i, f, c, o.
#[derive(Clone, Debug)]
pub struct PeepholeCell {
    /// Input weights `[D, 4H]`.
    pub(super) w_x: Tensor,
    /// Recurrent weights `[H, 4H]`.
    pub(super) w_h: Tensor,
    /// Bias `[4H]`.
    pub(super) bias: Tensor,
    /// Diagonals of `W_ci`, `W_cf` and `W_co`, `[H]` each.
    pub(super) peepholes: [Tensor; 3],
}

impl PeepholeCell {
    /// A cell with these weights: `w_x` `[D, 4H]`, `w_h` `[H, 4H]`, bias `[4H]`, and the diagonals of `W_ci`, `W_cf`, `W_co` `[H]`.
    #[must_use]
    pub fn new(w_x: Tensor, w_h: Tensor, bias: Tensor, peepholes: [Tensor; 3]) -> Self {
        Self {
            w_x,
            w_h,
            bias,
            peepholes,
        }
    }

    /// Hidden units, H.
    pub(super) fn hidden(&self) -> usize {
        self.bias.elem_count() / 4
    }

    /// The state before the first step: zeros for `batch` windows.
    pub fn zero_state(&self, batch: usize) -> Result<LstmState, NnError> {
        let zeros = Tensor::zeros((batch, self.hidden()), self.bias.dtype(), self.bias.device())?;
        Ok(LstmState {
            h: zeros.clone(),
            c: zeros,
        })
    }

    /// Advances the cell one step (paper, eqs. 1–5). x is `[B, D]`, state `[B, H]`.
    /// For sequences of f32, [`super::lstm`] computes the same in fewer passes over memory.
    pub fn step(&self, x: &Tensor, state: &LstmState) -> Result<LstmState, NnError> {
        let sums = (x.matmul(&self.w_x)?.broadcast_add(&self.bias)? + state.h.matmul(&self.w_h)?)?;
        let hidden = self.hidden();
        let gate = |index: usize| sums.narrow(1, index * hidden, hidden);
        let through_peephole = |peephole: &Tensor, c: &Tensor| c.broadcast_mul(peephole);
        let [w_ci, w_cf, w_co] = &self.peepholes;
        let i = candle_nn::ops::sigmoid(&(gate(0)? + through_peephole(w_ci, &state.c)?)?)?;
        let f = candle_nn::ops::sigmoid(&(gate(1)? + through_peephole(w_cf, &state.c)?)?)?;
        let c = ((f * &state.c)? + (i * gate(2)?.tanh()?)?)?;
        let o = candle_nn::ops::sigmoid(&(gate(3)? + through_peephole(w_co, &c)?)?)?;
        let h = (o * c.tanh()?)?;
        Ok(LstmState { h, c })
    }
}
