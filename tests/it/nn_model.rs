//! The whole model: gradients, determinism, conditioning, and errors.

use candle_core::{DType, Device, Tensor};
use foreframe_core::nn::{
    Conditioning, ConditioningTensors, Feedback, Loss, ModelSpec, Network, Parameters, Reconstruction,
};
use foreframe_core::types::Seed;

use crate::nn_fixtures::{all_kinds, bits, condition, largest_difference, tiny, values};
use crate::nn_reference::{Reference, in_f64};

/// A loss that depends on every tensor of the model.
fn whole_loss(model: &Network, frames: &Tensor, condition: &ConditioningTensors, truth: Option<&Tensor>) -> Tensor {
    let spec = model.spec();
    let batch = frames.dim(0).unwrap();
    let flat = frames.flatten(0, 1).unwrap();
    let features = model.encode_frames(&flat).unwrap();
    let features = features.reshape((batch, spec.context, spec.code_len())).unwrap();
    let feedback = truth.map_or(Feedback::Prediction, Feedback::TeacherForcing);
    let predicted = model.predict(&features, condition, feedback).unwrap();
    let again = model.reconstruct(&features).unwrap().unwrap();
    let predicted = model.decode_frames(&predicted.flatten(0, 1).unwrap()).unwrap();
    let again = model.decode_frames(&again.flatten(0, 1).unwrap()).unwrap();
    let ahead = values(predicted.dims(), 0.5);
    let first = Loss::Mse.between(&predicted, &ahead).unwrap();
    let second = Loss::Mse.between(&again, &flat).unwrap();
    (first + second).unwrap()
}

/// The same loss of the reference.
fn reference_loss(
    reference: &Reference,
    frames: &Tensor,
    condition: &ConditioningTensors,
    truth: Option<&Tensor>,
) -> Tensor {
    let [predicted, again] = reference.frames(frames, condition, truth).unwrap();
    let ahead = values(&[predicted.elem_count()], 0.5);
    let mse = |found: &Tensor, target: &Tensor| {
        let difference = (found.flatten_all().unwrap() - in_f64(&target.flatten_all().unwrap())).unwrap();
        difference.sqr().unwrap().mean_all().unwrap()
    };
    (mse(&predicted, &ahead) + mse(&again, frames)).unwrap()
}

#[test]
fn training_agrees_with_the_reference() {
    for (spec, with_truth) in all_kinds() {
        let parameters = Parameters::initialize(&spec, Seed(5)).unwrap();
        let reference = Reference::new(&spec, &parameters);
        let frames = values(&[3, spec.context, spec.pixels()], 0.0);
        let truth = values(&[3, spec.horizon, spec.code_len()], 0.7);
        let truth = with_truth.then_some(&truth);
        let condition = condition(&spec, 3);
        let model = Network::new(spec.clone(), &parameters).unwrap();
        let loss = whole_loss(&model, &frames, &condition, truth);
        let exact = reference_loss(&reference, &frames, &condition, truth);
        let (value, exact_value) = (loss.to_scalar::<f32>().unwrap(), exact.to_scalar::<f64>().unwrap());
        assert!((f64::from(value) - exact_value).abs() < 1e-6 * exact_value.max(1.0));
        let (gradients, exact_gradients) = (loss.backward().unwrap(), exact.backward().unwrap());
        for (name, var) in parameters.iter() {
            let gradient = in_f64(gradients.get(var.as_tensor()).unwrap());
            let exact_gradient = exact_gradients.get(reference.vars[name].as_tensor()).unwrap();
            let error = (gradient - exact_gradient).unwrap().abs().unwrap().max_all().unwrap();
            assert!(error.to_scalar::<f64>().unwrap() < 1e-6, "{name}");
        }
    }
}

#[test]
fn prediction_agrees_with_the_reference() {
    for (spec, _) in all_kinds() {
        let parameters = Parameters::initialize(&spec, Seed(6)).unwrap();
        let frames = values(&[2, spec.context, spec.pixels()], 0.2);
        let condition = condition(&spec, 2);
        let model = Network::detached(spec.clone(), &parameters).unwrap();
        let predicted = model.predict_frames(&frames, &condition).unwrap();
        let [exact, _] = Reference::new(&spec, &parameters)
            .frames(&frames, &condition, None)
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
        let model = Network::new(spec.clone(), &parameters).unwrap();
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
    let model = Network::new(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let (frames, condition) = (values(&[5, spec.context, spec.pixels()], 0.0), condition(&spec, 5));
    let together = model.predict_frames(&frames, &condition).unwrap();
    for window in 0..5 {
        let one = |tensor: &Tensor| tensor.narrow(0, window, 1).unwrap();
        let own = ConditioningTensors {
            actions: condition.actions.as_ref().map(one),
            state: condition.state.as_ref().map(one),
            ..ConditioningTensors::none()
        };
        let alone = model.predict_frames(&one(&frames), &own).unwrap();
        assert!(largest_difference(&alone, &one(&together)) < 1e-5);
    }
}

#[test]
fn an_unconditioned_model_ignores_actions() {
    let spec = tiny(Conditioning::None, Reconstruction::Sequence);
    let model = Network::new(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let frames = values(&[2, spec.context, spec.pixels()], 0.0);
    let without = model.predict_frames(&frames, &ConditioningTensors::none()).unwrap();
    let with = model.predict_frames(&frames, &condition(&spec, 2)).unwrap();
    assert_eq!(bits(&without), bits(&with));
}

#[test]
fn an_action_changes_only_later_frames() {
    let spec = tiny(Conditioning::Action, Reconstruction::Sequence);
    let model = Network::new(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let frames = values(&[1, spec.context, spec.pixels()], 0.0);
    let predicted = |third: f32| {
        let mut actions = vec![0.1f32; spec.horizon * 2];
        actions[2 * 2] = third;
        let actions = Tensor::from_vec(actions, (1, spec.horizon, 2), &Device::Cpu).unwrap();
        let condition = ConditioningTensors {
            actions: Some(actions),
            state: None,
            ..ConditioningTensors::none()
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
    let model = Network::new(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
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
