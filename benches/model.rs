//! Time of predictions and of training steps with the default model: 64×64 px, 128 features, 256 hidden units, 5 frames of
//! context, 5 predicted frames. All on one thread, as the server predicts; with `FOREFRAME_PRECISION=int8`, predictions in that precision.
#![allow(clippy::unwrap_used, missing_docs)]

use candle_core::{DType, Device, Tensor};
use criterion::{Criterion, criterion_group};
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::nn::{
    Architecture, ChannelScale, Conditioning, ConditioningTensors, Feedback, FlowSpec, Loss, ModelSpec, Network,
    Parameters, precision,
};
use foreframe_core::types::Seed;
use foreframe_train::training::TrainConfig;
use foreframe_train::training::config::ArchitectureConfig;
use foreframe_train::training::optimizer::{Gradients, Optimizer, OptimizerConfig};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const WINDOWS: usize = 64;

/// Smooth values from 0 to 1 in a tensor of this shape.
fn values(shape: (usize, usize, usize)) -> Tensor {
    let count = shape.0 * shape.1 * shape.2;
    let values: Vec<f32> = (0..count).map(|i| 0.5 + 0.5 * (i as f32 * 0.37).sin()).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

/// The default model, and the flow network of the preset `moving-flow` with its inputs.
fn specs() -> [(&'static str, ModelSpec); 2] {
    let channel = |name: &str, unit: &str| ChannelScale {
        name: name.to_owned(),
        unit: unit.to_owned(),
        mean: 0.0,
        std: 1.0,
    };
    let states = [
        channel("x", "m"),
        channel("y", "m"),
        channel("heading_cos", ""),
        channel("heading_sin", ""),
        channel("linear", "m/s"),
        channel("angular", "rad/s"),
    ];
    let ArchitectureConfig::Flow(layers) = TrainConfig::preset("moving-flow").unwrap().model.architecture else {
        unreachable!("moving-flow has the flow network");
    };
    let flow = ModelSpec {
        architecture: Architecture::Flow(FlowSpec {
            layers,
            camera: CameraModel::new(1.0, 0.2).ok(),
        }),
        conditioning: Conditioning::StateAction,
        actions: vec![channel("linear", "m/s"), channel("angular", "rad/s")],
        states: states.to_vec(),
        ..ModelSpec::default()
    };
    [("dense", ModelSpec::default()), ("flow", flow)]
}

fn prediction(c: &mut Criterion) {
    for (name, spec) in specs() {
        let parameters = Parameters::initialize(&spec, Seed(1)).unwrap();
        let model = Network::detached(spec.clone(), &parameters)
            .and_then(|network| network.packed(precision::current()))
            .unwrap();
        for windows in [1, WINDOWS] {
            let frames = values((windows, spec.context, spec.pixels()));
            let zeros = |shape: &[usize]| Tensor::zeros(shape, DType::F32, &Device::Cpu).unwrap();
            let conditioning = ConditioningTensors {
                actions: Some(zeros(&[windows, spec.horizon, spec.actions.len()])),
                state: Some(zeros(&[windows, spec.states.len()])),
                ..ConditioningTensors::none()
            };
            c.bench_function(&format!("{name} prediction of {windows} windows"), |b| {
                b.iter(|| model.predict_frames(&frames, &conditioning).unwrap());
            });
        }
    }
}

/// One frame of the context is new; the codes of the others are known.
fn step(c: &mut Criterion) {
    let spec = ModelSpec::default();
    let parameters = Parameters::initialize(&spec, Seed(1)).unwrap();
    let model = Network::detached(spec.clone(), &parameters)
        .and_then(|network| network.packed(precision::current()))
        .unwrap();
    let known = values((1, spec.context - 1, spec.code_len()));
    let frame = values((1, 1, spec.pixels())).squeeze(1).unwrap();
    c.bench_function("dense step of a stream", |b| {
        b.iter(|| {
            let code = model.encode_frames(&frame).unwrap().unsqueeze(1).unwrap();
            let codes = Tensor::cat(&[&known, &code], 1).unwrap();
            let ahead = model
                .predict(&codes, &ConditioningTensors::none(), Feedback::Prediction)
                .unwrap();
            model.decode_frames(&ahead.flatten(0, 1).unwrap()).unwrap()
        });
    });
}

/// Forward pass, backward pass and Adam: from pixels to pixels, or with a frozen codec from features to features.
fn training(c: &mut Criterion) {
    let spec = ModelSpec::default();
    let parameters = Parameters::initialize(&spec, Seed(1)).unwrap();
    let model = Network::new(spec.clone(), &parameters).unwrap();
    let (context, horizon, pixels, features) = (spec.context, spec.horizon, spec.pixels(), spec.code_len());
    let (seen, ahead) = (values((WINDOWS, context, pixels)), values((WINDOWS, horizon, pixels)));
    let mut adam = Optimizer::new(OptimizerConfig::default());
    let mut update = |loss: &Tensor| {
        let gradients = Gradients::of(loss, &parameters).unwrap();
        adam.update(&parameters, &gradients, 1e-4).unwrap()
    };
    c.bench_function("training step of 64 windows", |b| {
        b.iter(|| {
            let predicted = model.predict_frames(&seen, &ConditioningTensors::none()).unwrap();
            update(&Loss::Mse.between(&predicted, &ahead).unwrap())
        });
    });
    let frozen = Network::with_frozen(spec, &parameters, &["frame_"]).unwrap();
    let (seen, ahead) = (
        values((WINDOWS, context, features)),
        values((WINDOWS, horizon, features)),
    );
    c.bench_function("training step of 64 windows, features only", |b| {
        b.iter(|| {
            let predicted = frozen
                .predict(&seen, &ConditioningTensors::none(), Feedback::Prediction)
                .unwrap();
            update(&Loss::Mse.between(&predicted, &ahead).unwrap())
        });
    });
    c.bench_function("training step of 64 windows, features only, both decoders", |b| {
        b.iter(|| {
            let predicted = frozen
                .predict(&seen, &ConditioningTensors::none(), Feedback::Prediction)
                .unwrap();
            let again = frozen.reconstruct(&seen).unwrap().unwrap();
            let loss = Loss::Mse.between(&predicted, &ahead).unwrap();
            update(&(loss + Loss::Mse.between(&again, &seen).unwrap()).unwrap())
        });
    });
}

criterion_group! {
    name = model;
    config = Criterion::default().sample_size(20).measurement_time(std::time::Duration::from_secs(3));
    targets = prediction, step, training
}

fn main() {
    for variable in ["RAYON_NUM_THREADS", "CANDLE_NUM_THREADS"] {
        #[expect(unsafe_code, reason = "no safe call changes the environment")]
        // SAFETY: no other thread runs yet. Without these, candle counts the cores before every product.
        unsafe {
            std::env::set_var(variable, "1");
        }
    }
    if let Ok(name) = std::env::var("FOREFRAME_PRECISION") {
        precision::choose(name.parse().unwrap()).unwrap();
    }
    model();
    Criterion::default().configure_from_args().final_summary();
}
