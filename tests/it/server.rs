//! Predictions over HTTP: responses, refusals, limits and shutdown.

use axum::body::Body;
use axum::http::{Request, header};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::ServerConfig;
use foreframe_core::frame::{Frame, codec};
use foreframe_core::nn::Conditioning;
use foreframe_core::serving::{self, PredictionInput};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::service::{
    CONTEXT, HEIGHT, HORIZON, WIDTH, app, context, frame, get, model, png, post, post_text, run, send, slow_spec, spec,
    start, with_data,
};

const PLAIN: &str = "/v1/models/plain/predict";
const MOVING: &str = "/v1/models/moving/predict";

#[tokio::test]
async fn http_predictions_equal_library_predictions() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let loaded = model(dir.path(), "plain", spec(Conditioning::None));
    let input = PredictionInput {
        frames: (0..CONTEXT as u8).map(|i| frame(i * 10)).collect(),
        ..PredictionInput::default()
    };
    let expected = serving::predict(&loaded, &[&input]).unwrap().remove(0).frames;

    let answer = post(&app, PLAIN, &json!({"frames": context()})).await.json();
    assert_eq!((&answer["model"], &answer["version"]), (&json!("plain"), &json!(1)));
    let predicted: Vec<Frame> = answer["frames"]
        .as_array()
        .unwrap()
        .iter()
        .map(|image| codec::decode(&STANDARD.decode(image.as_str().unwrap()).unwrap()).unwrap())
        .collect();
    assert_eq!(predicted, expected);
    assert!(answer["timing"]["compute_us"].as_u64().unwrap() > 0);
}

#[tokio::test]
async fn raw_frames_are_answered_with_raw_frames() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let raw: Vec<String> = (0..CONTEXT as u8)
        .map(|i| STANDARD.encode(frame(i * 10).pixels()))
        .collect();
    let as_raw = post(&app, PLAIN, &json!({"frames": raw, "format": "raw"})).await.json();
    let as_png = post(&app, PLAIN, &json!({"frames": context()})).await.json();
    let decoded = codec::decode(&STANDARD.decode(as_png["frames"][0].as_str().unwrap()).unwrap()).unwrap();
    assert_eq!(as_raw["format"], "raw");
    assert_eq!(
        STANDARD.decode(as_raw["frames"][0].as_str().unwrap()).unwrap(),
        decoded.pixels()
    );
}

#[tokio::test]
async fn without_a_plan_the_last_action_repeats() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let ask = async |actions: Value, future: Value, state: Value| {
        let mut body = json!({"frames": context(), "actions": actions, "plan": future});
        body.as_object_mut().unwrap().extend(state.as_object().unwrap().clone());
        post(&app, MOVING, &body).await.json()["frames"].clone()
    };
    let state = json!({"state": [0.5]});
    let held = ask(json!([[0.0, 0.0], [3.0, -2.0]]), Value::Null, state.clone()).await;
    let said = ask(json!([]), json!([[3.0, -2.0], [3.0, -2.0]]), state).await;
    let states = ask(
        json!([[3.0, -2.0]]),
        Value::Null,
        json!({"states": [[9.0], [9.0], [0.5]]}),
    )
    .await;
    let other = ask(json!([[-3.0, 2.0]]), Value::Null, json!({"state": [0.5]})).await;
    assert_eq!(held, said);
    assert_eq!(held, states);
    assert_ne!(held, other);
}

#[tokio::test]
async fn the_accept_header_selects_png_or_gif() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let body = json!({"frames": context()}).to_string();
    let sheet = post_text(&app, PLAIN, body.clone(), "image/png").await;
    assert_eq!(sheet.headers[header::CONTENT_TYPE], "image/png");
    let sheet = codec::decode(&sheet.body).unwrap();
    assert!(sheet.width() > CONTEXT as u32 * WIDTH && sheet.height() > 2 * HEIGHT);
    let gif = post_text(&app, PLAIN, body.clone(), "image/gif").await;
    assert_eq!(gif.headers[header::CONTENT_TYPE], "image/gif");
    assert!(gif.body.starts_with(b"GIF89a"));
    let refused = post_text(&app, PLAIN, body, "text/csv").await.detail(406);
    assert!(
        refused.contains("application/json, application/msgpack, image/png and image/gif"),
        "{refused}"
    );
}

