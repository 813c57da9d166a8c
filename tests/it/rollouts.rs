//! Rollouts: many plans from one context. Also predictions from image files in a form.

use std::pin::pin;

use axum::body::Body;
use axum::http::{Request, header};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::protocol::Codec;
use foreframe::server::{App, ServerConfig};
use foreframe_core::frame::codec;
use foreframe_core::nn::{Conditioning, ModelSpec};
use serde_json::{Value, json};

use crate::client::{Client, SessionHandle, numbered_frame, numbered_message};
use crate::service::{
    Answer, CONTEXT, HEIGHT, WIDTH, app, context, frame, model, post, post_text, run, send, slow_spec, start, with_data,
};

const ROLLOUTS: &str = "/v1/models/moving/rollouts";
const PLAIN_PREDICT: &str = "/v1/models/plain/predict";

fn plans(count: usize) -> Vec<Value> {
    (0..count)
        .map(|index| {
            let value = index as f32 / 8.0 - 3.0;
            json!([[value, -value], [value / 2.0, 1.0]])
        })
        .collect()
}

fn pixels(image: &Value) -> Vec<u8> {
    STANDARD.decode(image.as_str().unwrap()).unwrap()
}

/// The largest absolute difference between two lists of raw images.
fn largest_pixel_difference(a: &Value, b: &Value) -> u8 {
    let (a, b) = (a.as_array().unwrap(), b.as_array().unwrap());
    assert_eq!(a.len(), b.len());
    let pairs = a.iter().zip(b).flat_map(|(a, b)| pixels(a).into_iter().zip(pixels(b)));
    pairs.map(|(a, b)| a.abs_diff(b)).max().unwrap()
}

#[tokio::test]
async fn batched_rollouts_equal_single_predictions() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let raw: Vec<String> = (0..CONTEXT as u8)
        .map(|i| STANDARD.encode(frame(i * 10).pixels()))
        .collect();
    let plans = plans(300);
    let body = json!({"frames": raw, "format": "raw", "state": [0.5], "plans": plans});
    let answer = post(&app, ROLLOUTS, &body).await.json();
    let rollouts = answer["rollouts"].as_array().unwrap();
    assert_eq!((rollouts.len(), &answer["format"]), (300, &json!("raw")));
    for index in [0, 1, 150, 299] {
        let body = json!({"frames": raw, "format": "raw", "state": [0.5], "plan": plans[index]});
        let alone = post(&app, "/v1/models/moving/predict", &body).await.json();
        assert!(largest_pixel_difference(&rollouts[index], &alone["frames"]) <= 1);
    }
    assert!(largest_pixel_difference(&rollouts[0], &rollouts[299]) > 0);
}

#[tokio::test]
async fn other_requests_are_answered_during_a_large_rollout() {
    let dir = tempfile::tempdir().unwrap();
    let spec = ModelSpec {
        conditioning: Conditioning::StateAction,
        ..slow_spec()
    };
    let config = with_data(dir.path(), ServerConfig::default());
    let app = start(config, vec![model(dir.path(), "slow", spec)]);
    let rollouts = json!({"frames": context(), "state": [0.5], "plans": plans(300)});
    let mut rollouts = pin!(post(&app, "/v1/models/slow/rollouts", &rollouts));
    let single = json!({"frames": context(), "state": [0.5], "actions": [[0.0, 0.0]]});
    let mut answered = 0;
    loop {
        tokio::select! {
            answer = &mut rollouts => break assert_eq!(answer.status, 200),
            answer = post(&app, "/v1/models/slow/predict", &single) => answered += usize::from(answer.status == 200),
        }
    }
    // If the rollout ran as one batch, only one or two single predictions could be answered.
    assert!(answered > 4, "{answered} answered");
}

#[tokio::test]
async fn rollouts_are_answered_as_png_or_gif() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let body = |count| json!({"frames": context(), "state": [0.5], "plans": plans(count)}).to_string();
    let sheet = post_text(&app, ROLLOUTS, body(4), "image/png").await;
    let sheet = codec::decode(&sheet.body).unwrap();
    assert!(sheet.width() > CONTEXT as u32 * WIDTH && sheet.height() > 5 * HEIGHT);
    let gif = post_text(&app, ROLLOUTS, body(4), "image/gif").await;
    assert_eq!(gif.headers[header::CONTENT_TYPE], "image/gif");
    assert!(gif.body.starts_with(b"GIF89a"));
    let many = post_text(&app, ROLLOUTS, body(400), "image/png").await;
    assert_eq!(
        many.detail(406),
        "the picture would be too large; ask for application/json"
    );
}

