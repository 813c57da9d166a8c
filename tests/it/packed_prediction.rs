//! The shipped flow networks with packed weights, as the server predicts, beside the same networks on plain tensors.

use std::path::Path;

use candle_core::{Device, Tensor};
use foreframe_core::nn::{ChannelScale, ConditioningTensors, ModelSpec, Network};
use foreframe_core::registry;

use crate::nn_fixtures::{largest_difference, values};

fn packed(name: &str) -> Network {
    registry::load(&Path::new("models").join(name)).unwrap().network
}

fn on_tensors(name: &str) -> Network {
    let weights = registry::load_weights(&Path::new("models").join(name)).unwrap();
    Network::detached(weights.manifest.spec, &weights.parameters).unwrap()
}

/// Noise of the contrast that frames of a camera have.
fn frames(spec: &ModelSpec, windows: usize) -> Tensor {
    let noise = values(&[windows, spec.context, spec.pixels()], 0.5);
    noise.affine(0.3, 0.5).unwrap()
}

/// Usual values of the channels in each of `rows`.
fn usual(channels: &[ChannelScale], rows: usize, phase: f32) -> Vec<f32> {
    let noise = values(&[rows * channels.len()], phase).to_vec1::<f32>().unwrap();
    let channels = channels.iter().cycle();
    noise
        .iter()
        .zip(channels)
        .map(|(noise, channel)| channel.mean + channel.std * noise)
        .collect()
}

/// Plans, each with the same state.
fn plans(spec: &ModelSpec, count: usize) -> ConditioningTensors {
    let of = |values: Vec<f32>, shape: &[usize]| Tensor::from_vec(values, shape, &Device::Cpu).ok();
    let actions = usual(&spec.actions, count * spec.horizon, 1.0);
    ConditioningTensors {
        actions: of(actions, &[count, spec.horizon, spec.actions.len()]),
        state: of(usual(&spec.states, 1, 2.0).repeat(count), &[count, spec.states.len()]),
        ..ConditioningTensors::none()
    }
}

#[test]
fn packed_weights_predict_what_the_tensors_predict() {
    for name in ["moving-flow", "rooms", "home", "static-flow"] {
        let (packed, on_tensors) = (packed(name), on_tensors(name));
        let (spec, windows) = (packed.spec(), [0, 1, 1, 0]);
        let (frames, plans) = (frames(spec, 2), plans(spec, windows.len()));
        let [packed, expected] =
            [&packed, &on_tensors].map(|network| network.predict_rollouts(&frames, &windows, &plans).unwrap());
        let most = largest_difference(&packed, &expected);
        // Where depth is estimated, rounding moves a place, and so changes the depth found there; most in frames of noise.
        let bound = if spec.flow().is_some_and(|flow| flow.layers.depth) {
            4e-5
        } else {
            1e-5
        };
        assert!(most < bound, "{name}: {most}");
    }
}

#[test]
fn many_plans_give_the_bits_that_each_alone_gives() {
    for name in ["moving-flow", "rooms", "home"] {
        let network = packed(name);
        let spec = network.spec();
        let (frames, plans) = (frames(spec, 1), plans(spec, 21));
        let together = network.predict_rollouts(&frames, &[0; 21], &plans).unwrap();
        for plan in [0, 7, 20] {
            let row = |tensor: &Tensor| tensor.narrow(0, plan, 1).unwrap();
            let own = ConditioningTensors {
                actions: plans.actions.as_ref().map(row),
                state: plans.state.as_ref().map(row),
                ..ConditioningTensors::none()
            };
            let alone = network.predict_rollouts(&frames, &[0], &own).unwrap();
            assert_eq!(largest_difference(&alone, &row(&together)), 0.0, "{name}");
        }
    }
}
