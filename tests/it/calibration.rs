//! Expected errors, novelty, warnings and other numbers of steps: from the calibration to the answers.

use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use foreframe::server::protocol::{ClientMessage, Codec, FrameMessage, ServerMessage};
use foreframe::server::{ImageBytes, ServerConfig};
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::{self, Model};
use foreframe_core::serving::Session;
use foreframe_core::serving::{self, PredictionInput};
use foreframe_core::types::{Action, RobotState};
use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData};
use foreframe_train::evaluation::{self, EvaluateConfig};
use serde_json::{Value, json};

use crate::client::{Client, SessionHandle, numbered_frame};
use crate::fixtures::{self, moving_squares};
use crate::process::{output, text};
use crate::service::{HORIZON, TIMEOUT, app, context, get, png, post, run, start, with_data};

const SIDE: u32 = 16;

fn spec() -> ModelSpec {
    ModelSpec {
        context: 3,
        horizon: 2,
        ..fixtures::squares_spec(SIDE)
    }
}

/// An untrained model below `dir/models`, calibrated on the squares.
fn calibrated(dir: &std::path::Path, dataset: &Dataset) -> Model {
    let model_dir = dir.join("models/squares");
    fixtures::model(&model_dir, "squares", spec(), fixtures::stamp(dataset));
    evaluation::calibrate_trained(&model_dir, dataset, &false.into()).unwrap();
    registry::load(&model_dir).unwrap()
}

fn input(dataset: &Dataset, speed: f32, steps: Option<usize>) -> PredictionInput {
    let frame = |index| dataset.frame(index).unwrap();
    PredictionInput {
        frames: (0..3).map(frame).collect(),
        state: RobotState::try_from(vec![0.5]).ok(),
        actions: vec![Action::try_from(vec![speed]).unwrap()],
        steps,
        ..PredictionInput::default()
    }
}

/// Frames of noise.
fn noise() -> Dataset {
    let pixels = (0..20 * SIDE * SIDE)
        .map(|at| (at.wrapping_mul(2_654_435_761) >> 13) as u8)
        .collect();
    let data = EpisodeData {
        pixels,
        timestamps_s: (0..20).map(|frame| f64::from(frame) * 0.2).collect(),
        ..EpisodeData::default()
    };
    let info = DatasetInfo {
        name: "noise".to_owned(),
        frame_width_px: SIDE,
        frame_height_px: SIDE,
        frame_period_s: 0.2,
        ..DatasetInfo::default()
    };
    Dataset::from_episodes(info, vec![data]).unwrap()
}

#[test]
fn a_calibrated_model_tells_what_to_expect() {
    let (dir, dataset) = (tempfile::tempdir().unwrap(), moving_squares(40, SIDE, 0.2));
    let model = calibrated(dir.path(), &dataset);
    let known = input(&dataset, 1.0, None);
    let rollout = serving::predict(&model, &[&known]).unwrap().remove(0);
    assert_eq!(rollout.errors.len(), 2);
    for error in &rollout.errors {
        assert!(0.0 < error.low && error.low <= error.mse && error.mse <= error.high && error.high <= 1.0);
    }
    assert!(rollout.novelty.is_some());
    let mut strange = known.clone();
    strange.frames = (0..3).map(|index| noise().frame(index).unwrap()).collect();
    assert_eq!(serving::predict(&model, &[&strange]).unwrap()[0].novelty, Some(1.0));
}

#[test]
fn the_report_has_coverage_and_tells_other_data_apart() {
    let (dir, dataset) = (tempfile::tempdir().unwrap(), moving_squares(60, SIDE, 0.2));
    let model = calibrated(dir.path(), &dataset);
    let other = noise();
    let config = EvaluateConfig {
        bootstrap_samples: 100,
        novel: vec![&other],
        ..EvaluateConfig::default()
    };
    let report = evaluation::run(&model, &dataset, &config, &|_| {}).unwrap();
    let scores = report.scores("test").unwrap().uncertainty.as_ref().unwrap();
    assert!(scores.coverage.mean > 0.6, "{scores:?}");
    assert_eq!(report.novelty[0].dataset, "noise");
    assert!(report.novelty[0].auroc > 0.95, "{:?}", report.novelty);
    let text = report.to_markdown();
    assert!(
        text.contains("coverage of the 90 % band") && text.contains("| noise | 18 | "),
        "{text}"
    );
}

#[test]
fn a_session_expects_the_same_as_a_request() {
    let (dir, dataset) = (tempfile::tempdir().unwrap(), moving_squares(40, SIDE, 0.2));
    let model = calibrated(dir.path(), &dataset);
    let known = input(&dataset, 1.0, None);
    let held = vec![known.actions[0].clone(); 2];
    let (mut session, mut last) = (Session::new(Arc::new(model.clone())), None);
    for frame in known.frames.clone() {
        last = session.step(frame, known.state.as_ref(), Some(&held)).unwrap();
    }
    let (stepped, whole) = (last.unwrap(), serving::predict(&model, &[&known]).unwrap().remove(0));
    assert_eq!(stepped.frames, whole.frames);
    for (stepped, whole) in stepped.errors.iter().zip(&whole.errors) {
        assert!((stepped.mse / whole.mse - 1.0).abs() < 1e-3, "{stepped:?} {whole:?}");
    }
    assert!((stepped.novelty.unwrap() - whole.novelty.unwrap()).abs() < 0.01);
}

