//! The flow network: shapes, costs, independence of the batch, and what it refuses.

use candle_core::{Device, Tensor};
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::nn::{
    Architecture, ChannelScale, Conditioning, ConditioningTensors, DenseSpec, FlowLayers, FlowSpec, ModelSpec, Network,
    NnError, Parameters,
};
use foreframe_core::types::Seed;

use crate::nn_fixtures::{condition, largest_difference, values};

const CAMERA: CameraModel = CameraModel {
    horizontal_fov_rad: 1.0,
    tilt_down_rad: 0.2,
    height_m: None,
};

fn channel(name: &str, unit: &str) -> ChannelScale {
    ChannelScale {
        name: name.to_owned(),
        unit: unit.to_owned(),
        mean: 0.1,
        std: 0.5,
    }
}

/// A small network for frames of 12×8 px.
fn small(conditioning: Conditioning, camera: Option<CameraModel>) -> ModelSpec {
    ModelSpec {
        architecture: Architecture::Flow(FlowSpec {
            layers: FlowLayers {
                channels: 8,
                stem_channels: 6,
                enlarged_channels: 3,
                fine_channels: 5,
                scene_hidden: 8,
                ..FlowLayers::default()
            },
            camera,
        }),
        frame_width_px: 12,
        frame_height_px: 8,
        context: 3,
        horizon: 2,
        conditioning,
        actions: vec![channel("linear", "m/s"), channel("angular", "rad/s")],
        states: vec![
            channel("x", "m"),
            channel("y", "m"),
            channel("heading_cos", ""),
            channel("heading_sin", ""),
            channel("angular", "rad/s"),
        ],
        ..ModelSpec::default()
    }
}

/// The sizes of a flow network, to change them.
fn flow(spec: &mut ModelSpec) -> &mut FlowSpec {
    match &mut spec.architecture {
        Architecture::Flow(flow) => flow,
        _ => panic!("the specification is not that of a flow network"),
    }
}

/// The same in the recurrent form, whose encoder reads one frame more than the context has.
fn recurrent(conditioning: Conditioning) -> ModelSpec {
    let mut spec = small(conditioning, None);
    let flow = flow(&mut spec);
    flow.layers.frames_read = 4;
    flow.layers.recurrent = true;
    spec
}

/// The same in the form that estimates depth.
fn with_depth(conditioning: Conditioning, camera: Option<CameraModel>) -> ModelSpec {
    let mut spec = small(conditioning, camera);
    flow(&mut spec).layers.depth = true;
    spec
}

fn kinds() -> Vec<ModelSpec> {
    let mut kinds = Vec::new();
    for conditioning in [Conditioning::None, Conditioning::Action, Conditioning::StateAction] {
        kinds.extend([None, Some(CAMERA)].map(|camera| small(conditioning, camera)));
    }
    kinds.extend([recurrent(Conditioning::None), recurrent(Conditioning::State)]);
    kinds.push(with_depth(Conditioning::Action, None));
    kinds.push(with_depth(Conditioning::StateAction, Some(CAMERA)));
    kinds
}

fn frames(spec: &ModelSpec, batch: usize) -> Tensor {
    values(&[batch, spec.context, spec.pixels()], 0.3)
        .affine(0.5, 0.5)
        .unwrap()
}

