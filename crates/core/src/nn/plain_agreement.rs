//! Both networks in plain tensor operations against the fused operations: predictions, and gradients of a loss.

use candle_core::{DType, Device, Tensor, Var};

use super::conditioning::ConditioningTensors;
use super::dense::Feedback;
use super::flow::{FlowPrediction, Occupancy};
use super::gradient_check::{noise, values};
use super::loss::Loss;
use super::mask_loss::mask_loss;
use super::network::Network;
use super::options::{Conditioning, PredictorOutput, Reconstruction};
use super::parameters::Parameters;
use super::plain::losses;
use super::spec::{Architecture, ChannelScale, DenseSpec, FlowLayers, FlowSpec, ModelSpec};
use super::ssim_loss::ssim_loss;
use crate::frame::warp::CameraModel;
use crate::types::Seed;

const SIDES: [usize; 2] = [16, 24];
const WINDOWS: usize = 3;

fn channel(name: &str, unit: &str, std: f32) -> ChannelScale {
    ChannelScale {
        name: name.to_owned(),
        unit: unit.to_owned(),
        mean: 0.1,
        std,
    }
}

fn spec(architecture: Architecture, conditioning: Conditioning) -> ModelSpec {
    ModelSpec {
        architecture,
        frame_width_px: SIDES[1] as u32,
        frame_height_px: SIDES[0] as u32,
        context: 4,
        horizon: 3,
        conditioning,
        actions: vec![channel("linear", "m/s", 0.5), channel("angular", "rad/s", 0.9)],
        states: vec![
            channel("x", "m", 1.1),
            channel("y", "m", 0.9),
            channel("heading_cos", "", 0.7),
            channel("heading_sin", "", 0.7),
            channel("speed", "m/s", 0.4),
            channel("turn", "rad/s", 0.8),
        ],
        ..ModelSpec::default()
    }
}

fn flow(layers: FlowLayers, camera: Option<CameraModel>) -> Architecture {
    let layers = FlowLayers {
        channels: 8,
        stem_channels: 6,
        encoder_blocks: 2,
        enlarged_channels: 5,
        fine_channels: 7,
        scene_hidden: 9,
        frames_read: 3,
        ..layers
    };
    Architecture::Flow(FlowSpec { layers, camera })
}

/// Weights of which none are zero.
fn parameters(spec: &ModelSpec) -> Parameters {
    let parameters = Parameters::initialize(spec, Seed(3)).unwrap();
    for (index, (name, var)) in parameters.iter().enumerate() {
        let share = if name.ends_with("weight") { 0.05 } else { 0.02 };
        let changed = (var.as_tensor() + (noise(var.dims(), index as u64) * share).unwrap()).unwrap();
        var.set(&changed).unwrap();
    }
    parameters
}

/// Pictures with edges and slopes, 0 to 1.
fn frames(context: usize) -> Tensor {
    let [height, width] = SIDES;
    let mut pixels = Vec::new();
    for frame in 0..WINDOWS * context {
        for pixel in 0..height * width {
            let (x, y, t) = ((pixel % width) as f32, (pixel / width) as f32, frame as f32);
            let wave = 0.5 + 0.3 * (0.4 * x + 0.3 * t).sin() * (0.5 * y - 0.2 * t).cos();
            pixels.push(wave.clamp(0.0, 1.0));
        }
    }
    Tensor::from_vec(pixels, (WINDOWS, context, height * width), &Device::Cpu).unwrap()
}

fn conditioning(spec: &ModelSpec) -> ConditioningTensors {
    let scaled = |shape: &[usize], seed| (noise(shape, seed) * 0.4).unwrap();
    let states = spec.states.len();
    ConditioningTensors {
        actions: Some(scaled(&[WINDOWS, spec.horizon, spec.actions.len()], 11)),
        state: Some(scaled(&[WINDOWS, states], 12)),
        past_states: Some(scaled(&[WINDOWS, spec.context - 1, states], 13)),
        cameras: Vec::new(),
    }
}

fn largest_difference(a: &Tensor, b: &Tensor) -> f32 {
    assert_eq!(a.dims(), b.dims());
    let pairs = values(a).into_iter().zip(values(b));
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, |most, difference| {
        assert!(difference.is_finite());
        most.max(difference)
    })
}

/// All that a network gives, one after another.
fn outputs(predicted: &FlowPrediction) -> Vec<Tensor> {
    let given = [
        Some(&predicted.frames),
        predicted.scene.as_ref(),
        Some(&predicted.motion),
        predicted.movers.as_ref(),
        predicted.speeds.as_ref(),
    ];
    given.into_iter().flatten().cloned().collect()
}

