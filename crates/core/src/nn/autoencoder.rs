//! The dense network: encodes frames to features and decodes them, predicts the next frames, reconstructs the context.

use candle_core::Tensor;

use super::conditioned::ConditioningTensors;
use super::dense::{Activation, Dense};
use super::lstm::{Decoder, unroll};
use super::lstm_cell::{LstmState, PeepholeCell};
use super::{ModelSpec, NnError, Parameters, PredictorOutput, Reconstruction};

/// What the predictor gets as the previous frame in each step.
#[derive(Clone, Copy, Debug)]
pub enum Feedback<'a> {
    /// The features that it predicted itself, as in use (autoregressive).
    Prediction,
    /// The true features `[B, horizon, F]` of the frames to predict ("teacher forcing"). The last one is not used.
    TeacherForcing(&'a Tensor),
}

/// The network: a frame codec, an LSTM encoder and two LSTM decoders. It holds only weights and no stream state, so many
/// streams can share one model.
#[derive(Clone, Debug)]
pub(super) struct DenseModel {
    spec: ModelSpec,
    frame_encoder: Dense,
    frame_decoder: Dense,
    encoder: PeepholeCell,
    predictor: PeepholeCell,
    predictor_output: Dense,
    reconstructor: PeepholeCell,
    reconstructor_output: Dense,
}

impl DenseModel {
    /// A network that shares its storage with `parameters`, without gradients for tensors whose name starts with one of the
    /// `frozen` prefixes. Errors: `TensorMissing`, `TensorShape`, and those of [`ModelSpec::validate`].
    pub(super) fn with_frozen(spec: ModelSpec, parameters: &Parameters, frozen: &[&str]) -> Result<Self, NnError> {
        spec.validate()?;
        let shapes = spec.tensor_shapes();
        let tensor = |name: String| {
            #[expect(clippy::expect_used, reason = "the specification names every tensor of the model")]
            let expected = shapes
                .get(&name)
                .cloned()
                .expect("a model tensor that tensor_shapes() does not list is a bug");
            match parameters.get(&name) {
                None => Err(NnError::TensorMissing { name, expected }),
                Some(var) if var.dims() != expected => {
                    let found = var.dims().to_vec();
                    Err(NnError::TensorShape { name, found, expected })
                }
                Some(var) if frozen.iter().any(|prefix| name.starts_with(prefix)) => Ok(var.as_detached_tensor()),
                Some(var) => Ok(var.as_tensor().clone()),
            }
        };
        let dense = |name: &str, activation| {
            let (weight, bias) = (tensor(format!("{name}.weight"))?, tensor(format!("{name}.bias"))?);
            Ok::<_, NnError>(Dense::new(weight, bias, activation))
        };
        let cell = |name: &str| {
            let peephole = |gate: &str| tensor(format!("{name}.peephole_{gate}"));
            Ok::<_, NnError>(PeepholeCell::new(
                tensor(format!("{name}.w_x"))?,
                tensor(format!("{name}.w_h"))?,
                tensor(format!("{name}.bias"))?,
                [peephole("i")?, peephole("f")?, peephole("o")?],
            ))
        };
        Ok(Self {
            frame_encoder: dense("frame_encoder", Activation::Tanh)?,
            frame_decoder: dense("frame_decoder", Activation::Linear)?,
            encoder: cell("encoder")?,
            predictor: cell("predictor")?,
            predictor_output: dense("predictor.output", Activation::Linear)?,
            reconstructor: cell("reconstructor")?,
            reconstructor_output: dense("reconstructor.output", Activation::Linear)?,
            spec,
        })
    }

    /// The same network for another number of steps.
    pub(super) fn with_horizon(&self, horizon: usize) -> Self {
        let spec = ModelSpec {
            horizon,
            ..self.spec.clone()
        };
        Self { spec, ..self.clone() }
    }

    /// Encodes frames `[N, P]` in the model's value range to features `[N, F]`. Errors: `Shape`.
    pub(super) fn encode_frames(&self, frames: &Tensor) -> Result<Tensor, NnError> {
        self.check("frames", frames, &[None, Some(self.spec.pixels())])?;
        self.frame_encoder.forward(frames)
    }

    /// Decodes features `[N, F]` to frames `[N, P]` in the model's value range, not clamped. Errors: `Shape`.
    pub(super) fn decode_frames(&self, features: &Tensor) -> Result<Tensor, NnError> {
        self.check("features", features, &[None, Some(self.spec.features)])?;
        self.frame_decoder.forward(features)
    }

