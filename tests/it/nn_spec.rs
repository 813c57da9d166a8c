//! A model's specification and its weights: bounds, counts, names, storage.

use std::collections::BTreeMap;

use candle_core::{DType, Tensor};
use foreframe_core::nn::{Architecture, Conditioning, DenseSpec, Loss, ModelSpec, NnError, Parameters, Reconstruction};
use foreframe_core::types::Seed;

use crate::nn_fixtures::{all_kinds, bits, channel, tiny, values};

/// The sizes of a dense network, to change them.
fn dense(spec: &mut ModelSpec) -> &mut DenseSpec {
    match &mut spec.architecture {
        Architecture::Dense(dense) => dense,
        _ => panic!("the specification is not that of a dense network"),
    }
}

#[test]
fn specifications_out_of_bounds_are_refused() {
    type Change = fn(&mut ModelSpec);
    let changes: [(&str, Change); 12] = [
        ("frame_width_px", |spec| spec.frame_width_px = 0),
        ("frame_height_px", |spec| spec.frame_height_px = 513),
        ("frame_period_s", |spec| spec.frame_period_s = f64::NAN),
        ("preprocess.blur_sigma_px", |spec| spec.preprocess.blur_sigma_px = -1.0),
        ("context", |spec| spec.context = 0),
        ("horizon", |spec| spec.horizon = 257),
        ("features", |spec| dense(spec).features = 0),
        ("hidden", |spec| dense(spec).hidden = 100_000),
        ("number of actions", |spec| {
            spec.actions = vec![channel("a", 0.0, 1.0); 65];
        }),
        ("number of states", |spec| {
            spec.states = vec![channel("a", 0.0, 1.0); 65];
        }),
        ("number of parameters", |spec| {
            (dense(spec).hidden, dense(spec).features) = (4096, 4096);
        }),
        ("conditioning", |spec| spec.states.clear()),
    ];
    for (field, change) in changes {
        let mut spec = tiny(Conditioning::StateAction, Reconstruction::Sequence);
        spec.validate().unwrap();
        change(&mut spec);
        let message = spec.validate().unwrap_err().to_string();
        assert!(
            message.starts_with(&format!("model specification: {field}")),
            "{message}"
        );
    }
    let mut spec = tiny(Conditioning::None, Reconstruction::Sequence);
    spec.actions[0].std = f32::INFINITY;
    assert!(matches!(spec.validate(), Err(NnError::ChannelScale { .. })));
}

#[test]
fn the_parameter_count_matches_the_tensors() {
    for (spec, _) in all_kinds() {
        let parameters = Parameters::initialize(&spec, Seed(0)).unwrap();
        assert_eq!(spec.parameter_count(), parameters.count());
    }
}

/// Each weight (biases excluded) counts once for each frame that it is applied to.
#[test]
fn multiply_adds_count_every_use_of_a_weight() {
    for (spec, _) in all_kinds() {
        let parameters = Parameters::initialize(&spec, Seed(0)).unwrap();
        let uses = |name: &str| match name.split('.').next().unwrap() {
            _ if name.ends_with("bias") => 0,
            "frame_encoder" | "encoder" => spec.context,
            "frame_decoder" | "predictor" => spec.horizon,
            _ => 0,
        };
        let count = |(name, var): (&str, &candle_core::Var)| (uses(name) * var.elem_count()) as u64;
        let total: u64 = parameters.iter().map(count).sum();
        assert_eq!(spec.multiply_adds_per_frame(), total.div_ceil(spec.horizon as u64));
    }
}

#[test]
fn stored_weights_are_checked_and_converted_to_f32() {
    let spec = tiny(Conditioning::None, Reconstruction::Sequence);
    let parameters = Parameters::initialize(&spec, Seed(4)).unwrap();
    let stored: BTreeMap<String, Tensor> = parameters.snapshot().unwrap();
    let halved = stored
        .iter()
        .map(|(name, tensor)| (name.clone(), tensor.to_dtype(DType::F16).unwrap()))
        .collect();
    let loaded = Parameters::from_tensors(&spec, halved).unwrap();
    assert!(loaded.iter().all(|(_, var)| var.dtype() == DType::F32));
    let refused = |change: &dyn Fn(&mut BTreeMap<String, Tensor>)| {
        let mut tensors = stored.clone();
        change(&mut tensors);
        Parameters::from_tensors(&spec, tensors).unwrap_err().to_string()
    };
    let missing = refused(&|tensors| drop(tensors.remove("encoder.w_h")));
    assert!(missing.starts_with("tensor \"encoder.w_h\" is missing"), "{missing}");
    let unknown = refused(&|tensors| drop(tensors.insert("extra".to_owned(), values(&[1], 0.0))));
    assert!(unknown.contains("\"extra\""), "{unknown}");
    let shape = refused(&|tensors| drop(tensors.insert("encoder.bias".to_owned(), values(&[3], 0.0))));
    assert_eq!(shape, "tensor \"encoder.bias\" has shape [3]; the model needs [28]");
    let nan = refused(&|tensors| drop(tensors.insert("encoder.bias".to_owned(), (values(&[28], 0.0) / 0.0).unwrap())));
    assert!(nan.ends_with("not a finite number"), "{nan}");
}

#[test]
fn a_snapshot_restores_its_values() {
    let spec = tiny(Conditioning::None, Reconstruction::Stepwise);
    let parameters = Parameters::initialize(&spec, Seed(4)).unwrap();
    let snapshot = parameters.snapshot().unwrap();
    let bias = parameters.get("encoder.bias").unwrap();
    let before = bits(bias);
    bias.set(&values(&[28], 0.3)).unwrap();
    assert_eq!(bits(&snapshot["encoder.bias"]), before);
    parameters.restore(&snapshot).unwrap();
    assert_eq!(bits(bias), before);
}

#[test]
fn specification_names_on_disk_are_stable() {
    let spec = tiny(Conditioning::StateAction, Reconstruction::Stepwise);
    let text = serde_json::to_string(&spec).unwrap();
    assert!(text.contains("\"conditioning\":\"state-action\"") && text.contains("\"reconstruction\":\"stepwise\""));
    assert_eq!(serde_json::from_str::<ModelSpec>(&text).unwrap(), spec);
    let error = "max".parse::<Loss>().unwrap_err().to_string();
    assert_eq!(error, "unknown loss \"max\"; there are \"mse\" and \"l1\"");
    assert_eq!("l1".parse::<Loss>().unwrap().to_string(), "l1");
}
