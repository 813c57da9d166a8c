//! The whole model: gradients, determinism, conditioning, and errors.

use candle_core::{DType, Device, Tensor};
use foreframe::nn::{Conditioning, ConditioningTensors, Feedback, Loss, Model, ModelSpec, Parameters, Reconstruction};
use foreframe::types::Seed;

use crate::nn_fixtures::{all_kinds, bits, condition, in_f64, largest_difference, tiny, values};

/// A loss that depends on every tensor of the model.
fn whole_loss(model: &Model, frames: &Tensor, condition: &ConditioningTensors, truth: Option<&Tensor>) -> Tensor {
    let spec = model.spec();
    let batch = frames.dim(0).unwrap();
    let flat = frames.flatten(0, 1).unwrap();
    let features = model.encode_frames(&flat).unwrap();
    let features = features.reshape((batch, spec.context, spec.features)).unwrap();
    let feedback = truth.map_or(Feedback::Prediction, Feedback::TeacherForcing);
    let predicted = model.predict(&features, condition, feedback).unwrap();
    let again = model.reconstruct(&features).unwrap().unwrap();
    let predicted = model.decode_frames(&predicted.flatten(0, 1).unwrap()).unwrap();
    let again = model.decode_frames(&again.flatten(0, 1).unwrap()).unwrap();
    let ahead = values(predicted.dims(), 0.5).to_dtype(frames.dtype()).unwrap();
    let first = Loss::Mse.between(&predicted, &ahead).unwrap();
    let second = Loss::Mse.between(&again, &flat).unwrap();
    (first + second).unwrap()
}

#[test]
fn gradients_agree_with_finite_differences() {
    for (spec, with_truth) in all_kinds() {
        let parameters = Parameters::initialize(&spec, Seed(3))
            .unwrap()
            .to_dtype(DType::F64)
            .unwrap();
        let model = Model::new(spec.clone(), &parameters).unwrap();
        let frames = values(&[2, spec.context, spec.pixels()], 0.0)
            .to_dtype(DType::F64)
            .unwrap();
        let truth = values(&[2, spec.horizon, spec.features], 0.7)
            .to_dtype(DType::F64)
            .unwrap();
        let truth = with_truth.then_some(&truth);
        let condition = in_f64(&condition(&spec, 2));
        let loss = || whole_loss(&model, &frames, &condition, truth);
        let gradients = loss().backward().unwrap();
        for (name, var) in parameters.iter() {
            let gradient = gradients
                .get(var.as_tensor())
                .unwrap_or_else(|| panic!("{name} has no gradient"));
            let gradient = gradient.flatten_all().unwrap().to_vec1::<f64>().unwrap();
            let original = var.flatten_all().unwrap().to_vec1::<f64>().unwrap();
            for place in [0, original.len() / 2, original.len() - 1] {
                let at = |shift: f64| {
                    let mut moved = original.clone();
                    moved[place] += shift;
                    var.set(&Tensor::from_vec(moved, var.dims(), &Device::Cpu).unwrap())
                        .unwrap();
                    loss().to_scalar::<f64>().unwrap()
                };
                let slope = (at(1e-5) - at(-1e-5)) / 2e-5;
                at(0.0);
                let error = (slope - gradient[place]).abs();
                assert!(
                    error < 1e-8 + 1e-5 * slope.abs(),
                    "{name}[{place}]: {slope} against {}",
                    gradient[place]
                );
            }
        }
    }
}

#[test]
fn fused_f32_training_agrees_with_composed_f64() {
    for (spec, with_truth) in all_kinds() {
        let parameters = Parameters::initialize(&spec, Seed(5)).unwrap();
        let doubles = parameters.to_dtype(DType::F64).unwrap();
        let frames = values(&[3, spec.context, spec.pixels()], 0.0);
        let truth = values(&[3, spec.horizon, spec.features], 0.7);
        let (frames64, truth64) = (
            frames.to_dtype(DType::F64).unwrap(),
            truth.to_dtype(DType::F64).unwrap(),
        );
        let condition = condition(&spec, 3);
        let model = Model::new(spec.clone(), &parameters).unwrap();
        let model64 = Model::new(spec.clone(), &doubles).unwrap();
        let loss = whole_loss(&model, &frames, &condition, with_truth.then_some(&truth));
        let loss64 = whole_loss(&model64, &frames64, &in_f64(&condition), with_truth.then_some(&truth64));
        let (value, value64) = (loss.to_scalar::<f32>().unwrap(), loss64.to_scalar::<f64>().unwrap());
        assert!((f64::from(value) - value64).abs() < 1e-6 * value64.max(1.0));
        let (gradients, gradients64) = (loss.backward().unwrap(), loss64.backward().unwrap());
        for ((name, var), (_, var64)) in parameters.iter().zip(doubles.iter()) {
            let gradient = gradients.get(var.as_tensor()).unwrap().to_dtype(DType::F64).unwrap();
            let gradient64 = gradients64.get(var64.as_tensor()).unwrap();
            let error = (gradient - gradient64).unwrap().abs().unwrap().flatten_all().unwrap();
            assert!(error.max(0).unwrap().to_scalar::<f64>().unwrap() < 1e-6, "{name}");
        }
    }
}

