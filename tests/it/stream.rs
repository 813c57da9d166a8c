//! The stream over a real WebSocket.

use std::time::{Duration, Instant};

use foreframe::server::ServerConfig;
use foreframe_core::nn::Conditioning;
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::http::HeaderValue;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

use crate::service::{
    CONTEXT, InProcessServer, TIMEOUT, app, context, frame, get, model, png, poll_until, post, run, spec, start,
    with_data,
};

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

async fn connect(server: &InProcessServer, model: &str, subprotocol: &str) -> Result<Socket, Box<Error>> {
    let mut request = format!("ws://{}/v1/models/{model}/stream", server.address)
        .into_client_request()
        .unwrap();
    request
        .headers_mut()
        .insert("sec-websocket-protocol", HeaderValue::from_str(subprotocol).unwrap());
    let (socket, _) = tokio_tungstenite::connect_async(request).await.map_err(Box::new)?;
    Ok(socket)
}

async fn open(server: &InProcessServer, model: &str) -> Socket {
    let mut socket = connect(server, model, "foreframe.v1.json").await.unwrap();
    let ready = receive(&mut socket).await;
    assert_eq!((&ready["type"], &ready["next_seq"]), (&json!("ready"), &json!(0)));
    socket
}

async fn receive(socket: &mut Socket) -> Value {
    let message = tokio::time::timeout(TIMEOUT, socket.next())
        .await
        .unwrap()
        .unwrap()
        .unwrap();
    serde_json::from_str(message.to_text().unwrap()).unwrap()
}

async fn ask(socket: &mut Socket, message: Value) -> Value {
    socket.send(Message::text(message.to_string())).await.unwrap();
    receive(socket).await
}

fn frame_message(seq: u64) -> Value {
    json!({"type": "frame", "seq": seq, "timestamp_us": seq * 1000, "image": png(&frame(seq as u8 * 10))})
}

fn status(error: &Error) -> u16 {
    match error {
        Error::Http(response) => response.status().as_u16(),
        other => panic!("{other}"),
    }
}

#[tokio::test]
async fn a_stream_predicts_the_same_as_a_request() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let mut socket = open(&server, "plain").await;
    for seq in 0..CONTEXT as u64 - 1 {
        let buffering = ask(&mut socket, frame_message(seq)).await;
        assert_eq!(
            (&buffering["type"], &buffering["have"]),
            (&json!("buffering"), &json!(seq + 1))
        );
        assert_eq!(buffering["need"], CONTEXT);
    }
    let prediction = ask(&mut socket, frame_message(CONTEXT as u64 - 1)).await;
    assert_eq!(prediction["timestamp_us"], (CONTEXT as u64 - 1) * 1000);
    let stateless = post(&app, "/v1/models/plain/predict", &json!({"frames": context()}))
        .await
        .json();
    assert_eq!(prediction["frames"], stateless["frames"]);
    assert_eq!(
        (&prediction["format"], &prediction["dropped"]),
        (&json!("png"), &json!(0))
    );

    let next = ask(&mut socket, frame_message(CONTEXT as u64)).await;
    let later: Vec<String> = (1..=CONTEXT as u8).map(|i| png(&frame(i * 10))).collect();
    let stateless = post(&app, "/v1/models/plain/predict", &json!({"frames": later}))
        .await
        .json();
    assert_eq!(next["frames"], stateless["frames"]);
    drop(socket);
    server.stop().await;
}

#[tokio::test]
async fn a_stream_says_once_which_inputs_are_not_used() {
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), ServerConfig::default())).await;
    for (model, expected) in [
        (
            "plain",
            json!([
                "action is not used: the model \"plain\" takes no actions",
                "plan is not used: the model \"plain\" takes no actions"
            ]),
        ),
        ("moving", Value::Null),
    ] {
        let mut socket = open(&server, model).await;
        let mut warnings = Vec::new();
        for seq in 0..CONTEXT as u64 + 2 {
            let mut message = frame_message(seq);
            message["action"] = json!([0.5, -0.5]);
            message["plan"] = json!([[0.5, -0.5], [0.5, -0.5]]);
            message["state"] = json!([0.5]);
            let answer = ask(&mut socket, message).await;
            if answer["type"] == "prediction" {
                warnings.push(answer["warnings"].clone());
            }
        }
        assert_eq!(warnings, [expected, Value::Null, Value::Null], "{model}");
    }
    server.stop().await;
}