/// Checks predictions, and the gradients of a weighted sum of all outputs.
fn assert_agreement(spec: &ModelSpec, predict: impl Fn(&Network) -> Vec<Tensor>) {
    let parameters = parameters(spec);
    let detached = [
        Network::detached(spec.clone(), &parameters).unwrap(),
        Network::plain(spec.clone(), &parameters, &[""]).unwrap(),
    ];
    let [fused, plain] = detached.each_ref().map(&predict);
    for (index, (fused, plain)) in fused.iter().zip(&plain).enumerate() {
        let difference = largest_difference(fused, plain);
        assert!(difference < 1e-5, "output {index}: {difference}");
    }
    let trained = [
        Network::new(spec.clone(), &parameters).unwrap(),
        Network::plain(spec.clone(), &parameters, &[]).unwrap(),
    ];
    let [fused, plain] = trained.each_ref().map(|network| {
        let outputs = predict(network);
        let weighted = outputs.iter().enumerate().map(|(index, output)| {
            let weights = noise(output.dims(), 50 + index as u64);
            (output * weights).unwrap().sum_all().unwrap()
        });
        let loss = weighted.reduce(|sum, part| (sum + part).unwrap()).unwrap();
        loss.backward().unwrap()
    });
    let mut with_gradient = 0;
    for (name, var) in parameters.iter() {
        let of = |gradients: &candle_core::backprop::GradStore| {
            let none = || Tensor::zeros(var.dims(), DType::F32, &Device::Cpu).unwrap();
            gradients.get(var).cloned().unwrap_or_else(none)
        };
        let (fused, plain) = (of(&fused), of(&plain));
        let largest = values(&fused)
            .into_iter()
            .fold(0.0f32, |most, value| most.max(value.abs()));
        with_gradient += usize::from(largest > 1e-2);
        let difference = largest_difference(&fused, &plain);
        assert!(
            difference <= 1e-3 * largest.max(1e-2),
            "{name}: {difference} of {largest}"
        );
    }
    let count = parameters.iter().count();
    assert!(
        4 * with_gradient > 3 * count,
        "{with_gradient} of {count} tensors have a gradient"
    );
}

fn assert_flow_agrees(layers: FlowLayers, camera: Option<CameraModel>, conditions: Conditioning) {
    let spec = spec(flow(layers, camera), conditions);
    assert_agreement(&spec, |network| {
        let predicted = network.predict_flow(&frames(spec.context), &conditioning(&spec), spec.horizon);
        outputs(&predicted.unwrap().unwrap())
    });
}

/// Several rollouts of a window, with different actions and cameras.
fn assert_rollouts_agree(architecture: Architecture) {
    let spec = spec(architecture, Conditioning::StateAction);
    let windows = [0, 0, 1, 2, 2];
    let rows = |tensor: Option<Tensor>| {
        let tensor = tensor.unwrap();
        let repeated = tensor
            .index_select(&Tensor::new(&windows, &Device::Cpu).unwrap(), 0)
            .unwrap();
        Some(repeated)
    };
    let known = conditioning(&spec);
    let camera_of = |row: usize| CameraModel {
        tilt_down_rad: 0.1 + 0.05 * row as f32,
        height_m: Some(0.3 + 0.1 * row as f32),
        ..camera()
    };
    let conditioning = ConditioningTensors {
        actions: Some((noise(&[windows.len(), spec.horizon, spec.actions.len()], 17) * 0.4).unwrap()),
        state: rows(known.state),
        past_states: rows(known.past_states),
        cameras: (0..windows.len()).map(camera_of).collect(),
    };
    let parameters = parameters(&spec);
    let [fused, plain] = [
        Network::detached(spec.clone(), &parameters).unwrap(),
        Network::plain(spec.clone(), &parameters, &[""]).unwrap(),
    ]
    .map(|network| {
        let frames = frames(spec.context);
        let codes = network.encode_frames(&frames.flatten(0, 1).unwrap()).unwrap();
        let codes = codes.reshape((WINDOWS, spec.context, ())).unwrap();
        network.predict_rollouts(&codes, &windows, &conditioning).unwrap()
    });
    assert_eq!(fused.dim(0).unwrap(), windows.len());
    assert!(largest_difference(&fused, &plain) < 1e-5);
    let [one, other] = [0, 1].map(|row| fused.get(row).unwrap());
    assert!(
        largest_difference(&one, &other) > 1e-4,
        "the rollouts of a window differ"
    );
}

#[test]
fn several_rollouts_of_a_window() {
    let depth = FlowLayers {
        depth: true,
        ..FlowLayers::default()
    };
    let remembering = FlowLayers { memory: true, ..depth };
    let dense = DenseSpec {
        features: 6,
        hidden: 5,
        ..DenseSpec::default()
    };
    for architecture in [
        flow(depth, Some(camera())),
        flow(remembering, Some(camera())),
        flow(FlowLayers::default(), Some(camera())),
        Architecture::Dense(dense),
    ] {
        assert_rollouts_agree(architecture);
    }
}

