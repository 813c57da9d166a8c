//! Adam: the closed form, resuming, clipping, and errors.

use candle_core::{Device, Tensor};
use foreframe_core::nn::{
    Architecture, ConditioningTensors, DenseSpec, Feedback, Loss, ModelSpec, Network, Parameters,
};
use foreframe_core::types::Seed;
use foreframe_train::training::optimizer::{Gradients, Optimizer, OptimizerConfig, OptimizerError};

const RATE: f64 = 1e-2;

fn tiny() -> ModelSpec {
    ModelSpec {
        frame_width_px: 4,
        frame_height_px: 3,
        context: 2,
        horizon: 2,
        architecture: Architecture::Dense(DenseSpec {
            features: 3,
            hidden: 5,
            ..DenseSpec::default()
        }),
        ..ModelSpec::default()
    }
}

fn values(shape: &[usize], phase: f32) -> Tensor {
    let count = shape.iter().product::<usize>();
    let values: Vec<f32> = (0..count).map(|i| (i as f32 * 7.77 + phase).sin()).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

fn unclipped() -> OptimizerConfig {
    OptimizerConfig {
        clip_norm: f64::INFINITY,
        ..OptimizerConfig::default()
    }
}

/// A loss whose gradient for `frame_decoder.bias` is `slopes`.
fn slope(parameters: &Parameters, slopes: &[f32]) -> Tensor {
    let slopes = Tensor::new(slopes, &Device::Cpu).unwrap();
    (parameters.get("frame_decoder.bias").unwrap().as_tensor() * slopes)
        .unwrap()
        .sum_all()
        .unwrap()
}

fn bias(parameters: &Parameters) -> Vec<f32> {
    parameters.get("frame_decoder.bias").unwrap().to_vec1().unwrap()
}

fn all_bits(parameters: &Parameters) -> Vec<u32> {
    let of = |var: &candle_core::Var| var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    parameters
        .iter()
        .flat_map(|(_, var)| of(var))
        .map(f32::to_bits)
        .collect()
}

fn train(parameters: &Parameters, adam: &mut Optimizer, steps: std::ops::Range<usize>) {
    let spec = tiny();
    let model = Network::new(spec.clone(), parameters).unwrap();
    for step in steps {
        let seen = values(&[2, spec.context, spec.code_len()], step as f32);
        let ahead = values(&[2, spec.horizon, spec.code_len()], step as f32 + 0.5);
        let predicted = model
            .predict(&seen, &ConditioningTensors::none(), Feedback::Prediction)
            .unwrap();
        let loss = Loss::Mse.between(&predicted, &ahead).unwrap();
        let gradients = Gradients::of(&loss, parameters).unwrap();
        adam.update(parameters, &gradients, RATE).unwrap();
    }
}

#[test]
fn adam_follows_its_closed_form_for_two_steps() {
    let parameters = Parameters::initialize(&tiny(), Seed(1)).unwrap();
    let mut adam = Optimizer::new(unclipped());
    let slopes = [0.5f32, -2.0, 1e-3, 30.0, 0.0, 1.0, -1.0, 0.1, 0.2, 0.3, 0.4, 0.6];
    let second: Vec<f32> = slopes.iter().map(|slope| 0.3 - slope).collect();
    let start = bias(&parameters);
    let first_gradients = Gradients::of(&slope(&parameters, &slopes), &parameters).unwrap();
    let norm = adam.update(&parameters, &first_gradients, RATE).unwrap();
    let expected = slopes.iter().map(|slope| f64::from(*slope).powi(2)).sum::<f64>().sqrt();
    assert!((norm - expected).abs() < 1e-4);
    let after_one = bias(&parameters);
    let second_gradients = Gradients::of(&slope(&parameters, &second), &parameters).unwrap();
    adam.update(&parameters, &second_gradients, RATE).unwrap();
    let after_two = bias(&parameters);
    for place in 0..slopes.len() {
        let (g1, g2) = (f64::from(slopes[place]), f64::from(second[place]));
        // The first step is the rate times the gradient's sign; the second follows from m and v written out.
        let one = f64::from(start[place]) - RATE * g1 / (g1.abs() + 1e-8);
        let m = (0.9 * 0.1 * g1 + 0.1 * g2) / (1.0 - 0.81);
        let v = (0.999 * 0.001 * g1 * g1 + 0.001 * g2 * g2) / (1.0 - 0.999 * 0.999);
        let two = one - RATE * m / (v.sqrt() + 1e-8);
        assert!((f64::from(after_one[place]) - one).abs() < 1e-6, "place {place}");
        assert!((f64::from(after_two[place]) - two).abs() < 1e-6, "place {place}");
    }
}

#[test]
fn a_resumed_run_is_bit_identical() {
    let whole = Parameters::initialize(&tiny(), Seed(1)).unwrap();
    train(&whole, &mut Optimizer::new(OptimizerConfig::default()), 0..7);
    let stopped = Parameters::initialize(&tiny(), Seed(1)).unwrap();
    let mut adam = Optimizer::new(OptimizerConfig::default());
    train(&stopped, &mut adam, 0..3);
    let (weights, moments) = (stopped.snapshot().unwrap(), adam.export().unwrap());
    let resumed = Parameters::from_tensors(&tiny(), weights).unwrap();
    let mut adam = Optimizer::import(OptimizerConfig::default(), &moments, &resumed).unwrap();
    assert_eq!(adam.steps(), 3);
    train(&resumed, &mut adam, 3..7);
    assert_eq!(all_bits(&resumed), all_bits(&whole));
}

#[test]
fn a_large_gradient_is_scaled_to_the_clipping_norm() {
    let exported = |config: OptimizerConfig, slopes: &[f32]| {
        let parameters = Parameters::initialize(&tiny(), Seed(1)).unwrap();
        let mut adam = Optimizer::new(config);
        let gradients = Gradients::of(&slope(&parameters, slopes), &parameters).unwrap();
        let norm = adam.update(&parameters, &gradients, RATE).unwrap();
        (
            norm,
            adam.export().unwrap()["adam.first.frame_decoder.bias"]
                .to_vec1::<f32>()
                .unwrap(),
        )
    };
    let (norm, clipped) = exported(OptimizerConfig::default(), &[3.0; 12]);
    let (_, unit) = exported(unclipped(), &[1.0 / 12f32.sqrt(); 12]);
    assert!((norm - 108f64.sqrt()).abs() < 1e-4);
    for (clipped, unit) in clipped.iter().zip(unit) {
        assert!((clipped - unit).abs() < 1e-7);
    }
}

#[test]
fn a_non_finite_gradient_or_loss_changes_nothing() {
    let parameters = Parameters::initialize(&tiny(), Seed(1)).unwrap();
    let before = all_bits(&parameters);
    let mut adam = Optimizer::new(OptimizerConfig::default());
    let infinite = slope(&parameters, &[f32::INFINITY; 12]);
    assert!(matches!(
        Gradients::of(&infinite, &parameters),
        Err(OptimizerError::LossNotFinite { .. })
    ));
    // √0 is finite, but its derivative is not.
    let edge = slope(&parameters, &[0.0; 12]).sqrt().unwrap();
    let gradients = Gradients::of(&edge, &parameters).unwrap();
    let error = adam.update(&parameters, &gradients, RATE).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the gradient of tensor \"frame_decoder.bias\" contains a value that is not a finite number"
    );
    assert_eq!((all_bits(&parameters), adam.steps()), (before, 0));
}

