//! The weights and the state of an LSTM cell with diagonal peepholes (paper, equations 1–5; Graves 2013).

use std::sync::Arc;

use candle_core::Tensor;

use crate::nn::error::NnError;
use crate::nn::ops::linear::Linear;
use crate::nn::ops::row_weights::RowWeights;
use crate::nn::precision::Precision;
use crate::nn::tensors::with_values;

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
    /// For prediction; `None` in training.
    pub(super) packed: Option<Arc<PackedCell>>,
}

/// The weights of a cell, packed.
#[derive(Debug)]
pub(super) struct PackedCell {
    /// Of the inputs that are fed back, which come first; none for an encoder.
    pub(super) fed_back: Option<RowWeights>,
    /// Of the other inputs, with the bias.
    pub(super) projection: RowWeights,
    pub(super) recurrent: RowWeights,
    /// The bias alone `[4H]`.
    pub(super) bias: Vec<f32>,
    /// As in [`PeepholeCell`].
    pub(super) peepholes: [Vec<f32>; 3],
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
            packed: None,
        }
    }

    /// Packs the weights as they are now; so many of the inputs are fed back.
    pub(super) fn pack(&mut self, fed_back: usize, precision: Precision) -> Result<(), NnError> {
        let (inputs, width) = self.w_x.dims2()?;
        let no_bias = vec![0.0; width];
        let bias = self.bias.to_vec1::<f32>()?;
        let [i, f, o] = &self.peepholes;
        let of_rows = |first: usize, rows: usize, bias: &[f32]| {
            let rows = self.w_x.narrow(0, first, rows)?;
            with_values(&rows, |weights| RowWeights::new(weights, bias, precision))
        };
        let packed = PackedCell {
            fed_back: (fed_back > 0).then(|| of_rows(0, fed_back, &no_bias)).transpose()?,
            projection: of_rows(fed_back, inputs - fed_back, &bias)?,
            recurrent: with_values(&self.w_h, |weights| RowWeights::new(weights, &no_bias, precision))?,
            peepholes: [i.to_vec1()?, f.to_vec1()?, o.to_vec1()?],
            bias,
        };
        self.packed = Some(Arc::new(packed));
        Ok(())
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