#[tokio::test]
async fn an_imported_session_has_the_bands_of_the_exported_one() {
    let (dir, dataset) = (tempfile::tempdir().unwrap(), moving_squares(40, SIDE, 0.2));
    let model = calibrated(dir.path(), &dataset);
    let app = start(with_data(dir.path(), ServerConfig::default()), vec![model]);
    let server = run(app.clone()).await;
    // The bands that a session gives for these frames of the first episode.
    let bands = async |session: &SessionHandle, frames: Range<u64>| {
        let path = session.path("/stream");
        let mut client = Client::connect(server.address, &path, Codec::Json).await.unwrap();
        let mut bands = Vec::new();
        for seq in frames {
            let frame = FrameMessage {
                image: ImageBytes(dataset.frame(seq as usize).unwrap().pixels().to_vec()),
                action: Some(vec![1.0]),
                state: Some(vec![0.5]),
                ..numbered_frame(seq)
            };
            if let ServerMessage::Prediction { mse_band_90, .. } = client.ask(&ClientMessage::Frame(frame)).await {
                bands.push(mse_band_90);
            }
        }
        bands
    };
    let exported = SessionHandle::open(&app, &json!({"model": "squares"})).await;
    let before = bands(&exported, 0..6).await;
    let mut state = get(&app, &exported.path("/state")).await.json();
    let imported = async |state: &Value| SessionHandle::open(&app, &json!({"state": state})).await;
    // The last frame is predicted again, then the next one.
    let after = bands(&imported(&state).await, 5..7).await;
    assert_eq!(after[0], before[3]);
    assert_eq!(bands(&imported(&state).await, 5..7).await, after);
    state["snapshot"]
        .as_object_mut()
        .unwrap()
        .remove("past_errors")
        .unwrap();
    let without = bands(&imported(&state).await, 5..7).await;
    assert!(
        after[0] != without[0] && after[1] != without[1],
        "{after:?} {without:?}"
    );
    server.stop().await;
}

#[tokio::test]
async fn answers_carry_expected_errors_and_warnings() {
    let (dir, dataset) = (tempfile::tempdir().unwrap(), moving_squares(40, SIDE, 0.2));
    let model = calibrated(dir.path(), &dataset);
    let app = start(with_data(dir.path(), ServerConfig::default()), vec![model]);
    let frames: Vec<String> = input(&dataset, 1.0, None).frames.iter().map(png).collect();
    let request = json!({"frames": frames, "state": [0.5], "actions": [[1.0]]});
    let answer = post(&app, "/v1/models/squares/predict", &request).await.json();
    assert_eq!(answer["expected_mse"].as_array().unwrap().len(), 2);
    assert_eq!(answer["mse_band_90"][1].as_array().unwrap().len(), 2);
    assert!(answer["novelty"].is_number());
    assert_eq!(
        (&answer["warnings"], &answer["beyond_training"]),
        (&Value::Null, &Value::Null)
    );

    let plans = json!([[[0.5], [9.0]], [[-4.0], [1.0]]]);
    let request = json!({"frames": frames, "state": [0.75], "plans": plans});
    let answer = post(&app, "/v1/models/squares/rollouts", &request).await.json();
    assert_eq!(answer["expected_mse"][1].as_array().unwrap().len(), 2);
    let expected = [
        "state phase is 0.75; in training it was 0.5 to 0.5",
        "action speed is 9 px/frame; in training it was 0 to 2 px/frame",
    ];
    assert_eq!(answer["warnings"], json!(expected));

    let described = get(&app, "/v1/models/squares").await.json();
    assert_eq!(described["action_bounds"], json!([{"low": 0.0, "high": 2.0}]));
    assert_eq!(described["state_bounds"], json!([{"low": 0.5, "high": 0.5}]));
}

#[tokio::test]
async fn fewer_and_more_steps_than_the_horizon() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let ask = |steps: usize| json!({"frames": context(), "state": [0.5], "actions": [[0.5, 0.0]], "steps": steps});
    let whole = post(&app, "/v1/models/moving/predict", &ask(HORIZON)).await.json();
    let fewer = post(&app, "/v1/models/moving/predict", &ask(1)).await.json();
    assert_eq!(fewer["frames"], json!([whole["frames"][0]]));
    let more = post(&app, "/v1/models/moving/predict", &ask(5)).await.json();
    assert_eq!(more["beyond_training"], json!([false, false, true, true, true]));
    assert_eq!(
        more["frames"].as_array().unwrap()[..2],
        whole["frames"].as_array().unwrap()[..]
    );
    for steps in [0, 51] {
        let refused = post(&app, "/v1/models/moving/predict", &ask(steps)).await;
        assert_eq!(
            refused.detail(422),
            format!("steps is {steps}; this server predicts 1 to 50")
        );
    }
    let rollouts = json!({"frames": context(), "state": [0.5], "plans": [[[0.5, 0.0]]], "steps": 1});
    let answer = post(&app, "/v1/models/moving/rollouts", &rollouts).await.json();
    assert_eq!(answer["rollouts"][0].as_array().unwrap().len(), 1);
}