#[tokio::test]
async fn without_a_plan_the_last_action_repeats() {
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), ServerConfig::default())).await;
    let mut answers = Vec::new();
    for extra in [
        json!({}),
        json!({"plan": [[3.0, -2.0], [3.0, -2.0]]}),
        json!({"plan": [[-3.0, 2.0], [-3.0, 2.0]]}),
    ] {
        let mut socket = open(&server, "moving").await;
        let mut last = Value::Null;
        for seq in 0..CONTEXT as u64 {
            let mut message = frame_message(seq);
            let fields = message.as_object_mut().unwrap();
            fields.extend(
                json!({"action": [3.0, -2.0], "state": [0.5]})
                    .as_object()
                    .unwrap()
                    .clone(),
            );
            fields.extend(extra.as_object().unwrap().clone());
            last = ask(&mut socket, message).await;
        }
        answers.push(last["frames"].clone());
    }
    assert!(answers[0].is_array());
    assert_eq!(answers[0], answers[1]);
    assert_ne!(answers[0], answers[2]);
    server.stop().await;
}

#[tokio::test]
async fn a_gap_is_refused_with_the_next_seq() {
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), ServerConfig::default())).await;
    let mut socket = open(&server, "plain").await;
    let gap = ask(&mut socket, frame_message(5)).await;
    assert_eq!(
        (&gap["code"], &gap["detail"]),
        (&json!("gap"), &json!("seq is 5; seq 0 is next"))
    );
    assert_eq!(gap["next_seq"], 0);
    for seq in 0..CONTEXT as u64 {
        ask(&mut socket, frame_message(seq)).await;
    }
    assert_eq!(ask(&mut socket, frame_message(9)).await["next_seq"], CONTEXT);
    let next = ask(&mut socket, frame_message(CONTEXT as u64)).await;
    assert_eq!((&next["type"], &next["seq"]), (&json!("prediction"), &json!(CONTEXT)));
    drop(socket);
    server.stop().await;
}

#[tokio::test]
async fn a_repeated_frame_gets_the_cached_answer() {
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), ServerConfig::default())).await;
    let mut socket = open(&server, "plain").await;
    let mut answers = Vec::new();
    for seq in 0..CONTEXT as u64 {
        answers.push(ask(&mut socket, frame_message(seq)).await);
    }
    assert_eq!(
        &ask(&mut socket, frame_message(CONTEXT as u64 - 1)).await,
        answers.last().unwrap()
    );
    assert_eq!(&ask(&mut socket, frame_message(0)).await, answers.last().unwrap());
    let next = ask(&mut socket, frame_message(CONTEXT as u64)).await;
    assert_eq!((&next["type"], &next["seq"]), (&json!("prediction"), &json!(CONTEXT)));
    drop(socket);
    server.stop().await;
}

#[tokio::test]
async fn refused_messages_do_not_change_the_stream() {
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), ServerConfig::default())).await;
    let mut socket = open(&server, "moving").await;
    let with = |more: Value| {
        let mut message = frame_message(0);
        let fields = message.as_object_mut().unwrap();
        fields.extend(
            json!({"action": [0.0, 0.0], "state": [0.0]})
                .as_object()
                .unwrap()
                .clone(),
        );
        fields.extend(more.as_object().unwrap().clone());
        message
    };
    let small = png(&foreframe_core::frame::Frame::new(8, 8, vec![0; 64]).unwrap());
    for (message, code, detail) in [
        (json!({"type": "dance"}), "malformed", "unknown variant `dance`"),
        (with(json!({"colour": 1})), "malformed", "unknown field `colour`"),
        (
            with(json!({"image": small})),
            "invalid",
            "image is 8×8 px; model \"moving\" takes 16×12; set resize to crop, letterbox or stretch",
        ),
        (with(json!({"action": [0.0]})), "invalid", "action holds 1 numbers"),
        (with(json!({"state": null})), "invalid", "state is missing"),
        (
            with(json!({"action": [1e39, 0.0]})),
            "invalid",
            "action component 0 is inf",
        ),
        (with(json!({"plan": [[0.0, 0.0]]})), "invalid", "plan holds 1 actions"),
    ] {
        let answer = ask(&mut socket, message).await;
        assert_eq!(
            (&answer["type"], &answer["code"]),
            (&json!("error"), &json!(code)),
            "{answer}"
        );
        assert!(answer["detail"].as_str().unwrap().contains(detail), "{answer}");
        assert_eq!(answer["next_seq"], 0);
    }
    socket.send(Message::binary(vec![1, 2, 3])).await.unwrap();
    assert_eq!(receive(&mut socket).await["code"], "malformed");
    assert_eq!(ask(&mut socket, with(json!({}))).await["type"], "buffering");
    let pong = ask(&mut socket, json!({"type": "ping", "timestamp_us": 7})).await;
    assert_eq!(pong, json!({"type": "pong", "timestamp_us": 7}));
    let closing = ask(&mut socket, json!({"type": "close"})).await;
    assert_eq!(closing, json!({"type": "closing", "reason": "asked"}));
    let Message::Close(Some(close)) = socket.next().await.unwrap().unwrap() else {
        panic!()
    };
    assert_eq!(close.code, CloseCode::Normal);
    drop(socket);
    server.stop().await;
}

