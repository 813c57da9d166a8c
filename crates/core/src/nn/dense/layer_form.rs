//! How the dense network's layers are computed: in fused operations on the CPU, or in plain tensor operations on any device.

use candle_core::Tensor;
use candle_nn::Module as _;

use super::lstm::unroll;
use super::lstm_cell::{Decoder, DecoderInputs, LstmState, PeepholeCell};
use super::plain;
use crate::nn::error::NnError;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::linear::Linear;
use crate::nn::plain::layers;

/// How layers are computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LayerForm {
    Fused,
    Plain,
}

impl LayerForm {
    /// That of a network of these tensors.
    pub(super) fn of(tensors: &ModelTensors) -> Self {
        if tensors.are_plain() { Self::Plain } else { Self::Fused }
    }

    /// A linear layer of rows `[N, D]`.
    pub(super) fn linear(self, layer: &Linear, x: &Tensor) -> Result<Tensor, NnError> {
        Ok(match self {
            Self::Fused => layer.forward(x)?,
            Self::Plain => layers::linear(layer, x)?,
        })
    }

    /// As [`unroll`].
    pub(super) fn unroll(
        self,
        cell: &PeepholeCell,
        x: &Tensor,
        state: &LstmState,
    ) -> Result<(Tensor, LstmState), NnError> {
        match self {
            Self::Fused => unroll(cell, x, state),
            Self::Plain => Ok(plain::unroll(cell, x, state)?),
        }
    }

    /// The features `[B, steps, F]` that a decoder gives.
    pub(super) fn decode(self, decoder: &Decoder, inputs: DecoderInputs, state: &LstmState) -> Result<Tensor, NnError> {
        match self {
            Self::Fused => decoder.run(inputs, state),
            Self::Plain => Ok(plain::decode(decoder, inputs, state)?),
        }
    }
}
