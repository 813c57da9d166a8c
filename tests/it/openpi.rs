//! openpi's WebSocket on the wire; `tests/python/openpi.py` uses the client that its users have.

use std::net::SocketAddr;

use foreframe::server::keys::{Keys, NewKey};
use foreframe::server::{App, ImageBytes, ServerConfig};
use foreframe_jobs::store::Author;
use futures_util::{SinkExt as _, StreamExt as _};
use serde::{Deserialize, Serialize};
use serde_json::json;
use tokio::io::AsyncWriteExt as _;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::{Error, Message};

use crate::client::Socket;
use crate::keys::new_key;
use crate::service::{
    CONTEXT, HEIGHT, HORIZON, InProcessServer, TIMEOUT, WIDTH, app, context, frame, get, poll_until, post, run, store,
};

/// An array as openpi's client packs it: the keys are binary.
#[derive(Debug, Deserialize, PartialEq)]
struct Array {
    #[serde(rename = "__ndarray__")]
    is_numpy: bool,
    data: ImageBytes,
    dtype: String,
    shape: Vec<usize>,
}

impl Serialize for Array {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::SerializeMap as _;
        let key = |name: &str| ImageBytes(name.as_bytes().to_vec());
        let mut map = serializer.serialize_map(Some(4))?;
        map.serialize_entry(&key("__ndarray__"), &self.is_numpy)?;
        map.serialize_entry(&key("data"), &self.data)?;
        map.serialize_entry(&key("dtype"), &self.dtype)?;
        map.serialize_entry(&key("shape"), &self.shape)?;
        map.end()
    }
}

fn bytes(shape: &[usize], data: Vec<u8>) -> Array {
    Array {
        is_numpy: true,
        data: ImageBytes(data),
        dtype: "|u1".to_owned(),
        shape: shape.to_vec(),
    }
}

fn doubles(shape: &[usize], values: &[f64]) -> Array {
    Array {
        is_numpy: true,
        data: ImageBytes(values.iter().flat_map(|value| value.to_le_bytes()).collect()),
        dtype: "<f8".to_owned(),
        shape: shape.to_vec(),
    }
}

#[derive(Serialize)]
#[serde(rename_all = "snake_case")]
struct Observation {
    #[serde(skip_serializing_if = "Option::is_none")]
    model: Option<&'static str>,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    reset: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    resize: Option<&'static str>,
    frame: Array,
    state: Array,
    actions: Array,
}

/// The frame of that number, in the model's size.
fn observation(number: u8) -> Observation {
    Observation {
        model: None,
        reset: false,
        resize: None,
        frame: bytes(&[HEIGHT as usize, WIDTH as usize], frame(number * 10).pixels().to_vec()),
        state: doubles(&[1], &[0.5]),
        actions: doubles(&[2, 2], &[0.5, -0.5, 0.5, -0.5]),
    }
}

#[derive(Debug, Deserialize)]
struct Reply {
    model: String,
    version: u32,
    missing: usize,
    frames: Option<Array>,
}

#[derive(Deserialize)]
struct Metadata {
    model: String,
    models: Vec<String>,
}

struct Robot(Socket);

impl Robot {
    async fn connect(address: SocketAddr, path: &str, key: Option<&str>) -> Result<(Self, Metadata), Box<Error>> {
        let mut request = format!("ws://{address}{path}").into_client_request().unwrap();
        if let Some(key) = key {
            let value = format!("Api-Key {key}").parse().unwrap();
            request.headers_mut().insert("authorization", value);
        }
        let (socket, _) = tokio_tungstenite::connect_async(request).await.map_err(Box::new)?;
        let mut robot = Self(socket);
        let Message::Binary(metadata) = robot.receive().await else {
            panic!("the first message is not binary");
        };
        Ok((robot, rmp_serde::from_slice(&metadata).unwrap()))
    }

    async fn receive(&mut self) -> Message {
        tokio::time::timeout(TIMEOUT, self.0.next())
            .await
            .unwrap()
            .unwrap()
            .unwrap()
    }

    async fn ask(&mut self, message: Message) -> Message {
        self.0.send(message).await.unwrap();
        self.receive().await
    }

