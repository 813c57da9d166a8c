//! The one type that the rest of the program predicts with, whatever the architecture.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor, Var};

use super::conditioning::ConditioningTensors;
use super::dense::{DenseNetwork, Feedback};
use super::device;
use super::error::NnError;
use super::flow::{Asked, FlowNetwork, FlowPrediction, Occupancy};
use super::geometry::state_channels::StateChannels;
use super::geometry::wheel_dynamics;
use super::model_tensors::ModelTensors;
use super::parameters::{Parameters, of_shape};
use super::precision::Precision;
use super::spec::{Architecture, ModelSpec, in_range};
use super::sprites::{SpriteNetwork, SpritePrediction};
use super::tensors::with_values;

/// A network that predicts frames. It keeps each frame as a code of [`ModelSpec::code_len`] numbers: the dense network's
/// features, or for the other networks the frame itself. Holds weights only, so one model serves many.
#[derive(Clone, Debug)]
pub struct Network {
    spec: ModelSpec,
    network: AnyNetwork,
}

#[derive(Clone, Debug)]
enum AnyNetwork {
    Dense(Box<DenseNetwork>),
    Flow(Box<FlowNetwork>),
    Sprites(Box<SpriteNetwork>),
}

impl Network {
    /// A model that shares its storage with `parameters`: it sees every update, and gradients reach every tensor. On a graphics card it
    /// holds a copy, so it is to be built again after an update.
    /// Errors: `TensorMissing`, `TensorShape`, and those of [`ModelSpec::validate`].
    pub fn new(spec: ModelSpec, parameters: &Parameters) -> Result<Self, NnError> {
        Self::with_frozen(spec, parameters, &[])
    }

    /// As [`Network::new`], without any gradients: for prediction.
    pub fn detached(spec: ModelSpec, parameters: &Parameters) -> Result<Self, NnError> {
        Self::with_frozen(spec, parameters, &[""])
    }

    /// As [`Network::new`], without gradients for tensors whose name starts with one of the prefixes.
    pub fn with_frozen(spec: ModelSpec, parameters: &Parameters, frozen: &[&str]) -> Result<Self, NnError> {
        Self::build(spec, parameters, frozen, false)
    }

    /// As [`Network::with_frozen`], in plain tensor operations on the CPU too, to compare both.
    #[cfg(test)]
    pub(crate) fn plain(spec: ModelSpec, parameters: &Parameters, frozen: &[&str]) -> Result<Self, NnError> {
        Self::build(spec, parameters, frozen, true)
    }

    /// The network with its weights on the program's device; the parameters stay on the CPU, and their gradients come back to it.
    fn build(spec: ModelSpec, parameters: &Parameters, frozen: &[&str], always_plain: bool) -> Result<Self, NnError> {
        spec.validate()?;
        let device = match spec.architecture {
            Architecture::Dense(_) | Architecture::Flow(_) => device::current()?,
            Architecture::Sprites(_) => Device::Cpu,
        };
        let mut tensors = BTreeMap::new();
        for (name, shape) in spec.tensor_shapes() {
            let tensor = of_shape(&name, &shape, parameters.get(&name).map(Var::as_tensor))?;
            let is_frozen = frozen.iter().any(|prefix| name.starts_with(prefix));
            let tensor = if is_frozen { tensor.detach() } else { tensor.clone() };
            tensors.insert(name, tensor.to_device(&device)?);
        }
        let tensors = ModelTensors { tensors, always_plain };
        let network = match spec.architecture {
            Architecture::Dense(sizes) => AnyNetwork::Dense(Box::new(DenseNetwork::new(spec.clone(), sizes, &tensors))),
            Architecture::Flow(sizes) => AnyNetwork::Flow(Box::new(FlowNetwork::new(spec.clone(), sizes, &tensors))),
            Architecture::Sprites(sizes) => {
                AnyNetwork::Sprites(Box::new(SpriteNetwork::new(spec.clone(), sizes, &tensors)))
            }
        };
        Ok(Self { spec, network })
    }

