//! Small models and inputs for the tests of the network.

use candle_core::{Device, Tensor};
use foreframe_core::nn::{
    Architecture, ChannelScale, Conditioning, ConditioningTensors, DenseSpec, ModelSpec, PredictorOutput,
    Reconstruction,
};

pub(crate) fn channel(name: &str, mean: f32, std: f32) -> ChannelScale {
    ChannelScale {
        name: name.to_owned(),
        unit: String::new(),
        mean,
        std,
    }
}

pub(crate) fn tiny(conditioning: Conditioning, reconstruction: Reconstruction) -> ModelSpec {
    ModelSpec {
        frame_width_px: 5,
        frame_height_px: 4,
        context: 3,
        horizon: 4,
        architecture: Architecture::Dense(DenseSpec {
            features: 6,
            hidden: 7,
            reconstruction,
            ..DenseSpec::default()
        }),
        conditioning,
        actions: vec![channel("linear", 0.3, 0.2), channel("angular", -0.1, 0.9)],
        states: vec![
            channel("x", 1.0, 2.0),
            channel("y", 0.0, 0.0),
            channel("heading", 0.0, 0.7),
        ],
        ..ModelSpec::default()
    }
}

/// Deterministic values between −1 and 1 in a tensor of this shape.
pub(crate) fn values(shape: &[usize], phase: f32) -> Tensor {
    let count = shape.iter().product::<usize>();
    let values: Vec<f32> = (0..count).map(|i| (i as f32 * 12.9898 + phase).sin()).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

pub(crate) fn condition(spec: &ModelSpec, batch: usize) -> ConditioningTensors {
    ConditioningTensors {
        actions: Some(values(&[batch, spec.horizon, spec.actions.len()], 1.0)),
        state: Some((values(&[batch, spec.states.len()], 2.0) * 1e-3).unwrap()),
        ..ConditioningTensors::none()
    }
}

pub(crate) fn all_kinds() -> Vec<(ModelSpec, bool)> {
    let mut kinds = Vec::new();
    for conditioning in [
        Conditioning::None,
        Conditioning::Action,
        Conditioning::State,
        Conditioning::StateAction,
    ] {
        for reconstruction in [Reconstruction::Sequence, Reconstruction::Stepwise] {
            for truth in [false, true] {
                kinds.push((tiny(conditioning, reconstruction), truth));
            }
        }
    }
    for truth in [false, true] {
        let mut absolute = tiny(Conditioning::StateAction, Reconstruction::Sequence);
        if let Architecture::Dense(dense) = &mut absolute.architecture {
            dense.predictor_output = PredictorOutput::Absolute;
        }
        kinds.push((absolute, truth));
    }
    kinds
}

pub(crate) fn largest_difference(a: &Tensor, b: &Tensor) -> f32 {
    let difference = (a - b).unwrap().abs().unwrap().flatten_all().unwrap();
    difference.max(0).unwrap().to_scalar().unwrap()
}

pub(crate) fn bits(tensor: &Tensor) -> Vec<u32> {
    let values = tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    values.into_iter().map(f32::to_bits).collect()
}
