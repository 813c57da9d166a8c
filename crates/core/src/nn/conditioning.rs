//! Conditioning inputs: the state and the future actions of a prediction (paper, "Proposed Action and State Conditioned
//! LSTM Autoencoder Model"), scaled to the network's range.

use candle_core::{Device, Tensor};

use super::error::NnError;
use super::spec::{ChannelScale, MIN_CHANNEL_STD, ModelSpec};
use super::tensors::with_values;
use crate::frame::warp::CameraModel;

/// Conditioning inputs as plain values in the channels' units, empty where the conditioning does not include them.
pub(super) struct ConditioningValues {
    /// `[B, horizon, A]`.
    pub(super) actions: Vec<f32>,
    /// `[B, S]`.
    pub(super) states: Vec<f32>,
    /// `[B, context - 1, S]`; empty too where they are not known.
    pub(super) past_states: Vec<f32>,
}

/// The conditioning inputs of a batch, in the units of the channels. An input that the model does not use is ignored; an
/// input that the model needs but that is missing is an error, unless the model sees how fast the camera drives
/// ([`ModelSpec::sees_speeds`]): then it may be missing, and components that are not known are NaN.
#[derive(Clone, Debug, Default)]
pub struct ConditioningTensors {
    /// Future actions `[B, horizon, A]`; action k leads to predicted frame k.
    pub actions: Option<Tensor>,
    /// State at the last context frame `[B, S]`.
    pub state: Option<Tensor>,
    /// States at the context's earlier frames `[B, context - 1, S]`, for networks that estimate depth. Without them, or where
    /// they are NaN, the camera counts as having moved as fast as at the last frame.
    pub past_states: Option<Tensor>,
    /// The camera of each window, B of them, for networks that estimate depth. Without them, the model's.
    pub cameras: Vec<CameraModel>,
}

impl ConditioningTensors {
    /// No actions and no state.
    #[must_use]
    pub fn none() -> Self {
        Self::default()
    }

    /// The scaled inputs that the predictor gets after the features in each step, `[B, horizon, A + S]`; `None` if the
    /// conditioning is none. Errors: `Missing`, `Shape`.
    pub(super) fn inputs(&self, spec: &ModelSpec, batch: usize) -> Result<Option<Tensor>, NnError> {
        let [actions, state] = self.used(spec, batch)?;
        let mut inputs = Vec::new();
        if let Some(actions) = actions {
            inputs.push(scaled(actions, &spec.actions)?);
        }
        if let Some(state) = state {
            let state = scaled(state, &spec.states)?.unsqueeze(1)?;
            let shape = (batch, spec.horizon, spec.states.len());
            inputs.push(state.expand(shape)?.contiguous()?);
        }
        Ok((!inputs.is_empty()).then(|| Tensor::cat(&inputs, 2)).transpose()?)
    }

    /// The inputs as plain values. Values far outside the training's are limited, so that no prediction is NaN. Errors:
    /// `Missing`, `Shape`.
    pub(super) fn values(&self, spec: &ModelSpec, batch: usize) -> Result<ConditioningValues, NnError> {
        let given = Self {
            actions: self.actions.clone().or_else(|| spec.unknown_actions(batch)),
            state: self.state.clone().or_else(|| spec.unknown_state(batch)),
            ..Self::none()
        };
        let [actions, states] = given.used(spec, batch)?;
        let limited = |tensor: Option<&Tensor>, channels: &[ChannelScale]| -> Result<Vec<f32>, NnError> {
            let Some(tensor) = tensor else { return Ok(Vec::new()) };
            let values = tensor.flatten_all()?.to_vec1::<f32>()?.into_iter();
            let channels = channels.iter().cycle();
            Ok(values
                .zip(channels)
                .map(|(value, channel)| channel.limited(value))
                .collect())
        };
        let past_states = match (&self.past_states, spec.state_inputs()) {
            (Some(past), Some(count)) => {
                let shape = [batch, spec.context - 1, count];
                with_values(checked(spec, "past states", Some(past), &shape)?, <[f32]>::to_vec)?
            }
            _ => Vec::new(),
        };
        Ok(ConditioningValues {
            actions: limited(actions, &spec.actions)?,
            states: limited(states, &spec.states)?,
            past_states,
        })
    }

    /// The actions and the state, where the model takes them. Errors: `Missing`, `Shape`.
    fn used(&self, spec: &ModelSpec, batch: usize) -> Result<[Option<&Tensor>; 2], NnError> {
        let actions = spec.action_inputs().map(|count| {
            let shape = [batch, spec.horizon, count];
            checked(spec, "actions", self.actions.as_ref(), &shape)
        });
        let state = spec
            .state_inputs()
            .map(|count| checked(spec, "state", self.state.as_ref(), &[batch, count]));
        Ok([actions.transpose()?, state.transpose()?])
    }
}

impl ModelSpec {
    /// Actions of which nothing is known, where the model can do without.
    fn unknown_actions(&self, batch: usize) -> Option<Tensor> {
        let count = self.action_inputs().filter(|_| self.sees_speeds())?;
        Tensor::full(f32::NAN, (batch, self.horizon, count), &Device::Cpu).ok()
    }

    /// States of which nothing is known, where the model can do without.
    fn unknown_state(&self, batch: usize) -> Option<Tensor> {
        let count = self.state_inputs().filter(|_| self.sees_speeds())?;
        Tensor::full(f32::NAN, (batch, count), &Device::Cpu).ok()
    }
}

/// The tensor, if it is given and has the expected shape. Errors: `Missing`, `Shape`.
fn checked<'a>(
    spec: &ModelSpec,
    what: &'static str,
    given: Option<&'a Tensor>,
    shape: &[usize],
) -> Result<&'a Tensor, NnError> {
    let expected = || match (what, shape) {
        ("actions", &[batch, horizon, count]) => {
            format!(
                "[{batch}, {horizon}, {count}]: windows, predicted frames, components {}",
                names(&spec.actions)
            )
        }
        (_, &[batch, frames, count]) => {
            format!(
                "[{batch}, {frames}, {count}]: windows, earlier frames, components {}",
                names(&spec.states)
            )
        }
        _ => format!("{shape:?}: windows, components {}", names(&spec.states)),
    };
    match given {
        None => Err(NnError::Missing {
            what,
            conditioning: spec.conditioning,
            expected: expected(),
        }),
        Some(tensor) if tensor.dims() != shape => Err(NnError::shape(what, tensor, expected())),
        Some(tensor) => Ok(tensor),
    }
}

fn names(channels: &[ChannelScale]) -> String {
    let names: Vec<&str> = channels.iter().map(|channel| channel.name.as_str()).collect();
    format!("({})", names.join(", "))
}

/// (values − mean) / std along the last dimension.
fn scaled(values: &Tensor, channels: &[ChannelScale]) -> Result<Tensor, NnError> {
    let mean: Vec<f32> = channels.iter().map(|channel| channel.mean).collect();
    let std: Vec<f32> = channels
        .iter()
        .map(|channel| channel.std.max(MIN_CHANNEL_STD))
        .collect();
    let (mean, std) = (Tensor::new(mean, &Device::Cpu)?, Tensor::new(std, &Device::Cpu)?);
    Ok(values.broadcast_sub(&mean)?.broadcast_div(&std)?)
}