    /// The same network with its weights packed as they are now, for faster predictions; it sees no update of the parameters.
    /// In single precision, predictions differ by less than 1e-5 of full scale, by less than 1e-4 where depth is estimated, at sharp edges. How
    /// far the other precisions differ, docs/experiments.md says. On the processor, what is predicted together has the bits of each alone.
    /// Errors: `Precision` if this processor does not multiply such numbers, `Tensor`.
    pub fn packed(mut self, precision: Precision) -> Result<Self, NnError> {
        precision.check_support()?;
        match &mut self.network {
            AnyNetwork::Flow(flow) => flow.pack(precision)?,
            AnyNetwork::Dense(dense) => dense.pack(precision)?,
            AnyNetwork::Sprites(sprites) => sprites.pack(precision)?,
        }
        Ok(self)
    }

    /// The same network with a description that may not fit it, to test failures.
    #[cfg(test)]
    pub(crate) fn with_spec(self, spec: ModelSpec) -> Self {
        Self { spec, ..self }
    }

    /// The model's dimensions and meaning.
    #[must_use]
    pub fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    /// Whether windows cost less together than each alone: a dense layer reads its weights once for all, and a graphics card computes all
    /// at once.
    pub(crate) fn gains_from_batches(&self) -> bool {
        match &self.network {
            AnyNetwork::Dense(_) => true,
            AnyNetwork::Flow(flow) => flow.is_plain,
            AnyNetwork::Sprites(_) => false,
        }
    }

    /// Codes `[N, code_len]` of frames `[N, P]` in the model's space. Errors: `Shape`.
    pub fn encode_frames(&self, frames: &Tensor) -> Result<Tensor, NnError> {
        self.check("frames", frames, &[None, Some(self.spec.pixels())])?;
        match &self.network {
            AnyNetwork::Dense(dense) => dense.encode_frames(frames),
            AnyNetwork::Flow(_) | AnyNetwork::Sprites(_) => Ok(frames.clone()),
        }
    }

    /// Frames `[N, P]` in the model's space, not clamped, of codes `[N, code_len]`. Errors: `Shape`.
    pub fn decode_frames(&self, codes: &Tensor) -> Result<Tensor, NnError> {
        self.check("features", codes, &[None, Some(self.spec.code_len())])?;
        match &self.network {
            AnyNetwork::Dense(dense) => dense.decode_frames(codes),
            AnyNetwork::Flow(_) | AnyNetwork::Sprites(_) => Ok(codes.clone()),
        }
    }

    /// Calls `read` with the values `[P]` of each frame of these whole codes, in order, as [`Network::decode_frames`] gives them.
    pub(crate) fn for_each_frame(&self, codes: &[f32], mut read: impl FnMut(&[f32])) -> Result<(), NnError> {
        let length = self.spec.code_len();
        match &self.network {
            AnyNetwork::Dense(dense) => dense.for_each_frame(codes, read),
            AnyNetwork::Flow(_) | AnyNetwork::Sprites(_) => {
                codes.chunks_exact(length).for_each(&mut read);
                Ok(())
            }
        }
    }

    /// Codes `[B, horizon, code_len]` of the frames that follow those with `codes` [B, context, `code_len`]. The feedback is
    /// the dense network's; the flow network reads no prediction of its own. Errors: `Shape`, `Missing`.
    pub fn predict(
        &self,
        codes: &Tensor,
        conditioning: &ConditioningTensors,
        feedback: Feedback,
    ) -> Result<Tensor, NnError> {
        let batch = self.check_windows(codes)?;
        if let Feedback::TeacherForcing(truth) = feedback {
            let shape = [Some(batch), Some(self.spec.horizon), Some(self.spec.code_len())];
            self.check("true features", truth, &shape)?;
            if let AnyNetwork::Dense(dense) = &self.network {
                return dense.predict_from_truth(codes, conditioning, truth);
            }
        }
        self.predict_rollouts(codes, &each_once(batch), conditioning)
    }

