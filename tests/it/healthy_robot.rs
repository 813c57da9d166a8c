//! A robot that streams while bad clients misbehave. Its predictions must not change.

use std::cell::Cell;
use std::net::SocketAddr;
use std::time::Duration;

use foreframe::server::protocol::{Codec, ServerMessage};
use foreframe::server::{App, ServerConfig};
use foreframe_core::frame::Frame;
use foreframe_core::nn::Conditioning;
use foreframe_core::registry::Model;
use foreframe_core::serving::{self, PredictionInput};
use foreframe_core::types::{Action, RobotState};
use serde_json::json;

use crate::client::{Client, SessionHandle, numbered_frame, numbered_message};
use crate::service::{CONTEXT, HEIGHT, InProcessServer, WIDTH, app, model, run, spec};

/// Time between two frames.
const PERIOD: Duration = Duration::from_millis(5);

/// A running server with a robot that streams.
pub(crate) struct ServerWithRobot {
    pub(crate) dir: tempfile::TempDir,
    pub(crate) app: App,
    pub(crate) server: InProcessServer,
    model: Model,
    robot: Client,
}

impl ServerWithRobot {
    pub(crate) async fn open(config: ServerConfig) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let app = app(dir.path(), config);
        let server = run(app.clone()).await;
        let model = model(&dir.path().join("again"), "moving", spec(Conditioning::StateAction));
        let session = SessionHandle::open(&app, &json!({"model": "moving"})).await;
        let robot = Client::connect(server.address, &session.path("/stream"), Codec::Msgpack)
            .await
            .unwrap();
        let mut setup = Self {
            dir,
            app,
            server,
            model,
            robot,
        };
        for _ in 0..CONTEXT {
            setup.step().await;
        }
        setup
    }

    pub(crate) fn address(&self) -> SocketAddr {
        self.server.address
    }

    /// Opens a session for a bad client.
    pub(crate) async fn session(&self) -> SessionHandle {
        SessionHandle::open(&self.app, &json!({"model": "moving"})).await
    }

    /// Runs the bad client while the robot streams. Checks the robot's predictions during that time and once afterwards.
    pub(crate) async fn while_robot_streams<T>(&mut self, bad_client: impl Future<Output = T>) -> T {
        let is_done = Cell::new(false);
        let bad_client = async {
            let result = bad_client.await;
            is_done.set(true);
            result
        };
        let robot = async {
            while !is_done.get() {
                self.step().await;
                tokio::time::sleep(PERIOD).await;
            }
            self.step().await;
        };
        tokio::join!(bad_client, robot).0
    }

    /// Sends the robot's next frame and compares the answer with a direct prediction of the model.
    async fn step(&mut self) {
        let seq = self.robot.next_seq;
        self.robot.next_seq += 1;
        let answer = self.robot.ask(&numbered_message(seq)).await;
        let Some(first) = (seq + 1).checked_sub(CONTEXT as u64) else {
            assert!(matches!(answer, ServerMessage::Buffering { .. }), "{answer:?}");
            return;
        };
        let ServerMessage::Prediction { frames, .. } = answer else {
            panic!("{answer:?}")
        };
        let image = |seq| Frame::new(WIDTH, HEIGHT, numbered_frame(seq).image.0).unwrap();
        let input = PredictionInput {
            frames: (first..=seq).map(image).collect(),
            actions: vec![Action::try_from(numbered_frame(seq).action.unwrap()).unwrap()],
            state: RobotState::try_from(numbered_frame(seq).state.unwrap()).ok(),
            ..PredictionInput::default()
        };
        let expected = serving::predict(&self.model, &[&input]).unwrap().remove(0).frames;
        let found: Vec<&[u8]> = frames.iter().map(|frame| frame.0.as_slice()).collect();
        let expected: Vec<&[u8]> = expected.iter().map(Frame::pixels).collect();
        assert_eq!(found, expected, "frame {seq}");
    }

    pub(crate) async fn close(self) {
        drop(self.robot);
        self.server.stop().await;
    }
}