    async fn infer(&mut self, observation: &impl Serialize) -> Reply {
        match self
            .ask(Message::binary(rmp_serde::to_vec_named(observation).unwrap()))
            .await
        {
            Message::Binary(bytes) => rmp_serde::from_slice(&bytes).unwrap(),
            other => panic!("{other:?}"),
        }
    }

    /// The words of the refusal.
    async fn refused(&mut self, message: Message) -> String {
        match self.ask(message).await {
            Message::Text(text) => text.to_string(),
            other => panic!("{other:?}"),
        }
    }

    async fn infer_refused(&mut self, observation: &impl Serialize) -> String {
        self.refused(Message::binary(rmp_serde::to_vec_named(observation).unwrap()))
            .await
    }
}

async fn served(config: ServerConfig) -> (tempfile::TempDir, App, InProcessServer) {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), config);
    let server = run(app.clone()).await;
    (dir, app, server)
}

#[tokio::test]
async fn observations_gather_a_context_and_give_the_prediction_of_a_request() {
    let (_dir, app, server) = served(ServerConfig::default()).await;
    let (mut robot, metadata) = Robot::connect(server.address, "/", None).await.unwrap();
    assert_eq!(metadata.model, "moving", "the only model that takes actions");
    assert_eq!(metadata.models, ["moving", "plain"]);
    for number in 0..CONTEXT as u8 - 1 {
        let reply = robot.infer(&observation(number)).await;
        assert_eq!((reply.missing, reply.frames), (CONTEXT - 1 - usize::from(number), None));
    }
    let reply = robot.infer(&observation(CONTEXT as u8 - 1)).await;
    assert_eq!((reply.model.as_str(), reply.version, reply.missing), ("moving", 1, 0));
    let request = json!({"frames": context(), "state": [0.5], "plan": [[0.5, -0.5], [0.5, -0.5]], "format": "png"});
    let expected = post(&app, "/v1/models/moving/predict", &request).await.json();
    let decoded = |image: &serde_json::Value| {
        let ImageBytes(file) = serde_json::from_value(image.clone()).unwrap();
        foreframe_core::frame::codec::decode(&file).unwrap().into_pixels()
    };
    let pixels: Vec<u8> = expected["frames"]
        .as_array()
        .unwrap()
        .iter()
        .flat_map(decoded)
        .collect();
    assert_eq!(
        reply.frames,
        Some(bytes(&[HORIZON, HEIGHT as usize, WIDTH as usize], pixels))
    );
    drop(robot);
    server.stop().await;
}

#[tokio::test]
async fn a_page_and_a_socket_share_the_root() {
    let (_dir, app, server) = served(ServerConfig::default()).await;
    let page = get(&app, "/").await;
    assert_eq!(page.headers["content-type"], "text/html; charset=utf-8");
    assert_eq!(get(&app, "/v1/models/moving/openpi").await.status, 426);
    assert_eq!(get(&app, "/v1/models/nothing/openpi").await.status, 404);
    let path = "/v1/models/plain/openpi";
    let (_robot, metadata) = Robot::connect(server.address, path, None).await.unwrap();
    assert_eq!(metadata.model, "plain");
}

#[tokio::test]
async fn colour_other_sizes_other_models_and_resets_are_understood() {
    let (_dir, _app, server) = served(ServerConfig::default()).await;
    let (mut robot, _) = Robot::connect(server.address, "/", None).await.unwrap();
    let colour = Observation {
        frame: bytes(&[20, 30, 3], vec![9; 20 * 30 * 3]),
        resize: Some("crop"),
        ..observation(0)
    };
    assert_eq!(robot.infer(&colour).await.missing, CONTEXT - 1);
    assert_eq!(robot.infer(&observation(1)).await.missing, CONTEXT - 2);
    let again = Observation {
        reset: true,
        ..observation(2)
    };
    assert_eq!(robot.infer(&again).await.missing, CONTEXT - 1);
    let other = Observation {
        model: Some("plain"),
        ..observation(0)
    };
    let reply = robot.infer(&other).await;
    assert_eq!((reply.model.as_str(), reply.missing), ("plain", CONTEXT - 1));
    // It stays with the model.
    let reply = robot.infer(&observation(1)).await;
    assert_eq!((reply.model.as_str(), reply.missing), ("plain", CONTEXT - 2));
    let reset = rmp_serde::to_vec_named(&json!({"endpoint": "reset"})).unwrap();
    let Message::Binary(status) = robot.ask(Message::binary(reset)).await else {
        panic!();
    };
    let status: serde_json::Value = rmp_serde::from_slice(&status).unwrap();
    assert_eq!(status, json!({"status": "reset successful"}));
    assert_eq!(robot.infer(&observation(0)).await.missing, CONTEXT - 1);
}