/// What stands around the robot in each window, as numbers.
fn assert_occupancy_agrees(layers: FlowLayers) {
    let spec = spec(flow(layers, Some(camera())), Conditioning::StateAction);
    let parameters = parameters(&spec);
    let networks = [
        Network::detached(spec.clone(), &parameters).unwrap(),
        Network::plain(spec.clone(), &parameters, &[""]).unwrap(),
    ];
    let [fused, plain] = networks.map(|network| {
        let found = network.occupancy(&frames(spec.context), &conditioning(&spec));
        found.unwrap().unwrap()
    });
    for (fused, plain) in fused.iter().zip(&plain) {
        assert!(!fused.points.is_empty());
        assert_eq!(fused.points.len(), plain.points.len());
        assert_eq!(
            fused.movers.iter().map(Vec::len).collect::<Vec<_>>(),
            plain.movers.iter().map(Vec::len).collect::<Vec<_>>()
        );
        let numbers = |seen: &Occupancy| {
            let movers = seen.movers.iter().flatten().flatten();
            let all = movers
                .chain(seen.points.as_flattened())
                .chain(&seen.depths_m)
                .chain(&seen.first_depths_m);
            all.copied().collect::<Vec<f32>>()
        };
        for (fused, plain) in numbers(fused).iter().zip(numbers(plain)) {
            assert!((fused - plain).abs() < 1e-4, "{fused} {plain}");
        }
    }
}

fn camera() -> CameraModel {
    CameraModel {
        height_m: Some(0.4),
        ..CameraModel::new(1.1, 0.25).unwrap()
    }
}

#[test]
fn the_form_that_estimates_depth_agrees() {
    let layers = FlowLayers {
        depth: true,
        movers: true,
        ..FlowLayers::default()
    };
    assert_flow_agrees(layers, Some(camera()), Conditioning::StateAction);
    assert_flow_agrees(layers, None, Conditioning::Action);
    assert_occupancy_agrees(layers);
}

/// Inputs of which the first window tells nothing, the second its actions only, and the third everything.
fn half_told(spec: &ModelSpec) -> ConditioningTensors {
    let known = conditioning(spec);
    let hidden = |tensor: Option<Tensor>, windows: usize| {
        let tensor = tensor.unwrap();
        let mut all = values(&tensor);
        let each = all.len() / WINDOWS;
        all[..windows * each].fill(f32::NAN);
        Tensor::from_vec(all, tensor.dims(), &Device::Cpu).ok()
    };
    ConditioningTensors {
        actions: hidden(known.actions, 1),
        state: hidden(known.state, 2),
        past_states: hidden(known.past_states, 2),
        cameras: Vec::new(),
    }
}

#[test]
fn the_form_that_remembers_a_room_agrees() {
    let layers = FlowLayers {
        depth: true,
        speeds: true,
        memory: true,
        ..FlowLayers::default()
    };
    assert_flow_agrees(layers, Some(camera()), Conditioning::StateAction);
    let spec = spec(flow(layers, Some(camera())), Conditioning::StateAction);
    let parameters = parameters(&spec);
    let predict = |network: &Network, conditioning: &ConditioningTensors| {
        let predicted = network.predict_flow(&frames(spec.context), conditioning, spec.horizon);
        predicted.unwrap().unwrap().frames
    };
    let networks = [
        Network::detached(spec.clone(), &parameters).unwrap(),
        Network::plain(spec.clone(), &parameters, &[""]).unwrap(),
    ];
    // Where the pose is not known, the memory counts for nothing: not even what is wrong in it.
    let half = half_told(&spec);
    let [fused, plain] = networks.each_ref().map(|network| predict(network, &half));
    assert!(largest_difference(&fused, &plain) < 1e-5);
    let forgotten = parameters.snapshot().unwrap().into_iter().map(|(name, tensor)| {
        let is_memory = name.starts_with("flow.scene.");
        let tensor = if is_memory { (tensor * 3.0).unwrap() } else { tensor };
        (name, tensor)
    });
    let forgotten = Parameters::from_tensors(&spec, forgotten.collect()).unwrap();
    let other = predict(&Network::detached(spec.clone(), &forgotten).unwrap(), &half);
    let window = |frames: &Tensor, window: usize| frames.get(window).unwrap();
    for untold in [0, 1] {
        assert!(largest_difference(&window(&fused, untold), &window(&other, untold)) < 1e-7);
    }
    assert!(largest_difference(&window(&fused, 2), &window(&other, 2)) > 1e-4);
}