#[tokio::test]
async fn invalid_plans_are_refused_with_the_field() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_plans: 8,
        max_rollout_bytes: 4 * 2 * (WIDTH * HEIGHT) as usize,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let with = |plans: Value| json!({"frames": context(), "state": [0.5], "plans": plans});
    for (body, status, detail) in [
        (with(json!([])), 422, "plans is empty; give at least one plan"),
        (
            with(json!([[[0, 0]]])),
            422,
            "plans[0] holds 1 actions; model \"moving\" takes 2",
        ),
        (
            with(json!([[[0, 0], [0, 0]], [[0, 0], [0]]])),
            422,
            "plans[1][1] holds 1 numbers; model \"moving\" takes 2: linear m/s, angular rad/s",
        ),
        (
            with(json!(plans(9))),
            413,
            "plans holds 9; this server takes at most 8 in a request",
        ),
        (
            with(json!(plans(5))),
            413,
            "the rollouts would be 1920 bytes of images; this server predicts at most 1536 in a request",
        ),
    ] {
        assert_eq!(post(&app, ROLLOUTS, &body).await.detail(status), detail);
    }
    let unconditioned = post(&app, "/v1/models/plain/rollouts", &with(json!(plans(2))))
        .await
        .detail(422);
    assert!(
        unconditioned.starts_with("model \"plain\" takes no actions"),
        "{unconditioned}"
    );
}

#[tokio::test]
async fn session_rollouts_equal_stateless_rollouts() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &json!({"model": "moving"})).await;
    let path = session.path("/rollouts");
    let body = json!({"plans": plans(20), "format": "raw"});
    let mut client = Client::connect(server.address, &session.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    for seq in 0..CONTEXT as u64 {
        let early = post(&app, &path, &body).await.detail(409);
        assert_eq!(
            early,
            format!("the session has {seq} of the 3 frames that a prediction takes; send more frames")
        );
        client.ask(&numbered_message(seq)).await;
    }
    let rollouts = post(&app, &path, &body).await.json();
    let raw: Vec<String> = (0..CONTEXT as u64)
        .map(|seq| STANDARD.encode(&numbered_frame(seq).image.0))
        .collect();
    let state = numbered_frame(CONTEXT as u64 - 1).state;
    let stateless = json!({"frames": raw, "format": "raw", "state": state, "plans": plans(20)});
    let stateless = post(&app, ROLLOUTS, &stateless).await.json();
    for (found, expected) in rollouts["rollouts"]
        .as_array()
        .unwrap()
        .iter()
        .zip(stateless["rollouts"].as_array().unwrap())
    {
        assert!(largest_pixel_difference(found, expected) <= 1);
    }
    let gif = post_text(&app, &path, body.to_string(), "image/gif").await;
    assert!(gif.body.starts_with(b"GIF89a"));
    drop(client);
    server.stop().await;
}

async fn post_form(app: &App, path: &str, parts: &[(&str, &[u8])]) -> Answer {
    let mut body = Vec::new();
    for (name, content) in parts {
        let head = format!("--edge\r\nContent-Disposition: form-data; name=\"{name}\"; filename=\"a\"\r\n\r\n");
        body.extend(head.as_bytes());
        body.extend(*content);
        body.extend(b"\r\n");
    }
    body.extend(b"--edge--\r\n");
    let request = Request::post(path).header(header::CONTENT_TYPE, "multipart/form-data; boundary=edge");
    send(app, request.body(Body::from(body)).unwrap()).await
}

#[tokio::test]
async fn multipart_and_json_give_the_same_prediction() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let files: Vec<Vec<u8>> = (0..CONTEXT as u8)
        .map(|i| codec::encode_png(&frame(i * 10)).unwrap())
        .collect();
    let mut parts: Vec<(&str, &[u8])> = files.iter().map(|file| ("frames", file.as_slice())).collect();
    let plain = PLAIN_PREDICT;
    let by_json = post(&app, plain, &json!({"frames": context()})).await.json();
    assert_eq!(post_form(&app, plain, &parts).await.json()["frames"], by_json["frames"]);

    let inputs = json!({"state": [0.5], "actions": [[1.0, 2.0]]});
    let mut body = inputs.clone();
    body["frames"] = json!(context());
    let by_json = post(&app, "/v1/models/moving/predict", &body).await.json();
    let inputs = inputs.to_string();
    parts.push(("request", inputs.as_bytes()));
    let by_form = post_form(&app, "/v1/models/moving/predict", &parts).await.json();
    assert_eq!(by_form["frames"], by_json["frames"]);
}

#[tokio::test]
async fn invalid_multipart_forms_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_frames: 4,
        ..ServerConfig::default()
    };
    let (app, plain) = (app(dir.path(), config), PLAIN_PREDICT);
    let odd = post_form(&app, plain, &[("image", &b"x"[..])]).await.detail(422);
    assert_eq!(odd, "the form has a part \"image\"; there are frames and request");
    let many = post_form(&app, plain, &[("frames", &b"x"[..]); 5]).await.detail(413);
    assert_eq!(many, "frames holds 5; this server takes at most 4 in a request");
    let unknown = post_form(&app, plain, &[("request", &b"{\"colour\": 1}"[..])])
        .await
        .detail(422);
    assert!(unknown.contains("request: unknown field `colour`"), "{unknown}");
    let half = Request::post(plain).header(header::CONTENT_TYPE, "multipart/form-data; boundary=edge");
    let half = half
        .body(Body::from(
            "--edge\r\nContent-Disposition: form-data; name=\"frames\"\r\n\r\nabc",
        ))
        .unwrap();
    send(&app, half).await.detail(400);
}