#[tokio::test]
async fn a_bad_observation_is_refused_in_words_and_changes_nothing() {
    let (_dir, _app, server) = served(ServerConfig::default()).await;
    let (mut robot, _) = Robot::connect(server.address, "/", None).await.unwrap();
    assert_eq!(robot.infer(&observation(0)).await.missing, CONTEXT - 1);
    let size = [HEIGHT as usize, WIDTH as usize];
    for (wrong, words) in [
        (
            Observation {
                frame: bytes(&[2, 2], vec![0; 4]),
                ..observation(1)
            },
            "takes 16×12",
        ),
        (
            Observation {
                frame: bytes(&size, vec![0; 5]),
                ..observation(1)
            },
            "frame holds 5 values",
        ),
        (
            Observation {
                frame: bytes(&[192], vec![0; 192]),
                ..observation(1)
            },
            "frame has the shape [192]",
        ),
        (
            Observation {
                frame: bytes(&[0, 0], vec![]),
                ..observation(1)
            },
            "frame is",
        ),
        (
            Observation {
                frame: bytes(&[1 << 40, 1 << 40, 3], vec![]),
                ..observation(1)
            },
            "frame holds 0 values",
        ),
        (
            Observation {
                frame: bytes(&[3000, 2000], vec![0; 6_000_000]),
                resize: Some("crop"),
                ..observation(1)
            },
            "at most",
        ),
        (
            Observation {
                frame: doubles(&size, &[0.0; 192]),
                ..observation(1)
            },
            "must be uint8",
        ),
        (
            Observation {
                resize: Some("tile"),
                ..observation(1)
            },
            "resize",
        ),
        (
            Observation {
                state: doubles(&[2], &[0.0; 2]),
                ..observation(1)
            },
            "state holds 2 numbers",
        ),
        (
            Observation {
                state: doubles(&[1], &[f64::NAN]),
                ..observation(1)
            },
            "state component 0 is NaN",
        ),
        (
            Observation {
                actions: doubles(&[2], &[0.0; 2]),
                ..observation(1)
            },
            "actions has the shape [2]",
        ),
        (
            Observation {
                actions: doubles(&[3, 2], &[0.0; 6]),
                ..observation(1)
            },
            "actions",
        ),
        (
            Observation {
                model: Some("nothing"),
                ..observation(1)
            },
            "no model",
        ),
    ] {
        let found = robot.infer_refused(&wrong).await;
        assert!(found.contains(words), "{found}; expected {words}");
    }
    for (wrong, words) in [
        (json!({}), "frame is missing"),
        (json!({"prompt": "drive"}), "unknown field `prompt`"),
        (json!({"frame": [[1, 2], [3]]}), "different lengths"),
        (
            json!({"frame": [[1.5]], "state": [0.5], "action": [0, 0]}),
            "frame holds 1.5",
        ),
        (json!({"frame": [[1]], "state": [0.5]}), "action is missing"),
        (json!({"frame": "a"}), "an array of NumPy"),
        (json!({"endpoint": "act"}), "endpoint"),
    ] {
        let found = robot.infer_refused(&wrong).await;
        assert!(found.contains(words), "{found}; expected {words}");
    }
    for damaged in [
        &b""[..],
        b"\xc1",
        b"\x81",
        b"\x81\xa5frame\xc6\xff\xff\xff\xff",
        b"\x80\x80",
    ] {
        let found = robot.refused(Message::binary(damaged.to_vec())).await;
        assert!(found.contains("not an observation"), "{found}");
    }
    assert!(robot.refused(Message::text("{}")).await.contains("binary"));
    assert_eq!(robot.infer(&observation(1)).await.missing, CONTEXT - 2);
}

