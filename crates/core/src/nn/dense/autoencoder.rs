//! The dense network: encodes frames to features and decodes them, predicts the next frames, reconstructs the context.

use candle_core::{DType, Device, Tensor};

use super::layer_form::LayerForm;
use super::lstm_cell::{Decoder, DecoderInputs, LstmState, PeepholeCell};
use super::packed_rollouts::{PackedInputs, PackedLayers};
use crate::nn::conditioning::ConditioningTensors;
use crate::nn::error::NnError;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::linear::Linear;
use crate::nn::ops::scratch::with_buffers;
use crate::nn::options::{PredictorOutput, Reconstruction};
use crate::nn::precision::Precision;
use crate::nn::spec::{DenseSpec, ModelSpec};
use crate::nn::tensors::with_values;

/// How many frames are decoded together at most. This bounds the memory that many rollouts need.
const DECODED_FRAMES: usize = 1024;
/// With packed weights; frames of 64×64 px then stay in the cache until they are read.
const DECODED_FRAMES_IN_CACHE: usize = 32;

/// What the predictor gets as the previous frame in each step.
#[derive(Clone, Copy, Debug)]
pub enum Feedback<'a> {
    /// The features that it predicted itself, as in use (autoregressive).
    Prediction,
    /// The true features `[B, horizon, F]` of the frames to predict ("teacher forcing"). The last one is not used.
    TeacherForcing(&'a Tensor),
}

/// The network: a frame codec, an LSTM encoder and two LSTM decoders. It holds only weights and no stream state, so many
/// streams can share one model. Its callers check the shapes of frames and features.
#[derive(Clone, Debug)]
pub(in crate::nn) struct DenseNetwork {
    spec: ModelSpec,
    sizes: DenseSpec,
    frame_encoder: Linear,
    frame_decoder: Linear,
    encoder: PeepholeCell,
    predictor: PeepholeCell,
    predictor_output: Linear,
    reconstructor: PeepholeCell,
    reconstructor_output: Linear,
    layers: LayerForm,
}

impl DenseNetwork {
    /// The network of these tensors.
    pub(in crate::nn) fn new(spec: ModelSpec, sizes: DenseSpec, tensors: &ModelTensors) -> Self {
        let cell = |name: &str| {
            let tensor = |part: &str| tensors.tensor(&format!("{name}.{part}"));
            let peepholes = ["peephole_i", "peephole_f", "peephole_o"].map(tensor);
            PeepholeCell::new(tensor("w_x"), tensor("w_h"), tensor("bias"), peepholes)
        };
        Self {
            frame_encoder: Linear {
                has_tanh: true,
                packed: None,
                ..tensors.linear("frame_encoder")
            },
            frame_decoder: tensors.linear("frame_decoder"),
            encoder: cell("encoder"),
            predictor: cell("predictor"),
            predictor_output: tensors.linear("predictor.output"),
            reconstructor: cell("reconstructor"),
            reconstructor_output: tensors.linear("reconstructor.output"),
            layers: LayerForm::of(tensors),
            spec,
            sizes,
        }
    }