#[test]
fn the_form_that_sees_speeds_agrees() {
    let layers = FlowLayers {
        depth: true,
        movers: true,
        speeds: true,
        ..FlowLayers::default()
    };
    assert_flow_agrees(layers, Some(camera()), Conditioning::StateAction);
    assert_flow_agrees(layers, Some(camera()), Conditioning::None);
    let spec = spec(flow(layers, Some(camera())), Conditioning::StateAction);
    assert_agreement(&spec, |network| {
        let predicted = network.predict_flow(&frames(spec.context), &half_told(&spec), spec.horizon);
        outputs(&predicted.unwrap().unwrap())
    });
    // Inputs that are missing count as not known.
    let parameters = parameters(&spec);
    let network = Network::detached(spec.clone(), &parameters).unwrap();
    let nothing = |tensor: Option<Tensor>| tensor.map(|tensor| (tensor * f64::NAN).unwrap());
    let told = conditioning(&spec);
    let unknown = ConditioningTensors {
        actions: nothing(told.actions),
        state: nothing(told.state),
        ..ConditioningTensors::none()
    };
    let [missing, unknown] = [ConditioningTensors::none(), unknown].map(|inputs| {
        let predicted = network.predict_flow(&frames(spec.context), &inputs, spec.horizon);
        predicted.unwrap().unwrap().frames
    });
    assert_eq!(values(&missing), values(&unknown));
}

#[test]
fn the_form_with_a_learned_room_agrees() {
    assert_flow_agrees(FlowLayers::default(), Some(camera()), Conditioning::StateAction);
}

#[test]
fn the_form_without_a_camera_agrees() {
    assert_flow_agrees(FlowLayers::default(), None, Conditioning::StateAction);
    assert_flow_agrees(FlowLayers::default(), Some(camera()), Conditioning::Action);
}

#[test]
fn the_form_of_a_standing_camera_agrees() {
    assert_flow_agrees(FlowLayers::default(), None, Conditioning::None);
}

#[test]
fn the_recurrent_form_agrees() {
    let layers = FlowLayers {
        recurrent: true,
        ..FlowLayers::default()
    };
    assert_flow_agrees(layers, None, Conditioning::None);
    assert_flow_agrees(layers, Some(camera()), Conditioning::State);
}

#[test]
fn the_dense_network_agrees() {
    for (reconstruction, predictor_output) in [
        (Reconstruction::Sequence, PredictorOutput::Residual),
        (Reconstruction::Stepwise, PredictorOutput::Absolute),
    ] {
        let sizes = DenseSpec {
            features: 12,
            hidden: 10,
            reconstruction,
            predictor_output,
        };
        let spec = spec(Architecture::Dense(sizes), Conditioning::StateAction);
        assert_agreement(&spec, |network| {
            let frames = frames(spec.context);
            let pixels = frames.flatten(0, 1).unwrap();
            let codes = network.encode_frames(&pixels).unwrap();
            let codes = codes.reshape((WINDOWS, spec.context, ())).unwrap();
            let truth = codes.narrow(1, 0, spec.horizon).unwrap().contiguous().unwrap();
            let condition = conditioning(&spec);
            let feedbacks = [Feedback::Prediction, Feedback::TeacherForcing(&truth)];
            let mut outputs = feedbacks
                .map(|feedback| network.predict(&codes, &condition, feedback).unwrap())
                .to_vec();
            outputs.push(network.reconstruct(&codes).unwrap().unwrap());
            outputs.push(network.decode_frames(&outputs[0].flatten(0, 1).unwrap()).unwrap());
            outputs
        });
    }
}

#[test]
fn the_losses_agree() {
    let prediction = Var::from_tensor(&noise(&[2, 3, 12 * 14], 1)).unwrap();
    let x = prediction.as_tensor();
    let target = noise(&[2, 3, 12 * 14], 2);
    let mask = target.gt(0.0).unwrap().to_dtype(DType::F32).unwrap();
    let pairs = [
        (losses::squared(x, &target), Loss::Mse.between(x, &target)),
        (losses::absolute(x, &target), Loss::L1.between(x, &target)),
        (losses::cross_entropy(x, &mask), mask_loss(x, &mask)),
        (losses::dissimilarity(x, &target, 14), ssim_loss(x, &target, 14)),
    ];
    for (plain, fused) in pairs {
        let (plain, fused) = (plain.unwrap(), fused.unwrap());
        assert!(largest_difference(&plain, &fused) < 1e-5);
        let slopes = [plain, fused].map(|loss| loss.backward().unwrap().get(x).unwrap().clone());
        assert!(largest_difference(&slopes[0], &slopes[1]) < 1e-6);
    }
}