#[tokio::test]
async fn mismatched_inputs_are_refused_with_the_field() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let large = png(&Frame::new(80, 60, vec![0; 4800]).unwrap());
    let with_large = vec![context()[0].clone(), context()[1].clone(), large];
    let moving = |more: Value| {
        let mut body = json!({"frames": context(), "state": [0.0], "actions": [[0.0, 0.0]]});
        body.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        body
    };
    for (path, body, expected) in [
        (
            PLAIN,
            json!({"frames": with_large}),
            "frames[2] is 80×60 px; model \"plain\" takes 16×12; set resize to crop, letterbox or stretch",
        ),
        (
            PLAIN,
            json!({"frames": &context()[1..]}),
            "frames holds 2 images; model \"plain\" takes 3",
        ),
        (
            PLAIN,
            json!({"frames": ["AAAA"]}),
            "frames[0] is not a readable PNG or JPEG image",
        ),
        (
            PLAIN,
            json!({"frames": ["AAAA"], "format": "raw"}),
            "frames[0] holds 3 raw bytes; model \"plain\" takes 16×12 px, 192 bytes",
        ),
        (
            MOVING,
            moving(json!({"actions": []})),
            "plan is missing; model \"moving\" takes linear m/s, angular rad/s",
        ),
        (
            MOVING,
            moving(json!({"actions": [[1.0]]})),
            "actions[0] holds 1 numbers; model \"moving\" takes 2: linear m/s, angular rad/s",
        ),
        (
            MOVING,
            moving(json!({"plan": [[1.0, 2.0]]})),
            "plan holds 1 actions; model \"moving\" takes 2",
        ),
        (
            MOVING,
            moving(json!({"state": [1.0, 2.0]})),
            "state holds 2 numbers; model \"moving\" takes 1: x m",
        ),
        (
            MOVING,
            moving(json!({"state": null})),
            "state is missing; model \"moving\" takes x m",
        ),
        (
            MOVING,
            moving(json!({"states": [[1.0]]})),
            "states holds 1 states; there are 3 frames, and each has one",
        ),
        (
            MOVING,
            moving(json!({"actions": [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]})),
            "actions holds 4 actions; there are 3 frames, and each has at most one",
        ),
    ] {
        assert_eq!(post(&app, path, &body).await.detail(422), expected);
    }
    let garbled = post(&app, PLAIN, &json!({"frames": ["AAAA", "%"]})).await.detail(422);
    assert!(
        garbled.contains("frames[1]: the image is not base64: Invalid symbol 37"),
        "{garbled}"
    );
}

#[tokio::test]
async fn bodies_and_lists_over_their_limit_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_body_bytes: 4096,
        max_frames: 4,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let long = post(&app, PLAIN, &json!({"frames": ["A".repeat(5000)]}))
        .await
        .detail(413);
    let expected = "the body is longer than this server takes (settings max_body_bytes and, for jobs, max_job_bytes)";
    assert_eq!(long, expected);
    let many = post(&app, PLAIN, &json!({"frames": vec!["AAAA"; 5]})).await.detail(413);
    assert_eq!(many, "frames holds 5; this server takes at most 4 in a request");
}

#[tokio::test]
async fn a_body_that_alone_exceeds_what_is_read_at_a_time_is_too_long() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_body_bytes: 4096,
        max_total_body_bytes: 4096,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let pieces = (0..8).map(|_| Ok::<_, std::io::Error>(vec![b' '; 1000]));
    let body = Body::from_stream(futures_util::stream::iter(pieces));
    let request = Request::post(PLAIN).header(header::CONTENT_TYPE, "application/json");
    let detail = send(&app, request.body(body).unwrap()).await.detail(413);
    assert!(detail.contains("max_body_bytes"), "{detail}");
}

#[tokio::test]
async fn a_full_queue_is_answered_503_with_retry_after() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_queued_predictions: 1,
        max_batch: 1,
        ..with_data(dir.path(), ServerConfig::default())
    };
    let app = start(config, vec![model(dir.path(), "slow", slow_spec())]);
    let body = json!({"frames": context()});
    let asked = (0..40).map(|_| post(&app, "/v1/models/slow/predict", &body));
    let answers = futures_util::future::join_all(asked).await;
    let refused: Vec<_> = answers.iter().filter(|answer| answer.status != 200).collect();
    assert!(!refused.is_empty() && refused.len() < answers.len());
    for answer in refused {
        assert_eq!(
            answer.detail(503),
            "1 predictions are waiting already; try again in 1 s"
        );
        assert_eq!(answer.headers[header::RETRY_AFTER], "1");
    }
}