    /// Predicts the features `[B, horizon, F]` of the frames that follow the context `features` `[B, context, F]`. The
    /// predictor starts from the encoder's last state. Step k gets the features of frame k, the action that leads to frame
    /// k + 1, and the state; its output is added to the features unless the specification says `absolute`. Errors: `Shape`, `Missing`.
    pub(super) fn predict(
        &self,
        features: &Tensor,
        condition: &ConditioningTensors,
        feedback: Feedback,
    ) -> Result<Tensor, NnError> {
        let batch = self.check_windows(features)?;
        let target = match feedback {
            Feedback::TeacherForcing(target) => target,
            Feedback::Prediction => return self.run_predictor(features, None, condition),
        };
        self.check(
            "true features",
            target,
            &[Some(batch), Some(self.spec.horizon), Some(self.spec.features)],
        )?;
        let conditions = condition.inputs(&self.spec, batch)?;
        let (_, state) = self.encode(features)?;
        let last = features.get_on_dim(1, self.spec.context - 1)?.contiguous()?;
        let previous = Tensor::cat(&[&last.unsqueeze(1)?, &target.narrow(1, 0, self.spec.horizon - 1)?], 1)?;
        let inputs = match &conditions {
            Some(conditions) => Tensor::cat(&[&previous, conditions], 2)?,
            None => previous.clone(),
        };
        let (outputs, _) = unroll(&self.predictor, &inputs, &state)?;
        let changes = self.predictor_output.forward(&outputs.flatten(0, 1)?)?;
        let outputs = changes.reshape(target.dims())?;
        Ok(match self.spec.predictor_output {
            PredictorOutput::Residual => (previous + outputs)?,
            PredictorOutput::Absolute => outputs,
        })
    }

    /// Predicts the features `[N, horizon, F]` of N rollouts from B windows with `features` `[B, context, F]`. Rollout n
    /// starts from window `windows[n]` and uses row n of `condition`. Each window is encoded once, also if it has many
    /// rollouts. Errors: `Shape`, `Missing`, `Tensor` if a window index is out of range.
    pub(super) fn predict_futures(
        &self,
        features: &Tensor,
        windows: &[u32],
        condition: &ConditioningTensors,
    ) -> Result<Tensor, NnError> {
        self.check_windows(features)?;
        self.run_predictor(features, Some(windows), condition)
    }

    fn run_predictor(
        &self,
        features: &Tensor,
        windows: Option<&[u32]>,
        condition: &ConditioningTensors,
    ) -> Result<Tensor, NnError> {
        let (_, mut state) = self.encode(features)?;
        let mut last = features.get_on_dim(1, self.spec.context - 1)?.contiguous()?;
        if let Some(windows) = windows {
            let rows = Tensor::new(windows, features.device())?;
            last = last.index_select(&rows, 0)?;
            state = LstmState {
                h: state.h.contiguous()?.index_select(&rows, 0)?,
                c: state.c.contiguous()?.index_select(&rows, 0)?,
            };
        }
        let conditions = condition.inputs(&self.spec, last.dim(0)?)?;
        let decoder = Decoder {
            cell: &self.predictor,
            output: &self.predictor_output,
            residual: self.spec.predictor_output == PredictorOutput::Residual,
        };
        decoder.run(self.spec.horizon, &last, conditions.as_ref(), &state)
    }

    /// Reconstructs the features `[B, context, F]` from the encoder's output. Approach 1 (sequence): the decoder starts from
    /// the encoder's last state; its first input is zero, then it gets its own output. Approach 2 (stepwise): after each
    /// frame, the decoder gets the encoder's output at that frame. Errors: `Shape`.
    pub(super) fn reconstruct(&self, features: &Tensor) -> Result<Tensor, NnError> {
        let batch = self.check_windows(features)?;
        let (outputs, state) = self.encode(features)?;
        match self.spec.reconstruction {
            Reconstruction::Sequence => {
                let decoder = Decoder {
                    cell: &self.reconstructor,
                    output: &self.reconstructor_output,
                    residual: false,
                };
                let first = features.get_on_dim(1, 0)?.zeros_like()?.contiguous()?;
                decoder.run(self.spec.context, &first, None, &state)
            }
            Reconstruction::Stepwise => {
                let (outputs, _) = unroll(&self.reconstructor, &outputs, &self.reconstructor.zero_state(batch)?)?;
                let flat = self.reconstructor_output.forward(&outputs.flatten(0, 1)?)?;
                Ok(flat.reshape(features.dims())?)
            }
        }
    }

    /// The encoder's outputs `[B, context, H]` and its last state.
    fn encode(&self, features: &Tensor) -> Result<(Tensor, LstmState), NnError> {
        unroll(&self.encoder, features, &self.encoder.zero_state(features.dim(0)?)?)
    }

    fn check_windows(&self, features: &Tensor) -> Result<usize, NnError> {
        self.check(
            "features",
            features,
            &[None, Some(self.spec.context), Some(self.spec.features)],
        )
    }

    /// Checks the shape of a tensor; `None` stands for any size except 0. Returns the first dimension.
    fn check(&self, what: &'static str, tensor: &Tensor, shape: &[Option<usize>]) -> Result<usize, NnError> {
        let fits = |(&size, &wanted): (&usize, &Option<usize>)| wanted.map_or(size > 0, |wanted| size == wanted);
        if tensor.rank() == shape.len() && tensor.dims().iter().zip(shape).all(fits) {
            return Ok(tensor.dims()[0]);
        }
        let sizes: Vec<String> = shape
            .iter()
            .map(|size| size.map_or("any".to_owned(), |size| size.to_string()))
            .collect();
        let spec = &self.spec;
        let expected = format!(
            "[{}] ({}×{} px frames, {} in, {} out, {} features)",
            sizes.join(", "),
            spec.frame_width_px,
            spec.frame_height_px,
            spec.context,
            spec.horizon,
            spec.features
        );
        Err(NnError::shape(what, tensor, expected))
    }
}
