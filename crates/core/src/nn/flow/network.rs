//! The layers of the flow network, and the parts of a prediction that both of its forms share.

use candle_core::{Device, Tensor};

use super::depth_head::DepthHead;
use super::layers::mix_name;
use super::memory::Memory;
use super::motion::MotionHead;
use super::mover_head::MoverHead;
use super::rollout_rows::RolloutRows;
use super::scene::Scene;
use super::speed_head::SpeedHead;
use crate::nn::error::NnError;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::activated_convolution::{Activation, activated_convolution};
use crate::nn::ops::convolution::Convolution3;
use crate::nn::ops::image_geometry::ConvShape;
use crate::nn::ops::joining::joined_to_shuffled;
use crate::nn::ops::linear::{Linear, per_place};
use crate::nn::ops::modulation::{perceptron, silu};
use crate::nn::precision::Precision;
use crate::nn::recycled::recycle;
use crate::nn::spec::{FlowSpec, ModelSpec};

/// What the network gives for a batch.
#[derive(Clone, Debug)]
pub struct FlowPrediction {
    /// The predicted frames `[N, steps, P]`, those of the whole horizon unless fewer were asked for.
    pub frames: Tensor,
    /// What the scene alone looks like, without what moves in it: `[N, horizon, P]` where gradients go to the weights and in the
    /// recurrent form, else, and in the depth form, `[N, steps, P]`; `None` where the model remembers none.
    pub scene: Option<Tensor>,
    /// How the camera will have moved since the last frame: yaw, ahead, left `[N, horizon, 3]`, in radians and metres.
    pub motion: Tensor,
    /// Where movers are in the last frame and will be in each predicted one, as logits `[N, 1 + steps, P]`; `None` where the model
    /// does not tell.
    pub movers: Option<Tensor>,
    /// How fast the camera drives and turns at the last frame, as seen in the frames: m/s and rad/s `[N, 2]`; `None` where the model
    /// does not see it, or nothing needed it.
    pub speeds: Option<Tensor>,
}

/// What the network knows of the surroundings.
#[derive(Clone, Debug)]
pub(super) enum Surroundings {
    /// What they look like, from training.
    Remembered(Scene),
    /// How far away they are, from the context.
    Seen(DepthHead),
}

/// The network. Holds weights only.
#[derive(Clone, Debug)]
pub(in crate::nn) struct FlowNetwork {
    /// Whether it computes in plain tensor operations: on another device than the CPU, and in tests.
    pub(in crate::nn) is_plain: bool,
    pub(super) spec: ModelSpec,
    pub(super) sizes: FlowSpec,
    pub(super) stem: Convolution3,
    pub(super) halving: Convolution3,
    pub(super) blocks: Vec<[Convolution3; 2]>,
    pub(super) surroundings: Surroundings,
    pub(super) motion: MotionHead,
    pub(super) movers: Option<MoverHead>,
    pub(super) speeds: Option<SpeedHead>,
    pub(super) memory: Option<Memory>,
    pub(super) modulation: [Linear; 2],
    pub(super) mix: Linear,
    pub(super) refine: Vec<[Convolution3; 2]>,
    pub(super) enlarge: Linear,
    pub(super) fine: Convolution3,
    pub(super) head: Convolution3,
}

impl FlowNetwork {
    /// The network of these tensors.
    pub(in crate::nn) fn new(spec: ModelSpec, sizes: FlowSpec, tensors: &ModelTensors) -> Self {
        let layers = &sizes.layers;
        let convolution = |name: &str, shape| tensors.convolution(&format!("flow.{name}"), shape);
        let block = |name: String, first| {
            [
                convolution(&format!("{name}.first"), first),
                convolution(&format!("{name}.second"), ConvShape::PLAIN),
            ]
        };
        Self {
            sizes,
            stem: convolution("stem", ConvShape::PLAIN),
            halving: convolution("halving", ConvShape::HALVING),
            blocks: (0..layers.encoder_blocks)
                .map(|index| block(format!("encoder.{index}"), ConvShape::dilated(1 << (index % 3))))
                .collect(),
            surroundings: if layers.depth {
                Surroundings::Seen(DepthHead::new(tensors))
            } else {
                Surroundings::Remembered(Scene::new(&spec, sizes.camera, tensors))
            },
            motion: MotionHead::new(&spec, &sizes, tensors),
            movers: layers.movers.then(|| MoverHead::new(tensors)),
            speeds: layers.speeds.then(|| SpeedHead::new(tensors)),
            memory: Memory::of(&spec, tensors),
            modulation: ["inputs", "output"].map(|part| tensors.linear(&format!("flow.modulation.{part}"))),
            mix: tensors.linear(&format!("flow.{}", mix_name(layers))),
            refine: (0..layers.decoder_blocks)
                .map(|index| block(format!("decoder.{index}"), ConvShape::PLAIN))
                .collect(),
            enlarge: tensors.linear("flow.enlarge"),
            fine: convolution("fine", ConvShape::PLAIN),
            head: convolution("head", ConvShape::PLAIN),
            is_plain: tensors.are_plain(),
            spec,
        }
    }

    /// What was learned of the wheels; `None` where no speeds are commanded.
    pub(in crate::nn) fn wheels(&self) -> Option<&Tensor> {
        self.motion.wheels()
    }

