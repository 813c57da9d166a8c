//! Predictions and rollouts with `MessagePack` bodies.

use axum::body::Body;
use axum::http::{Request, header};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::protocol::Codec;
use foreframe::server::{App, ImageBytes, ServerConfig};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::client::{Client, SessionHandle, numbered_message};
use crate::service::{Answer, CONTEXT, app, frame, post, post_text, run, send};
use crate::sessions::moving;

const MSGPACK: &str = "application/msgpack";
const PREDICT: &str = "/v1/models/moving/predict";
const ROLLOUTS: &str = "/v1/models/moving/rollouts";

#[derive(Clone, Serialize)]
struct PackedBody {
    frames: Vec<ImageBytes>,
    format: &'static str,
    state: Vec<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    plan: Option<Vec<[f32; 2]>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    plans: Option<Vec<Vec<[f32; 2]>>>,
}

#[derive(Deserialize)]
struct Predicted {
    model: String,
    frames: Vec<ImageBytes>,
    format: String,
}

#[derive(Deserialize)]
struct RolledOut {
    rollouts: Vec<Vec<ImageBytes>>,
}

fn body() -> PackedBody {
    PackedBody {
        frames: (0..CONTEXT as u8)
            .map(|index| ImageBytes(frame(index * 10).pixels().to_vec()))
            .collect(),
        format: "raw",
        state: vec![0.5],
        plan: Some(vec![[0.5, -0.5]; 2]),
        plans: None,
    }
}

async fn send_bytes(app: &App, path: &str, body: Vec<u8>, accept: &str) -> Answer {
    let request = Request::post(path)
        .header(header::CONTENT_TYPE, MSGPACK)
        .header(header::ACCEPT, accept);
    send(app, request.body(Body::from(body)).unwrap()).await
}

async fn send_packed(app: &App, path: &str, body: &impl Serialize, accept: &str) -> Answer {
    send_bytes(app, path, rmp_serde::to_vec_named(body).unwrap(), accept).await
}

fn base64(images: &[ImageBytes]) -> Value {
    images.iter().map(|image| STANDARD.encode(&image.0)).collect()
}

#[tokio::test]
async fn a_body_is_msgpack_in_both_directions_or_in_one() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let body = body();
    // As JSON, whose images are base64.
    let text =
        json!({"frames": base64(&body.frames), "format": "raw", "state": [0.5], "plan": [[0.5, -0.5], [0.5, -0.5]]});
    let expected = post(&app, PREDICT, &text).await.json();

    let packed = send_packed(&app, PREDICT, &body, MSGPACK).await;
    assert_eq!(packed.headers[header::CONTENT_TYPE], MSGPACK);
    let found: Predicted = rmp_serde::from_slice(&packed.body).unwrap();
    assert_eq!((found.model.as_str(), found.format.as_str()), ("moving", "raw"));
    assert_eq!(base64(&found.frames), expected["frames"]);

    let sent_packed = send_packed(&app, PREDICT, &body, "application/json").await.json();
    assert_eq!(sent_packed["frames"], expected["frames"]);
    let got_packed = post_text(&app, PREDICT, text.to_string(), MSGPACK).await;
    let found: Predicted = rmp_serde::from_slice(&got_packed.body).unwrap();
    assert_eq!(base64(&found.frames), expected["frames"]);
}