#[test]
fn half_batch_gradients_average_to_the_batch_gradient() {
    let spec = tiny();
    let parameters = Parameters::initialize(&spec, Seed(1)).unwrap();
    let model = Network::new(spec.clone(), &parameters).unwrap();
    let (seen, ahead) = (values(&[4, 2, 3], 0.0), values(&[4, 2, 3], 0.5));
    let of = |from: usize, count: usize| {
        let seen = seen.narrow(0, from, count).unwrap();
        let predicted = model
            .predict(&seen, &ConditioningTensors::none(), Feedback::Prediction)
            .unwrap();
        let loss = Loss::L1
            .between(&predicted, &ahead.narrow(0, from, count).unwrap())
            .unwrap();
        Gradients::of(&loss, &parameters).unwrap()
    };
    let whole = of(0, 4);
    let joined = Gradients::mean(vec![of(0, 2), of(2, 2)]).unwrap();
    assert!((whole.loss() - joined.loss()).abs() < 1e-6);
    assert!((whole.norm().unwrap() - joined.norm().unwrap()).abs() < 1e-6);
    assert!(matches!(Gradients::mean(Vec::new()), Err(OptimizerError::Join)));
}

#[test]
fn a_mismatched_optimizer_state_is_refused() {
    let parameters = Parameters::initialize(&tiny(), Seed(1)).unwrap();
    let mut adam = Optimizer::new(OptimizerConfig::default());
    train(&parameters, &mut adam, 0..1);
    let refused = |change: &dyn Fn(&mut std::collections::BTreeMap<String, Tensor>)| {
        let mut tensors = adam.export().unwrap();
        change(&mut tensors);
        Optimizer::import(OptimizerConfig::default(), &tensors, &parameters)
            .unwrap_err()
            .to_string()
    };
    let message = refused(&|tensors| drop(tensors.remove("adam.second.encoder.w_h")));
    assert_eq!(
        message,
        "optimizer state: tensor \"adam.second.encoder.w_h\" is missing"
    );
    let message = refused(&|tensors| drop(tensors.remove("adam.step")));
    assert_eq!(message, "optimizer state: tensor \"adam.step\" is missing");
    let message = refused(&|tensors| drop(tensors.insert("adam.first.encoder.bias".to_owned(), values(&[2], 0.0))));
    assert!(message.contains("has shape [2]; the parameter has [20]"), "{message}");
}
