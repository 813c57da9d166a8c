//! The weights and the state of an LSTM cell with diagonal peepholes (paper, equations 1–5; Graves 2013).

use candle_core::Tensor;

use crate::nn::error::NnError;
use crate::nn::ops::linear::Linear;

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
}

/// An autoregressive LSTM decoder: each step gets the output of the step before.
#[derive(Clone, Copy, Debug)]
pub(super) struct Decoder<'a> {
    /// The cell. Its inputs are the features, then the conditioning inputs.
    pub(super) cell: &'a PeepholeCell,
    /// The layer from the cell's output to features.
    pub(super) output: &'a Linear,
    /// Whether the output is added to the previous features, instead of replacing them.
    pub(super) residual: bool,
}

/// What a decoder starts from, beside the cell's state.
#[derive(Clone, Copy, Debug)]
pub(super) struct DecoderInputs<'a> {
    /// Steps to decode.
    pub(super) steps: usize,
    /// The features before the first step, `[B, F]`.
    pub(super) first: &'a Tensor,
    /// What each step also gets, `[B, steps, A + S]`.
    pub(super) conditions: Option<&'a Tensor>,
}