    /// Codes `[N, horizon, code_len]` of N rollouts of B windows with `codes` [B, context, `code_len`]: rollout n follows the
    /// window `windows[n]` under the conditioning's row n. Errors: `Shape`, `Missing`, `Tensor` if there is no such window.
    pub fn predict_rollouts(
        &self,
        codes: &Tensor,
        windows: &[u32],
        conditioning: &ConditioningTensors,
    ) -> Result<Tensor, NnError> {
        self.check_windows(codes)?;
        match &self.network {
            AnyNetwork::Dense(dense) => dense.predict_rollouts(codes, windows, conditioning),
            AnyNetwork::Flow(flow) => {
                let asked = Asked::frames(self.spec.horizon);
                Ok(flow.predict(codes, windows, conditioning, asked)?.frames)
            }
            AnyNetwork::Sprites(sprites) => sprites.predict_rollouts(codes, windows, self.spec.horizon),
        }
    }

    /// As [`Network::predict_rollouts`], `steps` frames instead of the horizon; the conditioning has as many actions. Up to the
    /// horizon the frames are those of [`Network::predict_rollouts`] with the last action held. Beyond it, which no training saw,
    /// the dense network goes on step by step; the other networks start again from the frames that they predicted.
    /// Errors: `Shape`, `Missing`, `Tensor` if there is no such window.
    pub fn predict_steps(
        &self,
        codes: &Tensor,
        windows: &[u32],
        conditioning: &ConditioningTensors,
        steps: usize,
    ) -> Result<Tensor, NnError> {
        if steps == self.spec.horizon {
            return self.predict_rollouts(codes, windows, conditioning);
        }
        self.check_windows(codes)?;
        match &self.network {
            AnyNetwork::Dense(dense) => dense.with_horizon(steps).predict_rollouts(codes, windows, conditioning),
            AnyNetwork::Flow(flow) => flow.predict_beyond_horizon(codes, windows, conditioning, steps),
            AnyNetwork::Sprites(sprites) => sprites.predict_rollouts(codes, windows, steps),
        }
    }

    /// All that the flow network gives for frames `[B, context, P]`, with the frames of the first `steps` (1 to the horizon) only;
    /// `None` of another architecture. Errors: `Shape`, `Missing`, `OutOfRange`.
    pub fn predict_flow(
        &self,
        frames: &Tensor,
        conditioning: &ConditioningTensors,
        steps: usize,
    ) -> Result<Option<FlowPrediction>, NnError> {
        let batch = self.check_windows(frames)?;
        in_range("steps", steps as f64, 1.0, self.spec.horizon as f64)?;
        match &self.network {
            AnyNetwork::Dense(_) | AnyNetwork::Sprites(_) => Ok(None),
            AnyNetwork::Flow(flow) => {
                let asked = Asked::all(steps);
                flow.predict(frames, &each_once(batch), conditioning, asked).map(Some)
            }
        }
    }

    /// All that the sprite network learns from, of frames `[B, context, P]`; `None` of another architecture. Errors: `Shape`.
    pub fn predict_sprites(&self, frames: &Tensor) -> Result<Option<SpritePrediction>, NnError> {
        self.check_windows(frames)?;
        match &self.network {
            AnyNetwork::Sprites(sprites) => sprites.predict(frames).map(Some),
            AnyNetwork::Dense(_) | AnyNetwork::Flow(_) => Ok(None),
        }
    }

    /// How the robot moves under each of several plans of `steps` actions: yaw, ahead and left since the last frame, after
    /// each action, in radians and metres; plan after plan. `actions` holds all plans' actions, in their units. By the wheels
    /// alone, so for any number of steps. `None` if no action is a speed. Errors: `Tensor`.
    pub fn commanded_motion(
        &self,
        state: &[f32],
        actions: &[f32],
        steps: usize,
    ) -> Result<Option<Vec<[f32; 3]>>, NnError> {
        let channels = StateChannels::of(&self.spec);
        let count = self.spec.actions.len();
        if !channels.commands_speeds() || steps == 0 {
            return Ok(None);
        }
        let plans = actions.chunks_exact(steps * count);
        let measured = channels.measured_in(state);
        let speeds = plans.map(|plan| channels.speeds(measured, plan, count)).collect();
        let learned = match &self.network {
            AnyNetwork::Dense(_) | AnyNetwork::Sprites(_) => None,
            AnyNetwork::Flow(flow) => flow.wheels(),
        };
        let wheels = match learned {
            Some(wheels) => wheels.to_device(&Device::Cpu)?,
            None => Tensor::zeros(2, DType::F32, &Device::Cpu)?,
        };
        let motions = wheel_dynamics::integral(&wheels, speeds, self.spec.frame_period_s)?;
        let motions = with_values(&motions, |values| {
            let parts = values.as_chunks::<3>().0;
            parts.to_vec()
        })?;
        Ok(Some(motions))
    }