    /// Packs what a prediction needs in this precision; on another device, it stays as it is.
    pub(in crate::nn) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        if self.layers == LayerForm::Plain {
            return Ok(());
        }
        // The pictures of a standing camera differ little: with 8 bits here, `static` loses 0.03 of skill.
        self.frame_encoder.pack(precision.at_least_bf16())?;
        self.frame_decoder.pack(precision)?;
        self.predictor_output.pack(precision)?;
        self.encoder.pack(0, precision)?;
        self.predictor.pack(self.sizes.features, precision)
    }

    /// The same network for another number of steps.
    pub(in crate::nn) fn with_horizon(&self, horizon: usize) -> Self {
        let spec = ModelSpec {
            horizon,
            ..self.spec.clone()
        };
        Self { spec, ..self.clone() }
    }

    /// Encodes frames `[N, P]` in the model's value range to features `[N, F]`.
    pub(in crate::nn) fn encode_frames(&self, frames: &Tensor) -> Result<Tensor, NnError> {
        Self::finished(self.layers.linear(&self.frame_encoder, &self.moved(frames)?)?)
    }

    /// Decodes features `[N, F]` to frames `[N, P]` in the model's value range, not clamped.
    pub(in crate::nn) fn decode_frames(&self, features: &Tensor) -> Result<Tensor, NnError> {
        Self::finished(self.layers.linear(&self.frame_decoder, &self.moved(features)?)?)
    }

    /// Calls `read` with the values `[P]` of each frame, as [`DenseNetwork::decode_frames`] gives them.
    pub(in crate::nn) fn for_each_frame(&self, features: &[f32], mut read: impl FnMut(&[f32])) -> Result<(), NnError> {
        let (width, pixels) = (self.sizes.features, self.spec.pixels());
        let Some(packed) = &self.frame_decoder.packed else {
            for features in features.chunks(DECODED_FRAMES * width) {
                let shape = (features.len() / width, width);
                let frames = self.decode_frames(&Tensor::from_slice(features, shape, &Device::Cpu)?)?;
                with_values(&frames, |frames| frames.chunks_exact(pixels).for_each(&mut read))?;
            }
            return Ok(());
        };
        let most = DECODED_FRAMES_IN_CACHE.min(features.len() / width);
        with_buffers([most * pixels, 0, 0], |[frames, ..]| {
            for features in features.chunks(DECODED_FRAMES_IN_CACHE * width) {
                let frames = &mut frames[..features.len() / width * pixels];
                packed.multiply_rows(features, frames);
                frames.chunks_exact(pixels).for_each(&mut read);
            }
        });
        Ok(())
    }

    /// Predicts the features `[B, horizon, F]` of the frames that follow the context `features` `[B, context, F]`, from the
    /// true ones, `target` ("teacher forcing"). The predictor starts from the encoder's last state. Step k gets the features
    /// of frame k, the action that leads to frame k + 1, and the state; its output is added to the features unless the
    /// specification says `absolute`. Errors: `Shape`, `Missing`.
    pub(in crate::nn) fn predict_from_truth(
        &self,
        features: &Tensor,
        condition: &ConditioningTensors,
        target: &Tensor,
    ) -> Result<Tensor, NnError> {
        let (features, target) = (&self.moved(features)?, self.moved(target)?);
        let conditions = self.conditions(condition, features.dim(0)?)?;
        let (_, state) = self.encode(features)?;
        let last = features.get_on_dim(1, self.spec.context - 1)?.contiguous()?;
        let previous = Tensor::cat(&[&last.unsqueeze(1)?, &target.narrow(1, 0, self.spec.horizon - 1)?], 1)?;
        let inputs = match &conditions {
            Some(conditions) => Tensor::cat(&[&previous, conditions], 2)?,
            None => previous.clone(),
        };
        let (outputs, _) = self.layers.unroll(&self.predictor, &inputs, &state)?;
        let outputs = self.each_step(&self.predictor_output, &outputs)?;
        Self::finished(match self.sizes.predictor_output {
            PredictorOutput::Residual => (previous + outputs)?,
            PredictorOutput::Absolute => outputs,
        })
    }

    /// Predicts the features `[N, horizon, F]` of N rollouts from B windows with `features` `[B, context, F]`. Rollout n
    /// starts from window `windows[n]` and uses row n of `condition`. Each window is encoded once, also if it has many
    /// rollouts. Errors: `Shape`, `Missing`, `Tensor` if a window index is out of range.
    pub(in crate::nn) fn predict_rollouts(
        &self,
        features: &Tensor,
        windows: &[u32],
        condition: &ConditioningTensors,
    ) -> Result<Tensor, NnError> {
        let conditions = self.conditions(condition, windows.len())?;
        if let Some(layers) = self.packed_layers() {
            return self.packed_rollouts(&layers, features, windows, conditions.as_ref());
        }
        let features = &self.moved(features)?;
        let (_, LstmState { h, c }) = self.encode(features)?;
        let last = features.get_on_dim(1, self.spec.context - 1)?;
        let rows = Tensor::new(windows, features.device())?;
        let of_rollouts = |values: &Tensor| values.contiguous()?.index_select(&rows, 0);
        let decoder = Decoder {
            cell: &self.predictor,
            output: &self.predictor_output,
            residual: self.sizes.predictor_output == PredictorOutput::Residual,
        };
        let state = LstmState {
            h: of_rollouts(&h)?,
            c: of_rollouts(&c)?,
        };
        let first = of_rollouts(&last)?;
        let inputs = DecoderInputs {
            steps: self.spec.horizon,
            first: &first,
            conditions: conditions.as_ref(),
        };
        Self::finished(self.layers.decode(&decoder, inputs, &state)?)
    }

    /// The layers that predict, if they are packed.
    fn packed_layers(&self) -> Option<PackedLayers<'_>> {
        Some(PackedLayers {
            encoder: self.encoder.packed.as_deref()?,
            predictor: self.predictor.packed.as_deref()?,
            output: self.predictor_output.packed.as_deref()?,
            residual: self.sizes.predictor_output == PredictorOutput::Residual,
        })
    }

    fn packed_rollouts(
        &self,
        layers: &PackedLayers,
        features: &Tensor,
        windows: &[u32],
        conditions: Option<&Tensor>,
    ) -> Result<Tensor, NnError> {
        let (batch, context, width) = features.dims3()?;
        if let Some(window) = windows.iter().find(|&&window| window as usize >= batch) {
            return Err(candle_core::Error::Msg(format!("there is no window {window} of {batch}")).into());
        }
        let shape = (windows.len(), self.spec.horizon, width);
        if windows.is_empty() {
            return Ok(Tensor::zeros(shape, DType::F32, &Device::Cpu)?);
        }
        let mut out = vec![0.0; windows.len() * self.spec.horizon * width];
        let mut predict = |features: &[f32], conditions: &[f32]| {
            let inputs = PackedInputs {
                features,
                context,
                windows,
                conditions,
                steps: self.spec.horizon,
            };
            layers.predict(&inputs, &mut out);
        };
        with_values(features, |features| {
            if let Some(conditions) = conditions {
                return with_values(conditions, |conditions| predict(features, conditions));
            }
            predict(features, &[]);
            Ok(())
        })??;
        Ok(Tensor::from_vec(out, shape, &Device::Cpu)?)
    }

    /// Reconstructs the features `[B, context, F]` from the encoder's output. Approach 1 (sequence): the decoder starts from
    /// the encoder's last state; its first input is zero, then it gets its own output. Approach 2 (stepwise): after each
    /// frame, the decoder gets the encoder's output at that frame.
    pub(in crate::nn) fn reconstruct(&self, features: &Tensor) -> Result<Tensor, NnError> {
        let features = &self.moved(features)?;
        let (outputs, state) = self.encode(features)?;
        let reconstructed = match self.sizes.reconstruction {
            Reconstruction::Sequence => {
                let decoder = Decoder {
                    cell: &self.reconstructor,
                    output: &self.reconstructor_output,
                    residual: false,
                };
                let first = features.get_on_dim(1, 0)?.zeros_like()?.contiguous()?;
                let inputs = DecoderInputs {
                    steps: self.spec.context,
                    first: &first,
                    conditions: None,
                };
                self.layers.decode(&decoder, inputs, &state)?
            }
            Reconstruction::Stepwise => {
                let start = self.reconstructor.zero_state(features.dim(0)?)?;
                let (outputs, _) = self.layers.unroll(&self.reconstructor, &outputs, &start)?;
                self.each_step(&self.reconstructor_output, &outputs)?
            }
        };
        Self::finished(reconstructed)
    }

    /// A layer at each step of `[B, T, …]`.
    fn each_step(&self, layer: &Linear, x: &Tensor) -> Result<Tensor, NnError> {
        let (batch, steps, _) = x.dims3()?;
        let outputs = self.layers.linear(layer, &x.flatten(0, 1)?)?;
        Ok(outputs.reshape((batch, steps, ()))?)
    }

    /// The scaled actions and states of each step, on the network's device.
    fn conditions(&self, condition: &ConditioningTensors, batch: usize) -> Result<Option<Tensor>, NnError> {
        let inputs = condition.inputs(&self.spec, batch)?;
        inputs.map(|inputs| self.moved(&inputs)).transpose()
    }

    /// A tensor on the network's device.
    fn moved(&self, tensor: &Tensor) -> Result<Tensor, NnError> {
        Ok(tensor.to_device(self.frame_decoder.weight.device())?)
    }

    /// A result: without gradients, on the CPU.
    fn finished(tensor: Tensor) -> Result<Tensor, NnError> {
        if tensor.track_op() {
            return Ok(tensor);
        }
        Ok(tensor.to_device(&Device::Cpu)?)
    }

    /// The encoder's outputs `[B, context, H]` and its last state.
    fn encode(&self, features: &Tensor) -> Result<(Tensor, LstmState), NnError> {
        let start = self.encoder.zero_state(features.dim(0)?)?;
        self.layers.unroll(&self.encoder, features, &start)
    }
}
