//! How fast the camera drives and turns, as [`super::super::speed_head`] says.

use candle_core::{Device, Tensor};

use crate::nn::error::NnError;
use crate::nn::flow::encoder_views::EncoderViews;
use crate::nn::flow::speed_head::{SpeedHead, counted, speed_inputs};
use crate::nn::plain::convolution::convolution;
use crate::nn::plain::layers::linear_per_place;

impl SpeedHead {
    /// Forward speed in m/s and yaw rate in rad/s at the last frame of each context `[contexts, 2]`.
    pub(in crate::nn::flow) fn plain_forward(&self, contexts: &EncoderViews) -> Result<Tensor, NnError> {
        let half = contexts.spec.image_size().shrunk(2);
        let shape = (contexts.count(), half.height, half.width, ());
        let inputs = Tensor::from_vec(speed_inputs(contexts), shape, &Device::Cpu)?;
        let inputs = inputs.to_device(self.votes.weight.device())?.permute((0, 3, 1, 2))?;
        let mut features = convolution(&self.halving, &inputs.contiguous()?)?;
        for block in &self.blocks {
            features = (&features + convolution(block, &features.silu()?)?)?;
        }
        Ok(counted(
            &linear_per_place(&self.votes, &features.silu()?)?.flatten_from(2)?,
        )?)
    }
}
