//! Networks that see how fast the camera drives: trained on the simulator, they do without states and actions.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use candle_core::{Device, Tensor};
use foreframe_core::frame::Frame;
use foreframe_core::nn::ConditioningTensors;
use foreframe_core::registry::{self, StoredWeights};
use foreframe_core::serving::Session;
use foreframe_core::types::{Channel, RobotState};
use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData, Lacking, Window};
use foreframe_train::evaluation::window_errors;
use foreframe_train::training::TrainConfig;

use crate::movers::train;
use crate::process::{output, text};

const SIDE: usize = 16;
const FRAMES: usize = 14;
const PERIOD_S: f64 = 0.2;
/// Radians that a pixel spans, about, for the camera of the data set.
const PIXEL_RAD: f32 = 1.0 / SIDE as f32;

/// A camera that turns at a constant rate before stripes; the speeds are in states and actions, unless the recording is `plain`.
fn turning(name: &str, episodes: usize, plain: bool) -> Dataset {
    let data = (0..episodes).map(|episode| {
        let rate = [-0.6f32, -0.3, 0.3, 0.6, 0.45, -0.45][episode % 6];
        let shade = |frame: usize, pixel: usize| {
            // A turn to the left moves the picture to the right.
            let shift = rate * PERIOD_S as f32 * frame as f32 / PIXEL_RAD;
            let at = (pixel % SIDE) as f32 - shift + 3.7 * episode as f32;
            (128.0 + 60.0 * (at * 0.7).sin() + 40.0 * (at * 0.31 + (pixel / SIDE) as f32 * 0.2).cos()) as u8
        };
        let speeds = if plain { vec![] } else { [0.0, rate].repeat(FRAMES) };
        EpisodeData {
            pixels: (0..FRAMES)
                .flat_map(|frame| (0..SIDE * SIDE).map(move |pixel| shade(frame, pixel)))
                .collect(),
            actions: speeds.clone(),
            states: speeds,
            timestamps_s: (0..FRAMES).map(|frame| frame as f64 * PERIOD_S).collect(),
            ..EpisodeData::default()
        }
    });
    let channels = || {
        if plain {
            Vec::new()
        } else {
            vec![Channel::new("linear", "m/s"), Channel::new("angular", "rad/s")]
        }
    };
    let info = DatasetInfo {
        name: name.to_owned(),
        frame_width_px: SIDE as u32,
        frame_height_px: SIDE as u32,
        frame_period_s: PERIOD_S,
        action_channels: channels(),
        state_channels: channels(),
        camera: Some(foreframe_core::frame::warp::CameraModel::new(1.0, 0.0).unwrap()),
        ..DatasetInfo::default()
    };
    Dataset::from_episodes(info, data.collect()).unwrap()
}

fn config(settings: &[&str]) -> TrainConfig {
    let small = [
        "name=turning",
        "data.validation_windows=8",
        "data.hidden=0.6",
        "sequence.steps=250",
        "sequence.batch_size=8",
        "sequence.learning_rate=0.004",
        "sequence.speeds_weight=0.1",
        "model.context=3",
        "model.horizon=2",
        "model.flow={ channels = 12, stem_channels = 8, enlarged_channels = 4, fine_channels = 6, frames_read = 3, \
         depth = true, speeds = true }",
        "run.validate_every_steps=250",
        "run.checkpoint_every_steps=250",
        "run.warmup_steps=10",
    ];
    let settings = small.iter().chain(settings).map(|&setting| setting.to_owned());
    TrainConfig::layered("rooms", None, &settings.collect::<Vec<_>>()).unwrap()
}

