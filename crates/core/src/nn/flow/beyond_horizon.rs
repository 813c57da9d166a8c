//! Rollouts of the flow network of any length: it predicts one horizon after another, each from the frames before it. What
//! lies beyond the first horizon follows predicted frames and an estimated state, which training never saw.

use candle_core::{Device, Tensor};

use super::network::FlowNetwork;
use super::predict::Asked;
use crate::nn::conditioning::{ConditioningTensors, ConditioningValues};
use crate::nn::error::NnError;
use crate::nn::geometry::state_channels::StateChannels;
use crate::nn::spec::ModelSpec;

impl FlowNetwork {
    /// As [`FlowNetwork::predict`], but any number of frames; the conditioning has as many actions. Gives the frames
    /// `[N, steps, P]`. Errors: `Shape`, `Missing`, `Tensor` if there is no such window.
    pub(in crate::nn) fn predict_beyond_horizon(
        &self,
        frames: &Tensor,
        windows: &[u32],
        conditioning: &ConditioningTensors,
        steps: usize,
    ) -> Result<Tensor, NnError> {
        let (spec, count) = (&self.spec, windows.len());
        let asked = ModelSpec {
            horizon: steps,
            ..spec.clone()
        };
        let ConditioningValues {
            actions,
            mut states,
            past_states,
        } = conditioning.values(&asked, count)?;
        // Beyond the first horizon, the camera counts as having moved as fast as at the last frame.
        let mut past_states = given(&past_states, &[count, spec.context - 1, spec.states.len()])?;
        let mut context = frames.index_select(&Tensor::new(windows, frames.device())?, 0)?;
        let each: Vec<u32> = (0..count as u32).collect();
        let (mut parts, mut done) = (Vec::new(), 0);
        while done < steps {
            let taken = spec.horizon.min(steps - done);
            let part = actions_from(&actions, count, steps, done, spec);
            let conditioning = ConditioningTensors {
                actions: given(&part, &[count, spec.horizon, spec.actions.len()])?,
                state: given(&states, &[count, spec.states.len()])?,
                past_states: past_states.take(),
                cameras: conditioning.cameras.clone(),
            };
            let predicted = self.predict(&context, &each, &conditioning, Asked::frames(spec.horizon))?;
            parts.push(predicted.frames.narrow(1, 0, taken)?);
            done += taken;
            if done < steps {
                let seen = Tensor::cat(&[&context, &predicted.frames.clamp(0f32, 1f32)?], 1)?;
                context = seen.narrow(1, spec.horizon, spec.context)?.contiguous()?;
                advance(spec, &mut states, &part, &predicted.motion)?;
            }
        }
        Ok(Tensor::cat(&parts, 1)?)
    }
}

/// The values as a tensor, if there are any.
fn given(values: &[f32], shape: &[usize]) -> Result<Option<Tensor>, NnError> {
    let tensor = || Tensor::from_slice(values, shape, &Device::Cpu);
    Ok((!values.is_empty()).then(tensor).transpose()?)
}

/// The actions `[N, horizon, A]` from step `first` on; after the last one, it is held.
fn actions_from(actions: &[f32], count: usize, steps: usize, first: usize, spec: &ModelSpec) -> Vec<f32> {
    let width = actions.len() / (count * steps);
    let place = |row: usize, step: usize| (row * steps + step.min(steps - 1)) * width;
    (0..count)
        .flat_map(|row| (first..first + spec.horizon).map(move |step| place(row, step)))
        .flat_map(|place| actions[place..place + width].iter().copied())
        .collect()
}

/// The states at the last predicted frame, as far as motion and actions tell.
fn advance(spec: &ModelSpec, states: &mut [f32], actions: &[f32], motion: &Tensor) -> Result<(), NnError> {
    if states.is_empty() || actions.is_empty() {
        return Ok(());
    }
    let channels = StateChannels::of(spec);
    let motion = motion.flatten_all()?.to_vec1::<f32>()?;
    let (states_each, actions_each) = (spec.states.len(), spec.actions.len());
    let rows = states
        .chunks_exact_mut(states_each)
        .zip(motion.chunks_exact(3 * spec.horizon));
    for ((state, motion), actions) in rows.zip(actions.chunks_exact(actions_each * spec.horizon)) {
        let last = &motion[3 * (spec.horizon - 1)..];
        let action = &actions[actions_each * (spec.horizon - 1)..];
        channels.advance(state, [last[0], last[1], last[2]], action);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::options::Conditioning;
    use crate::nn::spec::ChannelScale;

    fn channel(name: &str, unit: &str) -> ChannelScale {
        ChannelScale {
            name: name.to_owned(),
            unit: unit.to_owned(),
            mean: 0.0,
            std: 1.0,
        }
    }

    #[test]
    fn the_state_moves_on_with_the_camera() {
        let spec = ModelSpec {
            horizon: 2,
            conditioning: Conditioning::StateAction,
            actions: vec![channel("linear", "m/s"), channel("angular", "rad/s")],
            states: ["x", "y", "heading_cos", "heading_sin"]
                .map(|name| channel(name, ""))
                .to_vec(),
            ..ModelSpec::default()
        };
        let mut state = vec![1.0, 2.0, 0.0, 1.0];
        let motion = Tensor::new(
            &[[[0.0f32, 0.5, 0.0], [std::f32::consts::FRAC_PI_2, 1.0, 0.0]]],
            &Device::Cpu,
        )
        .unwrap();
        advance(&spec, &mut state, &[0.0; 4], &motion).unwrap();
        for (found, expected) in state.iter().zip([1.0, 3.0, -1.0, 0.0]) {
            assert!((found - expected).abs() < 1e-5, "{state:?}");
        }
    }
}