#[tokio::test]
async fn a_prediction_past_its_deadline_is_answered_503() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        prediction_deadline_ms: 1,
        ..with_data(dir.path(), ServerConfig::default())
    };
    let app = start(config, vec![model(dir.path(), "slow", slow_spec())]);
    let body = json!({"frames": context()});
    let asked = (0..20).map(|_| post(&app, "/v1/models/slow/predict", &body));
    let answers = futures_util::future::join_all(asked).await;
    let late = answers.iter().find(|answer| answer.status == 503).unwrap();
    assert!(
        late.detail(503)
            .starts_with("no prediction within 1 ms (setting prediction_deadline_ms)")
    );
    assert_eq!(late.headers[header::RETRY_AFTER], "1");
}

#[tokio::test]
async fn a_connection_over_the_limit_is_answered_503() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_connections: 1,
        connection_evict_ms: 60_000,
        ..ServerConfig::default()
    };
    let server = run(app(dir.path(), config)).await;
    let ask = b"GET /livez HTTP/1.1\r\nhost: a\r\n\r\n";
    let mut first = TcpStream::connect(server.address).await.unwrap();
    first.write_all(ask).await.unwrap();
    let mut beginning = [0; 12];
    first.read_exact(&mut beginning).await.unwrap();
    assert_eq!(&beginning, b"HTTP/1.1 200");
    let mut second = TcpStream::connect(server.address).await.unwrap();
    second.write_all(ask).await.unwrap();
    let mut answer = String::new();
    second.read_to_string(&mut answer).await.unwrap();
    assert!(
        answer.starts_with("HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1"),
        "{answer}"
    );
    let (_, problem) = answer.split_once("\r\n\r\n").unwrap();
    assert_eq!(serde_json::from_str::<Value>(problem).unwrap()["status"], 503);
    drop((first, second));
    server.stop().await;
}

#[tokio::test]
async fn reading_an_incomplete_body_times_out() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        request_deadline_ms: 50,
        ..ServerConfig::default()
    };
    let server = run(app(dir.path(), config)).await;
    let mut client = TcpStream::connect(server.address).await.unwrap();
    let head =
        format!("POST {PLAIN} HTTP/1.1\r\nhost: a\r\ncontent-type: application/json\r\ncontent-length: 99\r\n\r\n{{");
    client.write_all(head.as_bytes()).await.unwrap();
    let mut beginning = [0; 12];
    client.read_exact(&mut beginning).await.unwrap();
    assert_eq!(&beginning, b"HTTP/1.1 408");
    drop(client);
    server.stop().await;
}

#[tokio::test]
async fn an_accepted_request_is_answered_during_shutdown() {
    let dir = tempfile::tempdir().unwrap();
    let config = with_data(dir.path(), ServerConfig::default());
    let app = start(config, vec![model(dir.path(), "slow", slow_spec())]);
    let server = run(app).await;
    let body = json!({"frames": context()}).to_string();
    let length = body.len();
    let head = format!(
        "POST /v1/models/slow/predict HTTP/1.1\r\nhost: a\r\ncontent-type: application/json\r\n\
         expect: 100-continue\r\ncontent-length: {length}\r\n\r\n"
    );
    let mut client = TcpStream::connect(server.address).await.unwrap();
    client.write_all(head.as_bytes()).await.unwrap();
    let mut interim = [0; 25];
    client.read_exact(&mut interim).await.unwrap();
    assert_eq!(&interim, b"HTTP/1.1 100 Continue\r\n\r\n");
    // The server has accepted the request; only its body is missing.
    server.shutdown.send(()).unwrap();
    client.write_all(body.as_bytes()).await.unwrap();
    let mut answer = String::new();
    client.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    tokio::time::timeout(crate::service::TIMEOUT, server.task)
        .await
        .unwrap()
        .unwrap();
}

#[tokio::test]
async fn a_model_has_a_preview_picture() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let preview = get(&app, "/v1/models/plain/preview.png").await;
    assert_eq!(preview.status, 200, "{}", String::from_utf8_lossy(&preview.body));
    assert!(codec::decode(&preview.body).unwrap().height() > 3 * HEIGHT);
    let mismatch = get(&app, "/v1/models/moving/preview.png").await.detail(422);
    assert_eq!(mismatch, "state holds 6 numbers; model \"moving\" takes 1: x m");
    assert_eq!(HORIZON, 2);
}