#[test]
fn a_network_sees_how_fast_the_camera_turns() {
    let (dataset, dir) = (turning("turning", 40, false), tempfile::tempdir().unwrap());
    let run_dir = dir.path().join("run");
    train(&config(&[]), &dataset, &run_dir, None).unwrap();
    let model = registry::load(&run_dir.join("model")).unwrap();
    let spec = model.spec();
    let context = |episode: usize| -> Vec<f32> {
        let first = dataset.episodes()[episode].first_frame;
        let frames = first..first + spec.context;
        frames
            .flat_map(|frame| spec.preprocess.forward(&dataset.frame(frame).unwrap()))
            .collect()
    };
    let seen: Vec<f32> = (0..6).flat_map(context).collect();
    let frames = Tensor::from_vec(seen, (6, spec.context, spec.pixels()), &Device::Cpu).unwrap();
    let predicted = model
        .network
        .predict_flow(&frames, &ConditioningTensors::none(), spec.horizon)
        .unwrap()
        .unwrap();
    let speeds = predicted.speeds.unwrap().to_vec2::<f32>().unwrap();
    for (episode, speeds) in speeds.iter().enumerate() {
        let truth = dataset.state(dataset.episodes()[episode].first_frame)[1];
        assert!((speeds[1] - truth).abs() < 0.2, "{speeds:?}, not {truth}");
    }
    // The same pictures without states and actions are predicted nearly as well, and far better than by their last frame.
    let windows =
        foreframe_train::evaluation::windows_of(&model, &dataset, foreframe_data::dataset::Split::Test).unwrap();
    let mean = |dataset: &Dataset| {
        let errors = window_errors(&model, dataset, &windows, spec.horizon, &AtomicBool::new(false)).unwrap();
        errors.iter().sum::<f64>() / errors.len() as f64
    };
    let (known, unknown) = (mean(&dataset), mean(&turning("plain", 40, true)));
    assert!(
        unknown < 2.0 * known + 5e-4,
        "{unknown}, {known} with states and actions"
    );
    let copied = |window: &Window| -> f64 {
        let last = dataset
            .pixels(window.first_frame + spec.context - 1)
            .unwrap()
            .into_owned();
        let next = dataset.pixels(window.first_frame + spec.context).unwrap().into_owned();
        let squares = last
            .iter()
            .zip(&next)
            .map(|(a, b)| ((f64::from(*a) - f64::from(*b)) / 255.0).powi(2));
        squares.sum::<f64>() / last.len() as f64
    };
    let copied = windows.iter().map(copied).sum::<f64>() / windows.len() as f64;
    assert!(
        unknown < 0.5 * copied,
        "{unknown}, {copied} of the last frame, one step ahead"
    );
}

#[test]
fn data_sets_without_states_join_others_where_the_network_needs_none() {
    let (first, second) = (turning("turning", 20, false), turning("plain", 12, true));
    let weighted = || vec![(first.clone(), 1.0), (second.clone(), 1.0)];
    let error = Dataset::join(weighted(), Lacking::Refused).unwrap_err().to_string();
    assert!(error.contains("lacks the action channel linear"), "{error}");
    let joined = Dataset::join(weighted(), config(&[]).lacking()).unwrap();
    let offset = first.info().frame_count;
    assert!(
        joined
            .action(offset)
            .iter()
            .chain(joined.state(offset))
            .all(|value| value.is_nan())
    );
    assert_eq!(joined.action(3), first.action(3));

    let dir = tempfile::tempdir().unwrap();
    train(&config(&["sequence.steps=4"]), &joined, &dir.path().join("run"), None).unwrap();
    let start = registry::load_weights(&dir.path().join("run/model")).unwrap();
    assert!(
        start
            .manifest
            .spec
            .states
            .iter()
            .all(|channel| channel.mean.is_finite())
    );

    // A recording without channels: what reads them is left out, and the rows of the others stay.
    let settings = [
        "sequence.steps=1",
        "model.conditioning=none",
        "data.hidden=0",
        "run.warmup_steps=100",
    ];
    train(&config(&settings), &second, &dir.path().join("none"), Some(&start)).unwrap();
    let tuned = registry::load_weights(&dir.path().join("none/model")).unwrap();
    assert!(tuned.parameters.get("flow.motion.inputs.weight").is_none());
    let rows = |weights: &StoredWeights| {
        let tensor = weights.parameters.get("flow.modulation.inputs.weight").unwrap();
        tensor.as_tensor().to_vec2::<f32>().unwrap()
    };
    let (before, after) = (rows(&start), rows(&tuned));
    // Two states and two actions of two steps went.
    assert_eq!(before.len(), after.len() + 2 + 2 * 2);
    for (before, after) in before[6..].iter().zip(&after) {
        let difference = before.iter().zip(after).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(difference < 0.01, "{difference}");
    }
}