#[test]
fn every_kind_predicts_frames_and_trains_every_tensor() {
    for spec in kinds() {
        let parameters = Parameters::initialize(&spec, Seed(2)).unwrap();
        // Layers that start at zero hide the gradients of those before them.
        for (index, (_, var)) in parameters.iter().enumerate() {
            let noise = (values(var.dims(), index as f32) * 0.05).unwrap();
            var.set(&(var.as_detached_tensor() + noise).unwrap()).unwrap();
        }
        let model = Network::new(spec.clone(), &parameters).unwrap();
        let predicted = model
            .predict_flow(&frames(&spec, 2), &condition(&spec, 2), spec.horizon)
            .unwrap()
            .unwrap();
        let shape = [2, spec.horizon, spec.pixels()];
        assert_eq!(predicted.frames.dims(), shape);
        let has_scene = !spec.flow().unwrap().layers.depth;
        assert_eq!(
            predicted.scene.map(|scene| scene.dims().to_vec()),
            has_scene.then(|| shape.to_vec())
        );
        let squares = predicted.frames.sqr().unwrap().sum_all().unwrap();
        let loss = (squares + predicted.motion.sqr().unwrap().sum_all().unwrap()).unwrap();
        let gradients = loss.backward().unwrap();
        for (name, var) in parameters.iter() {
            let gradient = gradients
                .get(var.as_tensor())
                .unwrap_or_else(|| panic!("{name} has no gradient"));
            let most = gradient.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
            assert!(most.is_finite() && most > 0.0, "{name}: {most}");
        }
    }
}

