//! The shipped flow networks with packed weights, as the server predicts, beside the same networks on plain tensors.

use std::path::Path;

use candle_core::{Device, Tensor};
use foreframe_core::nn::precision::Precision;
use foreframe_core::nn::{ChannelScale, ConditioningTensors, ModelSpec, Network, NnError};
use foreframe_core::registry;

use crate::nn_fixtures::{largest_difference, values};

fn packed(name: &str) -> Network {
    registry::load(&Path::new("models").join(name)).unwrap().network
}

fn on_tensors(name: &str) -> Network {
    let weights = registry::load_weights(&Path::new("models").join(name)).unwrap();
    Network::detached(weights.manifest.spec, &weights.parameters).unwrap()
}

fn in_precision(name: &str, precision: Precision) -> Network {
    on_tensors(name).packed(precision).unwrap()
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

/// The frames of rollouts from two windows.
fn predicted(network: &Network) -> Tensor {
    let (spec, windows) = (network.spec(), [0, 1, 1, 0]);
    let frames = frames(spec, 2).reshape((2 * spec.context, ())).unwrap();
    let codes = network.encode_frames(&frames).unwrap();
    let codes = codes.reshape((2, spec.context, ())).unwrap();
    let plans = plans(spec, windows.len());
    let ahead = network.predict_rollouts(&codes, &windows, &plans).unwrap();
    network.decode_frames(&ahead.flatten(0, 1).unwrap()).unwrap()
}

#[test]
fn packed_weights_predict_what_the_tensors_predict() {
    for name in [
        "static",
        "paper",
        "moving",
        "moving-flow",
        "rooms",
        "home",
        "static-flow",
    ] {
        let (packed, on_tensors) = (packed(name), on_tensors(name));
        let spec = packed.spec();
        let [packed, expected] = [&packed, &on_tensors].map(predicted);
        let most = largest_difference(&packed, &expected);
        // Where depth is estimated, rounding moves a place, and so changes the depth found there; most in frames of noise, where `home` differs
        // by 6.4e-5.
        let has_depth = spec.flow().is_some_and(|flow| flow.layers.depth);
        let bound = if has_depth { 1e-4 } else { 1e-5 };
        assert!(most < bound, "{name}: {most}");
    }
}

#[test]
fn what_a_thread_predicted_before_changes_nothing() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let networks = ["home", "static-flow", "moving-flow", "static", "rooms", "moving"].map(packed);
    let [alone, again] = [0, 1].map(|_| {
        let predicted = networks.iter().map(|network| pool.install(|| predicted(network)));
        predicted.collect::<Vec<_>>()
    });
    for (alone, again) in alone.iter().zip(&again) {
        assert_eq!(largest_difference(alone, again), 0.0);
    }
}

#[test]
fn a_rollout_of_no_window_is_an_error() {
    for network in ["static", "moving"].map(packed) {
        let spec = network.spec();
        let codes = values(&[2, spec.context, spec.code_len()], 0.5);
        let found = network.predict_rollouts(&codes, &[0, 2], &plans(spec, 2));
        assert!(matches!(found, Err(NnError::Tensor(_))), "{found:?}");
    }
}

#[test]
fn fewer_bits_predict_nearly_the_same() {
    for name in ["static", "moving", "moving-flow", "rooms", "home", "static-flow"] {
        let expected = predicted(&on_tensors(name));
        for (precision, bound) in [(Precision::Bf16, 3e-3), (Precision::Int8, 1e-2)] {
            if !precision.is_supported() {
                eprintln!("skipped: this processor does not multiply {precision}");
                continue;
            }
            let found = predicted(&in_precision(name, precision));
            let differences = (found - &expected).unwrap().abs().unwrap();
            let mean = differences.mean_all().unwrap().to_scalar::<f32>().unwrap();
            assert!(mean < bound, "{name} in {precision}: {mean} of full scale in the mean");
        }
    }
}

#[test]
fn many_plans_give_the_bits_that_each_alone_gives() {
    let networks = ["moving-flow", "rooms", "home", "moving", "static"]
        .map(packed)
        .into_iter();
    let in_fewer_bits = [Precision::Bf16, Precision::Int8]
        .into_iter()
        .filter(|precision| precision.is_supported());
    let in_fewer_bits = in_fewer_bits
        .flat_map(|precision| ["moving", "rooms", "moving-flow", "home"].map(|name| in_precision(name, precision)));
    for network in networks.chain(in_fewer_bits) {
        let spec = network.spec();
        let plans = plans(spec, 21);
        let frames = network
            .encode_frames(&frames(spec, 1).reshape((spec.context, ())).unwrap())
            .unwrap();
        let frames = frames.reshape((1, spec.context, ())).unwrap();
        let together = network.predict_rollouts(&frames, &[0; 21], &plans).unwrap();
        for plan in [0, 7, 20] {
            let row = |tensor: &Tensor| tensor.narrow(0, plan, 1).unwrap();
            let own = ConditioningTensors {
                actions: plans.actions.as_ref().map(row),
                state: plans.state.as_ref().map(row),
                ..ConditioningTensors::none()
            };
            let alone = network.predict_rollouts(&frames, &[0], &own).unwrap();
            assert_eq!(
                largest_difference(&alone, &row(&together)),
                0.0,
                "{:?}",
                spec.architecture
            );
        }
    }
}