    /// Packs the weights of all layers as they are now, for fast prediction; plain tensor operations take them as they are.
    pub(in crate::nn) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        if self.is_plain {
            return Ok(());
        }
        let convolutions = [&mut self.stem, &mut self.halving, &mut self.fine, &mut self.head].into_iter();
        let blocks = self.blocks.iter_mut().chain(&mut self.refine).flatten();
        for convolution in convolutions.chain(blocks) {
            convolution.pack(precision)?;
        }
        for linear in &mut self.modulation {
            linear.pack(precision.at_least_bf16())?;
        }
        for linear in [&mut self.mix, &mut self.enlarge] {
            linear.pack(precision.of_convolutions())?;
        }
        self.motion.pack(precision)?;
        if let Some(movers) = &mut self.movers {
            movers.pack(precision)?;
        }
        if let Some(speeds) = &mut self.speeds {
            speeds.pack(precision)?;
        }
        if let Some(memory) = &mut self.memory {
            memory.pack(precision)?;
        }
        match &mut self.surroundings {
            Surroundings::Remembered(scene) => scene.pack(precision),
            Surroundings::Seen(depth) => depth.pack(precision),
        }
    }

    /// Whether gradients go to the weights.
    pub(super) fn is_trained(&self) -> bool {
        self.stem.weight.track_op()
    }

    /// The rollouts, with how fast their cameras drive as the frames show it, where the network sees that and it is of use.
    pub(super) fn see_speeds<'a>(&self, rows: &RolloutRows<'a>) -> Result<RolloutRows<'a>, NnError> {
        let Some(head) = self
            .speeds
            .as_ref()
            .filter(|_| self.is_trained() || !rows.all_know_speeds())
        else {
            return Ok(rows.part(0..rows.count()));
        };
        let contexts = rows.contexts(self.sizes.layers.frames_read);
        rows.with_seen_speeds(&if self.is_plain {
            head.plain_forward(&contexts)?
        } else {
            head.forward(&contexts)?
        })
    }

    /// The states `[M, H/4, W/4, C]` after the decoder's modulated blocks.
    pub(super) fn refined(&self, mut state: Tensor, modulation: &Tensor) -> Result<Tensor, NnError> {
        let channels = self.sizes.layers.channels;
        for (index, [first, second]) in self.refine.iter().enumerate() {
            let modulation = |part: usize| modulation.narrow(1, (2 * index + part) * 2 * channels, 2 * channels);
            let inner = activated_convolution(first, &state, Activation::Modulated(&modulation(0)?), None)?;
            let refined = activated_convolution(second, &inner, Activation::Modulated(&modulation(1)?), Some(&state))?;
            self.recycle([&inner, &state])?;
            state = refined;
        }
        Ok(state)
    }

    /// The fine layer's values of each item `[M, H/2, W/2, …]` from its state, the pixels to move and what is known beside them, plus
    /// `added`.
    pub(super) fn fine(
        &self,
        state: &Tensor,
        [moved, beside]: [&Tensor; 2],
        added: Option<&Tensor>,
    ) -> Result<Tensor, NnError> {
        let activated = silu(state)?;
        let enlarged = per_place(&self.enlarge, &activated)?;
        let inputs = joined_to_shuffled([&enlarged, moved, beside])?;
        let fine = activated_convolution(&self.fine, &inputs, Activation::None, added)?;
        self.recycle([&activated, &enlarged, &inputs])?;
        Ok(fine)
    }

    /// The head's values `[M, H/2, W/2, 4 · HEAD_VALUES]` from those of the fine layer.
    pub(super) fn head(&self, fine: &Tensor) -> Result<Tensor, NnError> {
        Ok(activated_convolution(&self.head, fine, Activation::Silu, None)?)
    }

    /// Features of each context `[contexts, H/4, W/4, C]` and those of the first layer `[contexts, H/2, W/2, …]`, from the
    /// encoder's inputs `[contexts, H/2 · W/2 · …]`. The first layer adds `added`.
    pub(super) fn encode(
        &self,
        contexts: usize,
        inputs: Vec<f32>,
        added: Option<&Tensor>,
    ) -> Result<[Tensor; 2], NnError> {
        let half = self.spec.image_size().shrunk(2);
        let inputs = Tensor::from_vec(inputs, (contexts, half.height, half.width, ()), &Device::Cpu)?;
        let first = silu(&activated_convolution(&self.stem, &inputs, Activation::None, added)?)?;
        let mut coarse = activated_convolution(&self.halving, &first, Activation::None, None)?;
        for [first, second] in &self.blocks {
            let inner = activated_convolution(first, &coarse, Activation::Silu, None)?;
            let next = activated_convolution(second, &inner, Activation::Silu, Some(&coarse))?;
            self.recycle([&inner, &coarse])?;
            coarse = next;
        }
        Ok([coarse, first])
    }

    /// Keeps the buffers of tensors that nobody reads any more for the next ones. Gradients would need what they hold, so only in
    /// predictions.
    pub(super) fn recycle<const COUNT: usize>(&self, tensors: [&Tensor; COUNT]) -> Result<(), NnError> {
        if self.stem.packed.is_some() && !self.is_trained() {
            for tensor in tensors {
                recycle(tensor)?;
            }
        }
        Ok(())
    }

    /// Scales and shifts of each item's modulated layers `[M, …]`.
    pub(super) fn modulate(&self, rows: &RolloutRows, motion: &Tensor) -> Result<Tensor, NnError> {
        let mut inputs = rows.step_inputs()?;
        if self.motion.is_moving() {
            inputs = Tensor::cat(&[&inputs, &motion.flatten(0, 1)?], 1)?;
        }
        Ok(perceptron(&self.modulation, &inputs)?)
    }
}