#[tokio::test]
async fn other_units_than_the_models_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let units = json!({"actions": ["km/h", "rad/s"]});
    let request = json!({"frames": context(), "state": [0.5], "actions": [[0.5, 0.0]], "units": units});
    let refused = post(&app, "/v1/models/moving/predict", &request).await;
    assert_eq!(
        refused.detail(422),
        "units.actions is [km/h, rad/s]; model \"moving\" takes [m/s, rad/s]"
    );
}

/// Runs `predict --model moving-flow` on a directory of frames with the actions of the example; returns what it prints.
fn predict_frames(frames: &std::path::Path, more: &[&str]) -> String {
    let dir = tempfile::tempdir().unwrap();
    let actions = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/frames/actions.json");
    let frames = frames.to_str().unwrap();
    let arguments = [
        "predict",
        "--model",
        "moving-flow",
        "--frames",
        frames,
        "--actions",
        actions,
        "--out",
        "out",
    ];
    let predicted = output(dir.path(), &[&arguments, more].concat());
    assert!(predicted.status.success(), "{predicted:?}");
    text(&predicted.stdout)
}

#[test]
fn strange_frames_get_a_warning_and_no_band() {
    let dir = tempfile::tempdir().unwrap();
    for index in 0..12_u32 {
        let pixels = (0..64 * 64).map(|at: u32| ((at + index * 7).wrapping_mul(2_654_435_761) >> 13) as u8);
        let frame = foreframe_core::frame::Frame::new(64, 64, pixels.collect()).unwrap();
        let png = foreframe_core::frame::codec::encode_png(&frame).unwrap();
        std::fs::write(dir.path().join(format!("{index}.png")), png).unwrap();
    }
    let printed = predict_frames(dir.path(), &["--at", "9"]);
    let lines: Vec<&str> = printed.lines().collect();
    let first_error = lines.iter().position(|line| line.starts_with("t+")).unwrap();
    let warning = lines[..first_error]
        .iter()
        .any(|line| line.starts_with("warning: novelty 1.00: the frames, the state or the actions are unlike"));
    assert!(warning && !printed.contains("90 % between"), "{printed}");
    // Two true frames follow.
    assert_eq!(printed.matches(": actual MSE ").count(), 2, "{printed}");
}

#[test]
fn the_actual_errors_stand_beside_the_expected_ones() {
    let examples = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/frames");
    let printed = predict_frames(examples.as_ref(), &["--at", "9"]);
    let both = |line: &str| line.contains("expected MSE ") && line.contains("; actual MSE ");
    assert_eq!(printed.lines().filter(|line| both(line)).count(), 5, "{printed}");
}

#[test]
fn a_copied_program_predicts_in_an_empty_directory() {
    let (dir, frames) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let listed = output(dir.path(), &["models", "list"]);
    assert!(text(&listed.stdout).starts_with("moving-flow@1"), "{listed:?}");
    let examples = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/frames");
    let out = frames.path().join("out");
    let arguments = [
        "predict",
        "--model",
        "moving-flow",
        "--frames",
        examples,
        "--actions",
        &format!("{examples}/actions.json"),
        "--at",
        "4",
        "--steps",
        "7",
        "--out",
        out.to_str().unwrap(),
    ];
    let predicted = output(dir.path(), &arguments);
    assert!(predicted.status.success(), "{predicted:?}");
    assert!(out.join("predicted-7.png").is_file());
    assert!(text(&predicted.stdout).contains("from t+6 on, the frames are beyond"));
}

#[test]
fn a_copied_program_serves_in_an_empty_directory() {
    let dir = tempfile::tempdir().unwrap();
    let server = crate::process::Program::start(dir.path(), &["serve", "--port", "0"]);
    let address = server
        .first_line()
        .split("http://")
        .nth(1)
        .unwrap()
        .split('/')
        .next()
        .unwrap()
        .to_owned();
    let url = format!("http://{address}/readyz");
    let is_ready = || output(dir.path(), &["healthcheck", "--url", &url]).status.success();
    let deadline = Instant::now() + TIMEOUT;
    while !is_ready() {
        assert!(Instant::now() < deadline, "the server is not ready");
    }
    server.terminate();
    let log = server.wait_for_exit();
    assert!(log.contains("moving-flow"), "{log}");
}
