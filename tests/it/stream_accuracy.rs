//! Streams predict the same as single requests, whatever else is in their batches.

use std::path::Path;

use candle_core::{Device, Tensor};
use foreframe::server::protocol::{ClientMessage, Codec, FrameMessage, ServerMessage};
use foreframe::server::{App, ImageBytes, ImageFormat, ServerConfig};
use foreframe_core::frame::{Frame, codec};
use foreframe_core::registry::{self, Model};
use foreframe_core::serving::{self, PredictionInput};
use foreframe_core::types::{Action, RobotState, Seed};
use rand::Rng as _;
use serde_json::{Value, json};

use crate::client::{Client, SessionHandle};
use crate::nn_fixtures::largest_difference;
use crate::service::{self, InProcessServer, get, run, with_data};

fn shipped(name: &str) -> Model {
    registry::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("models").join(name)).unwrap()
}

/// Frames, actions and states of one robot.
struct Recording {
    frames: Vec<Frame>,
    actions: Vec<Vec<f32>>,
    states: Vec<Vec<f32>>,
}

impl Recording {
    /// The frames in `examples`.
    fn example() -> Self {
        let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/frames");
        let recorded: Value = serde_json::from_slice(&std::fs::read(dir.join("actions.json")).unwrap()).unwrap();
        let numbers = |field: &str| serde_json::from_value::<Vec<Vec<f32>>>(recorded[field].clone()).unwrap();
        let frame = |index| codec::decode(&std::fs::read(dir.join(format!("frame-{index:03}.png"))).unwrap()).unwrap();
        Self {
            frames: (0..15).map(frame).collect(),
            actions: numbers("actions"),
            states: numbers("states"),
        }
    }

    /// Random frames, actions and states, different for each robot.
    fn noise(model: &Model, robot: u64, steps: usize) -> Self {
        let spec = &model.manifest.spec;
        let mut rng = Seed(11).derive("robot", robot).rng();
        let (width, height) = (spec.frame_width_px, spec.frame_height_px);
        let frame = |rng: &mut rand_chacha::ChaCha8Rng| {
            let pixels = (0..width * height).map(|_| rng.random()).collect();
            Frame::new(width, height, pixels).unwrap()
        };
        let frames = (0..steps).map(|_| frame(&mut rng)).collect();
        let mut numbers = |count: usize| -> Vec<Vec<f32>> {
            let row = |rng: &mut rand_chacha::ChaCha8Rng| (0..count).map(|_| rng.random_range(-1.0..1.0)).collect();
            (0..steps).map(|_| row(&mut rng)).collect()
        };
        let (actions, states) = (numbers(spec.actions.len()), numbers(spec.states.len()));
        Self {
            frames,
            actions,
            states,
        }
    }

    fn message(&self, seq: usize) -> ClientMessage {
        ClientMessage::Frame(FrameMessage {
            steps: None,
            seq: seq as u64,
            timestamp_us: seq as i64,
            image: ImageBytes(self.frames[seq].pixels().to_vec()),
            format: ImageFormat::Raw,
            action: Some(self.actions[seq].clone()),
            state: Some(self.states[seq].clone()),
            plan: None,
        })
    }

    /// The prediction after frame `seq`, computed without a session.
    fn stateless(&self, model: &Model, seq: usize) -> Vec<Frame> {
        let input = PredictionInput {
            frames: self.frames[seq + 1 - model.manifest.spec.context..=seq].to_vec(),
            actions: Action::try_from(self.actions[seq].clone()).into_iter().collect(),
            state: RobotState::try_from(self.states[seq].clone()).ok(),
            ..PredictionInput::default()
        };
        serving::predict(model, &[&input]).unwrap().remove(0).frames
    }

    /// Checks that a prediction is the stateless one.
    fn check(&self, model: &Model, seq: usize, frames: &[ImageBytes]) {
        let expected = self.stateless(model, seq);
        assert_eq!(frames.len(), expected.len());
        for (found, expected) in frames.iter().zip(&expected) {
            assert!(found.0 == expected.pixels(), "frame {seq}");
        }
    }

    /// Checks that an exported state has the features of the last frames.
    fn check_state(&self, model: &Model, state: &Value) {
        let spec = &model.manifest.spec;
        let features: Vec<Vec<f32>> = serde_json::from_value(state["snapshot"]["features"].clone()).unwrap();
        assert_eq!(state["snapshot"]["next_seq"], self.frames.len());
        let last = &self.frames[self.frames.len() - spec.context..];
        for (frame, found) in last.iter().zip(&features) {
            let pixels = Tensor::from_vec(spec.preprocess.forward(frame), (1, spec.pixels()), &Device::Cpu).unwrap();
            let expected = model.network.encode_frames(&pixels).unwrap().flatten_all().unwrap();
            assert_eq!(*found, expected.to_vec1::<f32>().unwrap());
        }
    }
}

async fn start(dir: &Path, models: &[Model]) -> (App, InProcessServer) {
    let app = service::start(with_data(dir, ServerConfig::default()), models.to_vec());
    let server = run(app.clone()).await;
    (app, server)
}

