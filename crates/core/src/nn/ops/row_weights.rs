//! The weights of a layer without neighbours, packed for prediction in the precision that was chosen.

use std::sync::Arc;

use candle_core::{Result, Tensor};

use super::packed::PackedWeights;
use super::reduced::ReducedWeights;
use crate::nn::precision::Precision;
use crate::nn::recycled::buffer;
use crate::nn::tensors::with_values;

/// The sum of so many products of a byte and a signed one, 255 · 127 each at most, fits 32 bits.
const MOST_INPUTS_OF_BYTES: usize = 1 << 16;

/// Weights `[inputs, outputs]` and a bias.
#[derive(Debug)]
pub(in crate::nn) enum RowWeights {
    Single(PackedWeights),
    Reduced(ReducedWeights),
}

impl RowWeights {
    /// Packs weights `[inputs, outputs]` and a bias `[outputs]`. More inputs than [`MOST_INPUTS_OF_BYTES`] are not multiplied as bytes.
    pub(in crate::nn) fn new(weights: &[f32], bias: &[f32], precision: Precision) -> Self {
        let inputs = weights.len() / bias.len().max(1);
        let is_too_long = precision == Precision::Int8 && inputs > MOST_INPUTS_OF_BYTES;
        if precision == Precision::F32 || is_too_long {
            return Self::Single(PackedWeights::new(weights, bias));
        }
        Self::Reduced(ReducedWeights::new(weights, bias, inputs, precision))
    }

    /// Packs the weights and the bias of a layer as they are now.
    pub(in crate::nn) fn of(weight: &Tensor, bias: &Tensor, precision: Precision) -> Result<Arc<Self>> {
        let packed = with_values(weight, |weights| {
            with_values(bias, |bias| Self::new(weights, bias, precision))
        })??;
        Ok(Arc::new(packed))
    }

    pub(in crate::nn) fn outputs(&self) -> usize {
        match self {
            Self::Single(weights) => weights.outputs(),
            Self::Reduced(weights) => weights.outputs(),
        }
    }

    /// Writes the sums of rows `[rows, inputs]` to `out` `[rows, outputs]`.
    pub(in crate::nn) fn multiply_rows(&self, rows: &[f32], out: &mut [f32]) {
        match self {
            Self::Single(weights) => weights.multiply_rows(rows, out),
            Self::Reduced(weights) => weights.multiply_rows(rows, out),
        }
    }

    /// As [`Self::multiply_rows`], for rows with values of one kind. Bytes of them have one scale, so a row's sums depend a little on the
    /// others.
    pub(in crate::nn) fn multiply_alike(&self, rows: &[f32], out: &mut [f32]) {
        match self {
            Self::Single(weights) => weights.multiply_rows(rows, out),
            Self::Reduced(weights) => weights.multiply_alike(rows, out),
        }
    }

    /// The sums of that many rows.
    pub(in crate::nn) fn times(&self, values: &[f32], rows: usize) -> Vec<f32> {
        let mut out = buffer(rows * self.outputs());
        self.multiply_rows(values, &mut out);
        out
    }
}