#[tokio::test]
async fn every_damaged_observation_has_one_answer() {
    let (_dir, _app, server) = served(ServerConfig::default()).await;
    let (mut robot, _) = Robot::connect(server.address, "/", None).await.unwrap();
    let sound = rmp_serde::to_vec_named(&Observation {
        reset: true,
        ..observation(0)
    })
    .unwrap();
    let cut = (0..sound.len()).step_by(7).map(|length| sound[..length].to_vec());
    let changed = (0..sound.len()).flat_map(|place| {
        // Among them are the markers of lists, maps and bytes with a length of four bytes.
        [0x00, 0xc1, 0xc6, 0xdd, 0xdf].map(|byte| {
            let mut damaged = sound.clone();
            damaged[place] = byte;
            damaged
        })
    });
    for damaged in cut.chain(changed) {
        let answer = robot.ask(Message::binary(damaged)).await;
        assert!(matches!(answer, Message::Binary(_) | Message::Text(_)), "{answer:?}");
    }
    assert_eq!(robot.infer(&observation(1)).await.model, "moving");
}

#[tokio::test]
async fn the_limits_and_the_drain_of_streams_hold() {
    let config = ServerConfig {
        max_body_bytes: 4096,
        max_streams: 2,
        ..ServerConfig::default()
    };
    let (_dir, _app, server) = served(config).await;
    let (mut long, _) = Robot::connect(server.address, "/", None).await.unwrap();
    let (mut waiting, _) = Robot::connect(server.address, "/", None).await.unwrap();
    let Err(refused) = Robot::connect(server.address, "/", None).await else {
        panic!("a third stream");
    };
    assert!(matches!(*refused, Error::Http(answer) if answer.status() == 503));
    let refusal = long.refused(Message::binary(vec![0; 5000])).await;
    assert!(refusal.contains("Message too long"), "{refusal}");
    assert_eq!(
        close_of(long.receive().await),
        (1009, "the message is too long".to_owned())
    );
    drop(long);
    // Closed in the middle of a message.
    let opened = poll_until(async || Robot::connect(server.address, "/", None).await.ok());
    let (mut cut, _) = opened.await;
    cut.0.get_mut().write_all(b"\x82\xfe\x04").await.unwrap();
    drop(cut);
    // Its place is free again.
    poll_until(async || Robot::connect(server.address, "/", None).await.ok()).await;
    let closing = waiting.receive();
    let (closed, ()) = tokio::join!(closing, server.stop());
    assert_eq!(close_of(closed), (1001, "the server stops".to_owned()));
}

fn close_of(message: Message) -> (u16, String) {
    match message {
        Message::Close(Some(frame)) => (frame.code.into(), frame.reason.to_string()),
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_socket_needs_a_key_where_authentication_is_on() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path());
    let keys = Keys::open(store.clone(), true).await.unwrap();
    let app = app(dir.path(), ServerConfig::default()).with_keys(keys.clone());
    let server = run(app.clone()).await;
    let (key, unknown) = (new_key(&store, &keys).await, NewKey::generate().unwrap());
    for path in ["/", "/v1/models/moving/openpi"] {
        for wrong in [None, Some(unknown.text.as_str())] {
            let Err(refused) = Robot::connect(server.address, path, wrong).await else {
                panic!("no key was needed");
            };
            assert!(matches!(*refused, Error::Http(answer) if answer.status() == 401));
        }
    }
    let (mut robot, _) = Robot::connect(server.address, "/", Some(&key.text)).await.unwrap();
    assert_eq!(robot.infer(&observation(0)).await.missing, CONTEXT - 1);
    assert_eq!(get(&app, "/").await.status, 200, "the page needs none");
    store.revoke_key(&key.id, 2.0, &Author::CommandLine).await.unwrap();
    keys.refresh().await.unwrap();
    assert_eq!(
        close_of(robot.receive().await),
        (1008, "the API key was revoked".to_owned())
    );
}