    /// What stands around the robot at the last frame of each of B windows with `codes` [B, context, `code_len`], and where movers
    /// will be under its actions; `None` if the network estimates no depth. Errors: `Shape`, `Missing`.
    pub fn occupancy(
        &self,
        codes: &Tensor,
        conditioning: &ConditioningTensors,
    ) -> Result<Option<Vec<Occupancy>>, NnError> {
        self.check_windows(codes)?;
        match &self.network {
            AnyNetwork::Dense(_) | AnyNetwork::Sprites(_) => Ok(None),
            AnyNetwork::Flow(flow) => flow.occupancy(codes, conditioning),
        }
    }

    /// The codes [B, context, `code_len`] again, from what the dense network's encoder kept of them; `None` for the flow
    /// network, which does not reconstruct. Errors: `Shape`.
    pub fn reconstruct(&self, codes: &Tensor) -> Result<Option<Tensor>, NnError> {
        self.check_windows(codes)?;
        match &self.network {
            AnyNetwork::Dense(dense) => dense.reconstruct(codes).map(Some),
            AnyNetwork::Flow(_) | AnyNetwork::Sprites(_) => Ok(None),
        }
    }

    /// Frames `[B, horizon, P]` that follow `frames` [B, context, P], both in the model's space. Errors: `Shape`, `Missing`.
    pub fn predict_frames(&self, frames: &Tensor, conditioning: &ConditioningTensors) -> Result<Tensor, NnError> {
        let (context, pixels, code) = (self.spec.context, self.spec.pixels(), self.spec.code_len());
        let batch = self.check("frames", frames, &[None, Some(context), Some(pixels)])?;
        let codes = self.encode_frames(&frames.reshape((batch * context, pixels))?)?;
        let predicted = self.predict(
            &codes.reshape((batch, context, code))?,
            conditioning,
            Feedback::Prediction,
        )?;
        let frames = self.decode_frames(&predicted.flatten(0, 1)?)?;
        Ok(frames.reshape((batch, self.spec.horizon, pixels))?)
    }

    fn check_windows(&self, codes: &Tensor) -> Result<usize, NnError> {
        let shape = [None, Some(self.spec.context), Some(self.spec.code_len())];
        self.check("features", codes, &shape)
    }

    /// Checks a shape, `None` for any size but 0; gives the first side.
    fn check(&self, what: &'static str, tensor: &Tensor, shape: &[Option<usize>]) -> Result<usize, NnError> {
        let fits = |(&side, &wanted): (&usize, &Option<usize>)| wanted.map_or(side > 0, |wanted| side == wanted);
        if tensor.rank() == shape.len() && tensor.dims().iter().zip(shape).all(fits) {
            return Ok(tensor.dims()[0]);
        }
        let sides: Vec<String> = shape
            .iter()
            .map(|side| side.map_or("any".to_owned(), |side| side.to_string()))
            .collect();
        let spec = &self.spec;
        let expected = format!(
            "[{}] ({}×{} px frames, {} in, {} out, {} features)",
            sides.join(", "),
            spec.frame_width_px,
            spec.frame_height_px,
            spec.context,
            spec.horizon,
            spec.code_len()
        );
        Err(NnError::shape(what, tensor, expected))
    }
}