#[tokio::test]
async fn shipped_models_predict_the_same_in_streams_and_requests() {
    let (dir, recording) = (tempfile::tempdir().unwrap(), Recording::example());
    let models = [shipped("moving"), shipped("paper")];
    let (app, server) = start(dir.path(), &models).await;
    for (model, codec) in models
        .iter()
        .flat_map(|model| [(model, Codec::Json), (model, Codec::Msgpack)])
    {
        let name = &model.manifest.name;
        let session = SessionHandle::open(&app, &json!({"model": name})).await;
        let mut client = Client::connect(server.address, &session.path("/stream"), codec)
            .await
            .unwrap();
        for seq in 0..recording.frames.len() {
            match client.ask(&recording.message(seq)).await {
                ServerMessage::Buffering { have, .. } => assert_eq!(have, seq + 1),
                ServerMessage::Prediction { frames, .. } => recording.check(model, seq, &frames),
                other => panic!("{other:?}"),
            }
        }
        recording.check_state(model, &get(&app, &session.path("/state")).await.json());
    }
    server.stop().await;
}

#[test]
fn batched_predictions_have_the_bits_of_single_ones() {
    for model in [shipped("moving"), shipped("paper")] {
        let spec = &model.manifest.spec;
        let mut rng = Seed(5).rng();
        let mut tensor = |shape: &[usize]| {
            let values: Vec<f32> = (0..shape.iter().product())
                .map(|_| rng.random_range(-1.0..1.0))
                .collect();
            Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
        };
        let features = tensor(&[24, spec.context, spec.code_len()]);
        let windows: Vec<u32> = (0..64).map(|future| future * 7 % 24).collect();
        let condition = foreframe_core::nn::ConditioningTensors {
            actions: Some(tensor(&[64, spec.horizon, spec.actions.len().max(1)])),
            state: Some(tensor(&[64, spec.states.len().max(1)])),
            ..foreframe_core::nn::ConditioningTensors::none()
        };
        let together = model.network.predict_rollouts(&features, &windows, &condition).unwrap();
        for (future, &window) in windows.iter().enumerate() {
            let row = |tensor: &Option<Tensor>| tensor.as_ref().map(|tensor| tensor.narrow(0, future, 1).unwrap());
            let condition = foreframe_core::nn::ConditioningTensors {
                actions: row(&condition.actions),
                state: row(&condition.state),
                ..foreframe_core::nn::ConditioningTensors::none()
            };
            let window = features.narrow(0, window as usize, 1).unwrap();
            let alone = model
                .network
                .predict(&window, &condition, foreframe_core::nn::Feedback::Prediction)
                .unwrap();
            let row = together.narrow(0, future, 1).unwrap();
            assert_eq!(largest_difference(&alone, &row), 0.0);
        }
    }
}

/// A robot that sends frames at random times, some ahead of their answers. Every prediction is checked against the
/// stateless one.
async fn drive(app: &App, address: std::net::SocketAddr, model: &Model, robot: u64, steps: usize) {
    let recording = Recording::noise(model, robot, steps);
    let session = SessionHandle::open(app, &json!({"model": "moving"})).await;
    let mut client = Client::connect(address, &session.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    let mut rng = Seed(12).derive("pace", robot).rng();
    let (mut sent, mut unchecked) = (0, Vec::new());
    for answered in 0..steps {
        let ahead = rng.random_range(1..8usize);
        while sent < steps && sent < answered + ahead {
            client.send(&recording.message(sent)).await;
            sent += 1;
        }
        for _ in 0..rng.random_range(0..4u8) {
            tokio::task::yield_now().await;
        }
        match client.receive().await {
            ServerMessage::Buffering { have, .. } => assert_eq!(have, answered + 1),
            ServerMessage::Prediction { frames, seq, .. } => {
                assert_eq!(seq, answered as u64);
                unchecked.push((answered, frames));
            }
            other => panic!("{other:?}"),
        }
        // Check many at once, so that all robots keep the server busy at the same time.
        if unchecked.len() == 50 || answered + 1 == steps {
            for (seq, frames) in unchecked.drain(..) {
                recording.check(model, seq, &frames);
            }
        }
    }
    recording.check_state(model, &get(app, &session.path("/state")).await.json());
}

async fn run_interleaved(steps: usize) {
    let dir = tempfile::tempdir().unwrap();
    let model = shipped("moving");
    let (app, server) = start(dir.path(), std::slice::from_ref(&model)).await;
    let robots = (0..64).map(|robot| drive(&app, server.address, &model, robot, steps));
    futures_util::future::join_all(robots).await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sixty_four_interleaved_sessions_equal_single_predictions() {
    run_interleaved(12).await;
}

/// `cargo test --release --test it -- --ignored sixty_four_interleaved_sessions_for_a_thousand_steps`
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "64,000 predictions, each computed twice, take minutes"]
async fn sixty_four_interleaved_sessions_for_a_thousand_steps() {
    run_interleaved(1000).await;
}
