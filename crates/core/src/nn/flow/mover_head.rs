//! The layers that tell where movers are: whatever drives or walks by itself.

use candle_core::Tensor;

use crate::nn::error::NnError;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::linear::{Linear, per_place};
use crate::nn::ops::modulation::silu;
use crate::nn::ops::pixel_shuffle::pixel_shuffle;
use crate::nn::precision::Precision;

/// The layers that tell where movers are, as logits of each pixel.
#[derive(Clone, Debug)]
pub(super) struct MoverHead {
    pub(super) seen: Linear,
    pub(super) coming: Linear,
}

impl MoverHead {
    pub(super) fn new(tensors: &ModelTensors) -> Self {
        Self {
            seen: tensors.linear("flow.movers.seen"),
            coming: tensors.linear("flow.movers.coming"),
        }
    }

    /// Packs the layers' weights for prediction.
    pub(super) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        self.seen.pack(precision.at_least_bf16())?;
        Ok(self.coming.pack(precision.at_least_bf16())?)
    }

    /// Where they are in the last frames `[contexts, P]`, from the encoder's features.
    pub(super) fn seen(&self, coarse: &Tensor) -> Result<Tensor, NnError> {
        logits(&self.seen, coarse)
    }

    /// Where they will be in each item's frame `[M, P]`, from its state.
    pub(super) fn coming(&self, state: &Tensor) -> Result<Tensor, NnError> {
        logits(&self.coming, state)
    }
}

/// Of the 4×4 pixels of each place `[…, H/4, W/4, C]`.
fn logits(layer: &Linear, features: &Tensor) -> Result<Tensor, NnError> {
    let blocks = per_place(layer, &silu(features)?)?;
    Ok(pixel_shuffle(&pixel_shuffle(&blocks)?)?.flatten_from(1)?)
}