#[test]
fn the_first_frames_alone_are_those_of_the_whole_horizon() {
    for spec in kinds() {
        let model = Network::detached(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
        let first = |steps: usize| {
            let predicted = model.predict_flow(&frames(&spec, 2), &condition(&spec, 2), steps);
            predicted.unwrap().unwrap().frames
        };
        let (whole, one) = (first(spec.horizon), first(1));
        assert_eq!(one.dims(), [2, 1, spec.pixels()]);
        assert!(largest_difference(&one, &whole.narrow(1, 0, 1).unwrap()) < 1e-6);
    }
}

#[test]
fn a_future_does_not_depend_on_those_beside_it() {
    for spec in kinds() {
        let model = Network::detached(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
        let windows: Vec<u32> = (0..40).map(|row| row % 2).collect();
        let (seen, told) = (frames(&spec, 2), condition(&spec, windows.len()));
        let together = model.predict_rollouts(&seen, &windows, &told).unwrap();
        for row in [0, 17, 39] {
            let row_of = |tensor: &Tensor| tensor.narrow(0, row, 1).unwrap();
            let told = ConditioningTensors {
                actions: told.actions.as_ref().map(row_of),
                state: told.state.as_ref().map(row_of),
                ..ConditioningTensors::none()
            };
            let window = seen.narrow(0, windows[row] as usize, 1).unwrap();
            let alone = model.predict_rollouts(&window, &[0], &told).unwrap();
            assert!(largest_difference(&alone, &row_of(&together)) < 1e-6);
        }
    }
}

#[test]
fn depth_is_estimated_from_how_the_camera_moved_not_from_where_it_stands() {
    let spec = with_depth(Conditioning::StateAction, Some(CAMERA));
    let parameters = Parameters::initialize(&spec, Seed(2)).unwrap();
    let depth = parameters.get("flow.depth.output.weight").unwrap();
    depth.set(&values(depth.dims(), 3.0)).unwrap();
    let model = Network::detached(spec.clone(), &parameters).unwrap();
    let actions = Tensor::new(&[[[0.5f32, 0.1], [0.5, 0.1]]], &Device::Cpu).unwrap();
    // Standing at (x, y), and before that further back by `behind` metres a frame.
    let predicted = |x: f32, y: f32, behind: f32| {
        let state = |back: f32| [x - behind * back, y, 1.0, 0.0, 0.0];
        let told = ConditioningTensors {
            actions: Some(actions.clone()),
            state: Some(Tensor::new(&[state(0.0)], &Device::Cpu).unwrap()),
            past_states: Some(Tensor::new(&[[state(2.0), state(1.0)]], &Device::Cpu).unwrap()),
            ..ConditioningTensors::none()
        };
        model.predict_rollouts(&frames(&spec, 1), &[0], &told).unwrap()
    };
    assert!(largest_difference(&predicted(0.0, 0.0, 0.1), &predicted(3.0, -2.0, 0.1)) < 1e-4);
    assert!(largest_difference(&predicted(0.0, 0.0, 0.1), &predicted(0.0, 0.0, 0.0)) > 1e-4);
    // States that are not known count as absent.
    let unknown = ConditioningTensors {
        actions: Some(actions.clone()),
        state: Some(Tensor::new(&[[0.0f32, 0.0, 1.0, 0.0, 0.0]], &Device::Cpu).unwrap()),
        past_states: Some(Tensor::full(f32::NAN, (1, 2, 5), &Device::Cpu).unwrap()),
        ..ConditioningTensors::none()
    };
    let unknown = model.predict_rollouts(&frames(&spec, 1), &[0], &unknown).unwrap();
    assert!(largest_difference(&unknown, &predicted(0.0, 0.0, 0.0)) < 1e-6);
}

#[test]
fn a_darker_picture_gives_as_much_darker_a_prediction() {
    let spec = with_depth(Conditioning::StateAction, Some(CAMERA));
    let model = Network::detached(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let (seen, told) = (frames(&spec, 1), condition(&spec, 1));
    let darker = (&seen * 0.7).unwrap();
    let of = |seen: &Tensor| model.predict_rollouts(seen, &[0], &told).unwrap();
    assert!(largest_difference(&of(&darker), &(of(&seen) * 0.7).unwrap()) < 1e-5);
}

#[test]
fn an_untrained_network_turns_the_last_frame_with_the_camera() {
    let spec = small(Conditioning::StateAction, Some(CAMERA));
    let model = Network::detached(spec.clone(), &Parameters::initialize(&spec, Seed(2)).unwrap()).unwrap();
    let mut told = condition(&spec, 1);
    told.actions = Some(Tensor::new(&[[[0.0f32, 0.5], [0.0, 0.5]]], &Device::Cpu).unwrap());
    told.state = Some(Tensor::new(&[[0.1f32, 0.1, 1.0, 0.0, 0.5]], &Device::Cpu).unwrap());
    let motion = model
        .predict_flow(&frames(&spec, 1), &told, spec.horizon)
        .unwrap()
        .unwrap()
        .motion;
    let yaw: Vec<f32> = motion
        .narrow(2, 0, 1)
        .unwrap()
        .flatten_all()
        .unwrap()
        .to_vec1()
        .unwrap();
    assert!((yaw[0] - 0.1).abs() < 1e-6 && (yaw[1] - 0.2).abs() < 1e-6, "{yaw:?}");
}

#[test]
fn the_cost_is_that_of_its_layers() {
    let spec = small(Conditioning::None, None);
    let parameters = Parameters::initialize(&spec, Seed(2)).unwrap();
    assert_eq!(parameters.count(), spec.parameter_count());
    // Stem 24 places; halving, four encoder layers 6; per step: mix, two layers, enlarge at 6, fine and head at 24.
    let once = 24 * 9 * 18 * 6 + 6 * 9 * 6 * 8 + 4 * 6 * 9 * 8 * 8;
    let each = 6 * (8 + 32) * 8 + 2 * 6 * 9 * 8 * 8 + 6 * 8 * 12 + 24 * 9 * (3 + 5 + 12) * 5 + 24 * 9 * 5 * 32;
    let modulation = 2 * 64 + 64 * 32;
    assert_eq!(
        spec.multiply_adds_per_frame(),
        (once as u64).div_ceil(2) + each + modulation
    );
}

#[test]
fn the_recurrent_form_reads_every_frame_of_its_context() {
    let spec = recurrent(Conditioning::None);
    let parameters = Parameters::initialize(&spec, Seed(2)).unwrap();
    // The head starts near zero; make what the encoder sees visible.
    for (index, (_, var)) in parameters.iter().enumerate() {
        let noise = (values(var.dims(), index as f32) * 0.1).unwrap();
        var.set(&(var.as_detached_tensor() + noise).unwrap()).unwrap();
    }
    let model = Network::detached(spec.clone(), &parameters).unwrap();
    let predict = |frames: &Tensor| model.predict_frames(frames, &condition(&spec, 1)).unwrap();
    let seen = frames(&spec, 1);
    for frame in 0..spec.context {
        let mut parts: Vec<Tensor> = (0..spec.context).map(|at| seen.narrow(1, at, 1).unwrap()).collect();
        parts[frame] = (&parts[frame] * 0.5).unwrap();
        let changed = Tensor::cat(&parts, 1).unwrap();
        assert!(
            largest_difference(&predict(&seen), &predict(&changed)) > 1e-5,
            "frame {frame}"
        );
    }
}

#[test]
fn what_does_not_suit_the_network_is_refused_in_one_sentence() {
    let refused = |change: &dyn Fn(&mut ModelSpec)| {
        let mut spec = small(Conditioning::None, None);
        change(&mut spec);
        spec.validate().unwrap_err().to_string()
    };
    assert_eq!(
        refused(&|spec| spec.frame_width_px = 10),
        "model specification: frames are 10×8 px; each side must be a multiple of 4 from 4 to 256"
    );
    let error = recurrent(Conditioning::Action).validate().unwrap_err().to_string();
    assert!(error.contains("the recurrent form takes no actions"), "{error}");
    let camera = CameraModel {
        horizontal_fov_rad: 4.0,
        ..CAMERA
    };
    assert!(refused(&|spec| flow(spec).camera = Some(camera)).starts_with("model specification: the camera model has"));
    let moving = small(Conditioning::None, None);
    let dense = ModelSpec {
        architecture: Architecture::Dense(DenseSpec::default()),
        ..moving.clone()
    };
    let weights = Parameters::initialize(&moving, Seed(1)).unwrap().snapshot().unwrap();
    let error = Parameters::from_tensors(&dense, weights).unwrap_err();
    assert!(matches!(error, NnError::OtherArchitecture { .. }), "{error}");
}

#[test]
fn a_dense_specification_is_written_as_before() {
    let text = serde_json::to_string(&ModelSpec::default()).unwrap();
    assert!(
        !text.contains("architecture") && !text.contains("flow") && !text.contains("camera"),
        "{text}"
    );
}

#[test]
fn a_flow_specification_is_written_without_the_fields_of_the_dense_network() {
    let spec = small(Conditioning::StateAction, Some(CAMERA));
    let text = serde_json::to_string(&spec).unwrap();
    assert!(
        !text.contains("features") && !text.contains("\"hidden\"") && !text.contains("reconstruction"),
        "{text}"
    );
    assert_eq!(serde_json::from_str::<ModelSpec>(&text).unwrap(), spec);
    // Manifests written before had them; they are ignored.
    let mut older: serde_json::Value = serde_json::from_str(&text).unwrap();
    older["features"] = 128.into();
    older["hidden"] = 256.into();
    older["reconstruction"] = "sequence".into();
    assert_eq!(serde_json::from_value::<ModelSpec>(older.clone()).unwrap(), spec);
    // A dense specification must have them.
    older["architecture"] = "dense".into();
    older["features"].take();
    let error = serde_json::from_value::<ModelSpec>(older).unwrap_err().to_string();
    assert_eq!(error, "missing field `features`");
}

#[test]
fn every_size_of_the_layers_has_its_least_value() {
    let refused = |change: &dyn Fn(&mut FlowLayers)| {
        let mut spec = small(Conditioning::None, None);
        change(&mut flow(&mut spec).layers);
        spec.validate().map_err(|error| error.to_string())
    };
    assert_eq!(refused(&|layers| layers.encoder_blocks = 0), Ok(()));
    assert_eq!(refused(&|layers| layers.decoder_blocks = 0), Ok(()));
    assert_eq!(
        refused(&|layers| layers.channels = 0),
        Err("model specification: flow.channels is 0; it must be 1 to 512".to_owned())
    );
    assert_eq!(
        refused(&|layers| layers.encoder_blocks = 17),
        Err("model specification: flow.encoder_blocks is 17; it must be 0 to 16".to_owned())
    );
}