#[tokio::test]
async fn rollouts_of_a_model_and_a_session_are_msgpack() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let plans: Vec<Vec<[f32; 2]>> = (0..20).map(|index| vec![[index as f32 / 8.0, 1.0]; 2]).collect();
    let body = PackedBody {
        plan: None,
        plans: Some(plans.clone()),
        ..body()
    };
    let text = json!({"frames": base64(&body.frames), "format": "raw", "state": [0.5], "plans": plans});
    let expected = post(&app, ROLLOUTS, &text).await.json();
    let packed = send_packed(&app, ROLLOUTS, &body, MSGPACK).await;
    let found: RolledOut = rmp_serde::from_slice(&packed.body).unwrap();
    let rollouts: Vec<Value> = found.rollouts.iter().map(|images| base64(images)).collect();
    assert_eq!(json!(rollouts), expected["rollouts"]);
    let as_text = post(&app, ROLLOUTS, &text).await.body.len();
    assert!(
        packed.body.len() * 5 < as_text * 4,
        "{} of {as_text}",
        packed.body.len()
    );

    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    let path = session.path("/stream");
    let mut client = Client::connect(server.address, &path, Codec::Msgpack).await.unwrap();
    for seq in 0..CONTEXT as u64 {
        client.ask(&numbered_message(seq)).await;
    }
    let request = json!({"plans": plans, "format": "raw"});
    let packed = send_packed(&app, &session.path("/rollouts"), &request, MSGPACK).await;
    let found: RolledOut = rmp_serde::from_slice(&packed.body).unwrap();
    let expected = post(&app, &session.path("/rollouts"), &request).await.json();
    assert_eq!(base64(&found.rollouts[7]), expected["rollouts"][7]);
    drop(client);
    server.stop().await;
}

#[tokio::test]
async fn errors_are_problem_details() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let whole = rmp_serde::to_vec_named(&body()).unwrap();
    for damaged in [&whole[..whole.len() - 1], &[]] {
        let detail = send_bytes(&app, PREDICT, damaged.to_vec(), MSGPACK).await.detail(400);
        assert!(detail.starts_with("the body is not MessagePack"), "{detail}");
    }
    let longer = [&whole[..], &[0]].concat();
    let detail = send_bytes(&app, PREDICT, longer, MSGPACK).await.detail(400);
    assert!(detail.contains("bytes follow it"), "{detail}");
    for (wrong, part) in [
        (json!({"colour": 1}), "unknown field `colour`"),
        (json!([[], "raw"]), "expected an object"),
        (json!(7), "expected an object"),
        (json!({"state": "far"}), "state: invalid type: string"),
        (json!({"frames": ["AAAA"]}), "frames[0]"),
        (json!({"format": "bmp"}), "unknown variant `bmp`"),
    ] {
        let detail = send_packed(&app, PREDICT, &wrong, MSGPACK).await.detail(422);
        assert!(detail.contains(part), "{detail}");
    }
    let few = PackedBody {
        frames: Vec::new(),
        ..body()
    };
    send_packed(&app, PREDICT, &few, MSGPACK).await.detail(422);
    let request = Request::post(PREDICT).header(header::CONTENT_TYPE, "application/x-unknown");
    let detail = send(&app, request.body(Body::empty()).unwrap()).await.detail(415);
    assert!(detail.contains("application/msgpack"), "{detail}");
}

#[tokio::test]
async fn limits_and_numbers_are_those_of_json() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_body_bytes: 2048,
        max_frames: CONTEXT,
        max_plans: 2,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let plans = |count: usize| PackedBody {
        plan: None,
        plans: Some(vec![vec![[0.5, -0.5]; 2]; count]),
        ..body()
    };
    assert_eq!(send_packed(&app, ROLLOUTS, &plans(2), MSGPACK).await.status, 200);
    send_packed(&app, ROLLOUTS, &plans(3), MSGPACK).await.detail(413);
    let mut many = body();
    many.frames.push(many.frames[0].clone());
    let detail = send_packed(&app, PREDICT, &many, MSGPACK).await.detail(413);
    assert!(detail.starts_with("frames holds 4"), "{detail}");
    send_bytes(&app, PREDICT, vec![0; 2049], MSGPACK).await.detail(413);
    for number in [f32::NAN, f32::INFINITY, 2e30] {
        let state = PackedBody {
            state: vec![number],
            ..body()
        };
        let detail = send_packed(&app, PREDICT, &state, MSGPACK).await.detail(422);
        assert!(detail.starts_with("state"), "{detail}");
        let plan = PackedBody {
            plan: Some(vec![[0.5, number]; 2]),
            ..body()
        };
        let detail = send_packed(&app, PREDICT, &plan, MSGPACK).await.detail(422);
        assert!(detail.starts_with("plan[0]"), "{detail}");
    }
}