#[tokio::test]
async fn invalid_streams_are_refused_before_the_upgrade() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_streams: 1,
        ..ServerConfig::default()
    };
    let server = run(app(dir.path(), config)).await;
    assert_eq!(
        status(&connect(&server, "none", "foreframe.v1.json").await.unwrap_err()),
        404
    );
    assert_eq!(status(&connect(&server, "plain", "chat").await.unwrap_err()), 400);
    let socket = open(&server, "plain").await;
    assert_eq!(
        status(&connect(&server, "plain", "foreframe.v1.json").await.unwrap_err()),
        503
    );
    drop(socket);
    poll_until(async || connect(&server, "plain", "foreframe.v1.json").await.ok()).await;
    server.stop().await;
}

#[tokio::test]
async fn an_idle_stream_is_warned_and_closed() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        stream_idle_ms: 20,
        ..ServerConfig::default()
    };
    let server = run(app(dir.path(), config)).await;
    let opened = Instant::now();
    let mut socket = open(&server, "plain").await;
    let warning = receive(&mut socket).await;
    assert_eq!(
        (&warning["type"], &warning["code"]),
        (&json!("warning"), &json!("idle"))
    );
    assert_eq!(receive(&mut socket).await, json!({"type": "closing", "reason": "idle"}));
    let default = Duration::from_millis(ServerConfig::default().stream_idle_ms);
    assert!(opened.elapsed() < default, "the setting is not used");
    drop(socket);
    server.stop().await;
}

#[tokio::test]
async fn a_client_that_never_reads_loses_its_stream() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_streams: 1,
        stream_send_ms: 50,
        ..with_data(dir.path(), ServerConfig::default())
    };
    let large = foreframe_core::nn::ModelSpec {
        frame_width_px: 128,
        frame_height_px: 128,
        context: 1,
        horizon: 8,
        ..spec(Conditioning::None)
    };
    let server = run(start(config, vec![model(dir.path(), "large", large)])).await;
    let mut socket = open(&server, "large").await;
    let image = base64::Engine::encode(&base64::engine::general_purpose::STANDARD, vec![0; 128 * 128]);
    let message = json!({"type": "frame", "seq": 0, "timestamp_us": 0, "image": image, "format": "raw"}).to_string();
    // Each small message is answered with the large cached answer, which is never read.
    let flood = async { while socket.send(Message::text(message.clone())).await.is_ok() {} };
    let _ = tokio::time::timeout(Duration::from_secs(20), flood).await;
    poll_until(async || connect(&server, "large", "foreframe.v1.json").await.ok()).await;
    drop(socket);
    server.stop().await;
}

#[tokio::test]
async fn a_websocket_close_is_answered() {
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), ServerConfig::default())).await;
    let mut socket = open(&server, "plain").await;
    socket.close(None).await.unwrap();
    let answer = socket.next().await;
    assert!(matches!(answer, Some(Ok(Message::Close(_)))), "{answer:?}");
    assert!(socket.next().await.is_none());
    server.stop().await;
}

#[tokio::test]
async fn shutdown_closes_streams_with_1001() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let mut socket = open(&server, "plain").await;
    let InProcessServer { shutdown, task, .. } = server;
    shutdown.send(()).unwrap();
    assert_eq!(
        receive(&mut socket).await,
        json!({"type": "closing", "reason": "shutdown"})
    );
    let Message::Close(Some(close)) = socket.next().await.unwrap().unwrap() else {
        panic!()
    };
    assert_eq!(close.code, CloseCode::Away);
    assert_eq!(get(&app, "/readyz").await.detail(503), "the server is stopping");
    tokio::time::timeout(TIMEOUT, task).await.unwrap().unwrap();
}