/// One rollout for each window.
fn each_once(windows: usize) -> Vec<u32> {
    (0..windows as u32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::warp::CameraModel;
    use crate::nn::gradient_check::{noise, values};
    use crate::nn::options::Conditioning;
    use crate::nn::spec::{ChannelScale, DenseSpec, FlowLayers, FlowSpec};
    use crate::types::Seed;

    fn channel(name: &str, unit: &str) -> ChannelScale {
        ChannelScale {
            name: name.to_owned(),
            unit: unit.to_owned(),
            mean: 0.0,
            std: 1.0,
        }
    }

    fn spec(architecture: Architecture) -> ModelSpec {
        ModelSpec {
            architecture,
            frame_width_px: 8,
            frame_height_px: 8,
            context: 3,
            horizon: 2,
            conditioning: Conditioning::StateAction,
            actions: vec![channel("linear", "m/s"), channel("angular", "rad/s")],
            states: ["x", "y", "heading_cos", "heading_sin"]
                .map(|name| channel(name, ""))
                .to_vec(),
            ..ModelSpec::default()
        }
    }

    fn rollouts(spec: &ModelSpec, steps: usize) -> Tensor {
        let model = Network::detached(spec.clone(), &Parameters::initialize(spec, Seed(3)).unwrap()).unwrap();
        let frames: Vec<f32> = (0..3 * 64).map(|at| ((at * 7) % 64) as f32 / 64.0).collect();
        let codes = model
            .encode_frames(&Tensor::from_vec(frames, (3, 64), &Device::Cpu).unwrap())
            .unwrap();
        let codes = codes.reshape((1, 3, spec.code_len())).unwrap();
        let actions: Vec<f32> = (0..2 * steps)
            .map(|at| if at < 4 { at as f32 * 0.1 } else { 0.3 })
            .collect();
        let conditioning = ConditioningTensors {
            actions: Some(Tensor::from_vec(actions, (1, steps, 2), &Device::Cpu).unwrap()),
            state: Some(Tensor::new(&[[1.0f32, 2.0, 0.8, 0.6]], &Device::Cpu).unwrap()),
            ..ConditioningTensors::none()
        };
        model.predict_steps(&codes, &[0], &conditioning, steps).unwrap()
    }

    #[test]
    fn a_longer_future_starts_with_the_trained_one() {
        let dense = DenseSpec {
            features: 6,
            hidden: 5,
            ..DenseSpec::default()
        };
        for architecture in [Architecture::Dense(dense), Architecture::Flow(FlowSpec::default())] {
            let spec = spec(architecture);
            let (trained, longer) = (rollouts(&spec, 2), rollouts(&spec, 7));
            assert_eq!(longer.dims(), [1, 7, spec.code_len()]);
            let values = |tensor: Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            for (longer, trained) in values(longer.narrow(1, 0, 2).unwrap()).iter().zip(values(trained)) {
                assert!((longer - trained).abs() < 1e-5);
            }
            assert!(values(longer).iter().all(|value| value.is_finite()));
        }
    }

    #[test]
    fn frames_alone_are_those_of_a_whole_prediction() {
        let depth = FlowSpec {
            camera: Some(CameraModel::USUAL),
            layers: FlowLayers {
                depth: true,
                movers: true,
                ..FlowLayers::default()
            },
        };
        for flow in [FlowSpec::default(), depth] {
            let spec = spec(Architecture::Flow(flow));
            let model = Network::detached(spec.clone(), &Parameters::initialize(&spec, Seed(3)).unwrap()).unwrap();
            let frames = noise(&[1, 3, 64], 1);
            let conditioning = ConditioningTensors {
                actions: Some(noise(&[1, 2, 2], 2)),
                state: Some(noise(&[1, 4], 3)),
                ..ConditioningTensors::none()
            };
            let whole = model.predict_flow(&frames, &conditioning, 2).unwrap().unwrap();
            assert!(whole.scene.is_some() || whole.movers.is_some());
            let alone = model.predict_rollouts(&frames, &[0], &conditioning).unwrap();
            assert_eq!(values(&alone), values(&whole.frames));
        }
    }
}