#[test]
fn fused_f32_prediction_agrees_with_composed_f64() {
    for (spec, _) in all_kinds() {
        let parameters = Parameters::initialize(&spec, Seed(6)).unwrap();
        let frames = values(&[2, spec.context, spec.pixels()], 0.2);
        let condition = condition(&spec, 2);
        let model = Model::detached(spec.clone(), &parameters).unwrap();
        let doubles = Model::detached(spec, &parameters.to_dtype(DType::F64).unwrap()).unwrap();
        let predicted = model.predict_frames(&frames, &condition).unwrap();
        let exact = doubles
            .predict_frames(&frames.to_dtype(DType::F64).unwrap(), &in_f64(&condition))
            .unwrap();
        assert!(!predicted.track_op());
        assert!(largest_difference(&predicted, &exact.to_dtype(DType::F32).unwrap()) < 1e-5);
    }
}

#[test]
fn results_do_not_depend_on_other_threads() {
    let spec = ModelSpec {
        frame_width_px: 16,
        frame_height_px: 16,
        ..ModelSpec::default()
    };
    let frames = values(&[8, spec.context, spec.pixels()], 0.0);
    let run = || {
        let parameters = Parameters::initialize(&spec, Seed(11)).unwrap();
        let model = Model::new(spec.clone(), &parameters).unwrap();
        let loss = whole_loss(&model, &frames, &ConditioningTensors::none(), None);
        let gradients = loss.backward().unwrap();
        let of = |(_, var): (&str, &candle_core::Var)| bits(gradients.get(var.as_tensor()).unwrap());
        (bits(&loss), parameters.iter().map(of).collect::<Vec<_>>())
    };
    let alone = run();
    let together = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..3).map(|_| scope.spawn(run)).collect();
        threads
            .into_iter()
            .map(|thread| thread.join().unwrap())
            .collect::<Vec<_>>()
    });
    assert!(together.iter().all(|other| *other == alone));
}

#[test]
fn a_batched_window_is_predicted_as_a_single_one() {
    let spec = tiny(Conditioning::StateAction, Reconstruction::Sequence);
    let model = Model::new(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let (frames, condition) = (values(&[5, spec.context, spec.pixels()], 0.0), condition(&spec, 5));
    let together = model.predict_frames(&frames, &condition).unwrap();
    for window in 0..5 {
        let one = |tensor: &Tensor| tensor.narrow(0, window, 1).unwrap();
        let own = ConditioningTensors {
            actions: condition.actions.as_ref().map(one),
            state: condition.state.as_ref().map(one),
        };
        let alone = model.predict_frames(&one(&frames), &own).unwrap();
        assert!(largest_difference(&alone, &one(&together)) < 1e-5);
    }
}

#[test]
fn an_unconditioned_model_ignores_actions() {
    let spec = tiny(Conditioning::None, Reconstruction::Sequence);
    let model = Model::new(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let frames = values(&[2, spec.context, spec.pixels()], 0.0);
    let without = model.predict_frames(&frames, &ConditioningTensors::none()).unwrap();
    let with = model.predict_frames(&frames, &condition(&spec, 2)).unwrap();
    assert_eq!(bits(&without), bits(&with));
}

#[test]
fn an_action_changes_only_later_frames() {
    let spec = tiny(Conditioning::Action, Reconstruction::Sequence);
    let model = Model::new(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let frames = values(&[1, spec.context, spec.pixels()], 0.0);
    let predicted = |third: f32| {
        let mut actions = vec![0.1f32; spec.horizon * 2];
        actions[2 * 2] = third;
        let actions = Tensor::from_vec(actions, (1, spec.horizon, 2), &Device::Cpu).unwrap();
        let condition = ConditioningTensors {
            actions: Some(actions),
            state: None,
        };
        model.predict_frames(&frames, &condition).unwrap()
    };
    let difference = (predicted(0.1) - predicted(0.9))
        .unwrap()
        .abs()
        .unwrap()
        .sum((0, 2))
        .unwrap();
    let difference = difference.to_vec1::<f32>().unwrap();
    assert_eq!(difference[..2], [0.0, 0.0]);
    assert!(difference[2] > 1e-4 && difference[3] > 1e-4);
}

#[test]
fn a_missing_or_misshaped_input_names_the_expected_shape() {
    let spec = tiny(Conditioning::StateAction, Reconstruction::Sequence);
    let model = Model::new(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let frames = values(&[2, spec.context, spec.pixels()], 0.0);
    let error = |frames: &Tensor, condition: &ConditioningTensors| {
        model.predict_frames(frames, condition).unwrap_err().to_string()
    };
    let full = condition(&spec, 2);
    assert_eq!(
        error(&frames, &ConditioningTensors::none()),
        "no actions given; this model's conditioning is \"state-action\", which takes [2, 4, 2]: windows, predicted \
         frames, components (linear, angular)"
    );
    let stateless = ConditioningTensors {
        state: None,
        ..full.clone()
    };
    assert!(error(&frames, &stateless).starts_with("no state given"));
    let short = ConditioningTensors {
        actions: Some(values(&[2, 3, 2], 0.0)),
        ..full.clone()
    };
    assert!(error(&frames, &short).starts_with("actions has shape [2, 3, 2]; this model takes [2, 4, 2]"));
    let error = error(&values(&[2, 5, 20], 0.0), &full);
    assert!(
        error.starts_with("frames has shape [2, 5, 20]; this model takes [any, 3, 20] (5×4 px frames"),
        "{error}"
    );
}