#[test]
fn nothing_is_hidden_from_a_network_that_cannot_see_speeds() {
    let settings = ["data.hidden=0.5".to_owned()];
    let error = TrainConfig::layered("moving-flow", None, &settings)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("data.hidden is 0.5") && error.contains("model.flow.speeds"),
        "{error}"
    );
}

#[test]
fn the_shipped_rooms_predicts_frames_of_which_nothing_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let project = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (models, frames) = (project.join("models"), project.join("examples/frames"));
    let arguments = |model: &'static str| {
        let of_model = ["predict", "--model", model, "--models-dir", models.to_str().unwrap()];
        [
            &of_model[..],
            &["--frames", frames.to_str().unwrap(), "--at", "9", "--out", model],
        ]
        .concat()
    };
    let predicted = output(dir.path(), &arguments("rooms"));
    assert!(predicted.status.success(), "{}", text(&predicted.stderr));
    assert!(dir.path().join("rooms/predicted-5.png").exists());
    let refused = output(dir.path(), &arguments("moving-flow"));
    assert!(
        text(&refused.stderr).contains("--actions is missing"),
        "{}",
        text(&refused.stderr)
    );
    // Ways of plans start as commanded where no state tells how fast it drives.
    let model = registry::load(&models.join("rooms")).unwrap();
    let ways = model
        .network
        .commanded_motion(&[], &[0.3, 0.0].repeat(5), 5)
        .unwrap()
        .unwrap();
    assert!((ways[4][1] - 0.3).abs() < 1e-3, "{ways:?}");
}

#[test]
fn a_frame_after_one_without_a_state_is_predicted_as_if_only_its_own_were_known() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    let model = Arc::new(registry::load(&models.join("rooms")).unwrap());
    let state = |index: usize| RobotState::try_from(vec![0.1 * index as f32, 0.0, 1.0, 0.0, 0.5, 0.0]).unwrap();
    let predicted = |has_state: &dyn Fn(usize) -> bool| {
        let mut session = Session::new(Arc::clone(&model));
        let mut predicted = None;
        for index in 0..8 {
            let state = Some(state(index)).filter(|_| has_state(index));
            predicted = session.step(wavy_frame(index), state.as_ref(), None).unwrap();
        }
        predicted.unwrap().frames
    };
    assert_eq!(predicted(&|index| index != 6), predicted(&|index| index == 7));
    assert_ne!(predicted(&|_| true), predicted(&|index| index == 7));
}

/// A frame of waves, which wander to the left.
fn wavy_frame(index: usize) -> Frame {
    let pixel = |at: usize| (100.0 + 80.0 * ((at % 64 + 3 * index) as f32 * 0.4).sin()) as u8;
    Frame::new(64, 64, (0..64 * 64).map(pixel).collect()).unwrap()
}

#[test]
fn a_session_continues_elsewhere_without_states_and_forgets_those_before_a_gap() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    let model = Arc::new(registry::load(&models.join("rooms")).unwrap());
    let mut session = Session::new(Arc::clone(&model));
    let mut predicted = None;
    for index in 0..5 {
        predicted = session.step(wavy_frame(index), None, None).unwrap();
    }
    assert_eq!(predicted.unwrap().frames.len(), 5);
    let mut again = Session::restore(model, session.snapshot()).unwrap();
    let next = [
        session.step(wavy_frame(5), None, None),
        again.step(wavy_frame(5), None, None),
    ]
    .map(Result::unwrap);
    let [here, elsewhere] = next.map(|rollout| rollout.expect("a session without a prediction is a bug"));
    assert_eq!((here.frames, here.novelty), (elsewhere.frames, elsewhere.novelty));
    // Only here, the frame is compared with what was predicted of it.
    assert_ne!(here.errors, elsewhere.errors);

    let state = RobotState::try_from(vec![0.0, 0.0, 1.0, 0.0, 0.2, 0.0]).unwrap();
    for index in 6..9 {
        session.step(wavy_frame(index), Some(&state), None).unwrap();
    }
    assert_eq!(session.snapshot().past_states.len(), 2);
    session.step(wavy_frame(9), None, None).unwrap();
    session.step(wavy_frame(10), Some(&state), None).unwrap();
    assert!(session.snapshot().past_states.is_empty());
}
