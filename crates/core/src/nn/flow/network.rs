//! The layers of the flow network, and the parts of a prediction that both of its forms share.

use candle_core::{Device, Tensor};
use candle_nn::Module as _;

use super::encoder_views::EncoderViews;
use super::layers::mix_name;
use super::motion::MotionHead;
use super::rollout_rows::RolloutRows;
use super::scene::Scene;
use crate::nn::error::NnError;
use crate::nn::ops::convolution::{ConvShape, Convolution3};
use crate::nn::ops::linear::{Activation, Linear};
use crate::nn::ops::modulation::{modulated_silu, silu};
use crate::nn::ops::pixel_shuffle::pixel_shuffle;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::spec::{FlowSpec, ModelSpec};
use crate::nn::tensor_source::TensorSource;

/// What the network gives for a batch.
#[derive(Clone, Debug)]
pub struct FlowPrediction {
    /// The predicted frames `[N, steps, P]`, those of the whole horizon unless fewer were asked for.
    pub frames: Tensor,
    /// What the scene alone looks like `[N, horizon, P]`, without what moves in it.
    pub scene: Tensor,
    /// How the camera will have moved since the last frame: yaw, ahead, left `[N, horizon, 3]`, in radians and metres.
    pub motion: Tensor,
}

/// The network. Holds weights only.
#[derive(Clone, Debug)]
pub(in crate::nn) struct FlowNetwork {
    pub(super) sizes: FlowSpec,
    stem: Convolution3,
    halving: Convolution3,
    blocks: Vec<[Convolution3; 2]>,
    pub(super) scene: Scene,
    pub(super) motion: MotionHead,
    modulation: [Linear; 2],
    pub(super) mix: Linear,
    refine: Vec<[Convolution3; 2]>,
    enlarge: Linear,
    fine: Convolution3,
    head: Convolution3,
}

impl FlowNetwork {
    /// The network of these tensors. Errors: `TensorMissing`, `TensorShape`.
    pub(in crate::nn) fn new(spec: &ModelSpec, sizes: FlowSpec, tensors: &dyn TensorSource) -> Result<Self, NnError> {
        let layers = &sizes.layers;
        let linear = |name: &str| tensors.linear(name, Activation::None);
        let blocks = (0..layers.encoder_blocks).map(|index| {
            let convolution = |part, shape| tensors.convolution(&format!("flow.encoder.{index}.{part}"), shape);
            Ok([
                convolution("first", ConvShape::dilated(1 << (index % 3)))?,
                convolution("second", ConvShape::PLAIN)?,
            ])
        });
        let refine = (0..layers.decoder_blocks).map(|index| {
            let convolution = |part, shape| tensors.convolution(&format!("flow.decoder.{index}.{part}"), shape);
            Ok([
                convolution("first", ConvShape::PLAIN)?,
                convolution("second", ConvShape::PLAIN)?,
            ])
        });
        Ok(Self {
            sizes,
            stem: tensors.convolution("flow.stem", ConvShape::PLAIN)?,
            halving: tensors.convolution("flow.halving", ConvShape::HALVING)?,
            blocks: blocks.collect::<Result<_, NnError>>()?,
            scene: Scene::new(spec, sizes.camera, tensors)?,
            motion: MotionHead::new(spec, &sizes, tensors)?,
            modulation: [linear("flow.modulation.inputs")?, linear("flow.modulation.output")?],
            mix: linear(&format!("flow.{}", mix_name(layers)))?,
            refine: refine.collect::<Result<_, NnError>>()?,
            enlarge: linear("flow.enlarge")?,
            fine: tensors.convolution("flow.fine", ConvShape::PLAIN)?,
            head: tensors.convolution("flow.head", ConvShape::PLAIN)?,
        })
    }

    /// Whether gradients go to the weights.
    pub(super) fn is_trained(&self) -> bool {
        self.stem.is_trained()
    }

    /// The states `[M, H/4, W/4, C]` after the decoder's modulated blocks.
    pub(super) fn refined(&self, mut state: Tensor, modulation: &Tensor) -> Result<Tensor, NnError> {
        let channels = self.sizes.layers.channels;
        for (index, [first, second]) in self.refine.iter().enumerate() {
            let modulation = |part: usize| modulation.narrow(1, (2 * index + part) * 2 * channels, 2 * channels);
            let inner = first.forward(&modulated_silu(&state, &modulation(0)?)?)?;
            let inner = second.forward(&modulated_silu(&inner, &modulation(1)?)?)?;
            state = (state + inner)?;
        }
        Ok(state)
    }

    /// The head's values of each item `[M, H/2, W/2, 4 · HEAD_VALUES]` from its state, the pixels to move and the scene.
    pub(super) fn head(
        &self,
        state: &Tensor,
        moved: &Tensor,
        scene: &Tensor,
        quarter: ImageSize,
    ) -> Result<Tensor, NnError> {
        let enlarged = pixel_shuffle(&Self::per_place(&self.enlarge, &silu(state)?, quarter)?)?;
        let inputs = Tensor::cat(&[&enlarged, moved, scene], 3)?;
        Ok(self.head.forward(&silu(&self.fine.forward(&inputs)?)?)?)
    }

    /// Features of each context `[contexts, H/4, W/4, C]`.
    pub(super) fn encode(&self, spec: &ModelSpec, contexts: &EncoderViews) -> Result<Tensor, NnError> {
        let half = spec.image_size().shrunk(2);
        let seen = self.scene.content_now(spec, contexts)?;
        let inputs = contexts.inputs(spec, self.sizes.camera, &seen);
        let inputs = Tensor::from_vec(inputs, (contexts.count(), half.height, half.width, ()), &Device::Cpu)?;
        let mut coarse = self.halving.forward(&silu(&self.stem.forward(&inputs)?)?)?;
        for [first, second] in &self.blocks {
            let inner = second.forward(&silu(&first.forward(&silu(&coarse)?)?)?)?;
            coarse = (coarse + inner)?;
        }
        Ok(coarse)
    }

    /// Scales and shifts of each item's modulated layers `[M, …]`.
    pub(super) fn modulate(&self, spec: &ModelSpec, rows: &RolloutRows, motion: &Tensor) -> Result<Tensor, NnError> {
        let known = rows.step_inputs(spec)?;
        let motion = motion.flatten(0, 1)?;
        let inputs = if self.motion.is_moving() {
            Tensor::cat(&[&known, &motion], 1)?
        } else {
            known
        };
        let [inputs_layer, output_layer] = &self.modulation;
        Ok(output_layer.forward(&silu(&inputs_layer.forward(&inputs)?)?)?)
    }

    /// A linear layer at each place of `[M, h, w, …]`.
    pub(super) fn per_place(layer: &Linear, x: &Tensor, size: ImageSize) -> Result<Tensor, NnError> {
        let (items, _, _, channels) = x.dims4()?;
        let flat = layer.forward(&x.reshape((items * size.pixels(), channels))?)?;
        let outputs = flat.dim(1)?;
        Ok(flat.reshape((items, size.height, size.width, outputs))?)
    }
}
