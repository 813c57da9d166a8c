//! Futures of the flow network of any length: it predicts one horizon after another, each from the frames before it. What
//! lies beyond the first horizon follows predicted frames and an estimated state, which training never saw.

use candle_core::{Device, Tensor};

use super::conditioned::ConditioningTensors;
use super::flow::FlowModel;
use super::motion::StateChannels;
use super::{ModelSpec, NnError};

/// Frames `[N, steps, P]` of N futures: the windows' frames, the window of each future, and its conditioning with `steps`
/// actions. Errors: `Shape`, `Missing`, `Tensor` if there is no such window.
pub(super) fn predict(
    flow: &FlowModel,
    spec: &ModelSpec,
    (frames, windows, conditioning): (&Tensor, &[u32], &ConditioningTensors),
    steps: usize,
) -> Result<Tensor, NnError> {
    let count = windows.len();
    let asked = ModelSpec {
        horizon: steps,
        ..spec.clone()
    };
    let (actions, mut states) = conditioning.raw(&asked, count)?;
    let mut context = frames.index_select(&Tensor::new(windows, frames.device())?, 0)?;
    let each: Vec<u32> = (0..count as u32).collect();
    let (mut parts, mut done) = (Vec::new(), 0);
    while done < steps {
        let taken = spec.horizon.min(steps - done);
        let part = actions_from(&actions, (count, steps), done, spec);
        let conditioning = ConditioningTensors {
            actions: given(&part, &[count, spec.horizon, spec.actions.len()])?,
            state: given(&states, &[count, spec.states.len()])?,
        };
        let predicted = flow.predict(spec, &context, &each, &conditioning)?;
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

/// The values as a tensor, if there are any.
fn given(values: &[f32], shape: &[usize]) -> Result<Option<Tensor>, NnError> {
    let tensor = || Tensor::from_slice(values, shape, &Device::Cpu);
    Ok((!values.is_empty()).then(tensor).transpose()?)
}

/// The actions `[N, horizon, A]` from step `first` on; after the last one, it is held.
fn actions_from(actions: &[f32], (count, steps): (usize, usize), first: usize, spec: &ModelSpec) -> Vec<f32> {
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
    use crate::nn::{ChannelScale, Model, Parameters};
    use crate::types::Seed;

    fn channel(name: &str, unit: &str) -> ChannelScale {
        ChannelScale {
            name: name.to_owned(),
            unit: unit.to_owned(),
            mean: 0.0,
            std: 1.0,
        }
    }

    fn spec(architecture: crate::nn::Architecture) -> ModelSpec {
        ModelSpec {
            architecture,
            frame_width_px: 8,
            frame_height_px: 8,
            context: 3,
            horizon: 2,
            features: 6,
            hidden: 5,
            conditioning: crate::nn::Conditioning::StateAction,
            actions: vec![channel("linear", "m/s"), channel("angular", "rad/s")],
            states: ["x", "y", "heading_cos", "heading_sin"]
                .map(|name| channel(name, ""))
                .to_vec(),
            ..ModelSpec::default()
        }
    }

    fn futures(spec: &ModelSpec, steps: usize) -> Tensor {
        let model = Model::detached(spec.clone(), &Parameters::initialize(spec, Seed(3)).unwrap()).unwrap();
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
        };
        model.predict_steps(&codes, &[0], &conditioning, steps).unwrap()
    }

    #[test]
    fn a_longer_future_starts_with_the_trained_one() {
        for architecture in [crate::nn::Architecture::Dense, crate::nn::Architecture::Flow] {
            let spec = spec(architecture);
            let (trained, longer) = (futures(&spec, 2), futures(&spec, 7));
            assert_eq!(longer.dims(), [1, 7, spec.code_len()]);
            let values = |tensor: Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            for (longer, trained) in values(longer.narrow(1, 0, 2).unwrap()).iter().zip(values(trained)) {
                assert!((longer - trained).abs() < 1e-5);
            }
            assert!(values(longer).iter().all(|value| value.is_finite()));
        }
    }

    #[test]
    fn the_state_moves_on_with_the_camera() {
        let (spec, mut state) = (spec(crate::nn::Architecture::Flow), vec![1.0, 2.0, 0.0, 1.0]);
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
