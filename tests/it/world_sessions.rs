//! World models as environments, as vLLM-Omni's sessions; `tests/python/world_model_env.py` uses that package's own classes.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::keys::Keys;
use foreframe::server::{App, ServerConfig};
use foreframe_core::frame::codec;
use serde_json::{Value, json};

use crate::keys::new_key;
use crate::service::{Answer, CONTEXT, HEIGHT, HORIZON, WIDTH, app, context, frame, get, post, send, store};

const SESSIONS: &str = "/v1/realtime/sessions";

async fn open(app: &App) -> String {
    let opened = post(app, SESSIONS, &json!({"model": "moving"})).await;
    assert_eq!(
        (opened.status.as_u16(), &opened.json()["mode"]),
        (200, &json!("world_model_env"))
    );
    let id = opened.json()["session_id"].as_str().unwrap().to_owned();
    let session = format!("{SESSIONS}/{id}");
    // Load balancers learn from it where the session is.
    assert_eq!(opened.headers["location"], session.as_str());
    session
}

/// Step of that number: the frame of that number, in the model's size.
fn step_body(number: usize) -> Value {
    let frame = frame(number as u8 * 10);
    let rows: Vec<&[u8]> = frame.pixels().chunks(WIDTH as usize).collect();
    json!({
        "step_id": number,
        "observation": {"images": {"front": rows}, "state": [0.5], "prompt": "ignored"},
        "action": {"joint_positions": [0.5, -0.5]},
    })
}

async fn step(app: &App, session: &str, body: &Value) -> Answer {
    post(app, &format!("{session}/step"), body).await
}

async fn status(app: &App, session: &str) -> (Value, Value, Value) {
    let mut status = get(app, &format!("{session}/status")).await.json();
    let mut take = |field: &str| status[field].take();
    (take("committed_step_id"), take("context_length"), take("closed"))
}

#[tokio::test]
async fn steps_gather_a_context_and_give_the_prediction_of_a_request() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let session = open(&app).await;
    assert_eq!(status(&app, &session).await, (json!(-1), json!(0), json!(false)));
    for number in 0..CONTEXT - 1 {
        let answer = step(&app, &session, &step_body(number)).await;
        assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
        assert_eq!(answer.json()["next_observation"], Value::Null);
    }
    let answer = step(&app, &session, &step_body(CONTEXT - 1)).await.json();
    let next = &answer["next_observation"];
    assert_eq!(next["shape"], json!([HORIZON, HEIGHT, WIDTH]));
    let video = STANDARD.decode(next["video"].as_str().unwrap()).unwrap();
    let request = json!({"frames": context(), "state": [0.5], "plan": [[0.5, -0.5], [0.5, -0.5]], "format": "png"});
    let expected = post(&app, "/v1/models/moving/predict", &request).await.json();
    let pixels = |image: &Value| {
        let file = STANDARD.decode(image.as_str().unwrap()).unwrap();
        codec::decode(&file).unwrap().into_pixels()
    };
    let expected: Vec<u8> = expected["frames"].as_array().unwrap().iter().flat_map(pixels).collect();
    assert_eq!(video, expected);
    let about = &answer["model_metadata"];
    assert_eq!(
        (&about["steps_generated"], &about["committed_step_id"]),
        (&json!(HORIZON), &json!(CONTEXT - 1))
    );
    assert_eq!(answer["error"], Value::Null);
}

#[tokio::test]
async fn a_refused_step_has_a_code_and_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let session = open(&app).await;
    assert_eq!(step(&app, &session, &step_body(0)).await.status, 200);
    let with = |place: &str, value: Value| {
        let mut body = step_body(1);
        *body.pointer_mut(place).unwrap() = value;
        body
    };
    let mut stateless = step_body(1);
    stateless["use_session_context"] = json!(false);
    for (body, code, words) in [
        (step_body(0), "step_already_committed", "step 1 is next"),
        (step_body(2), "step_out_of_order", "step 1 is next"),
        (stateless, "invalid_request", "predicts from 3"),
        (with("/observation/images", json!({})), "invalid_request", "one image"),
        (
            with("/observation/images", json!({"a": [[1]], "b": [[1]]})),
            "invalid_request",
            "one image",
        ),
        (
            with("/observation/images/front", json!([[1, 2]])),
            "invalid_request",
            "takes 16×12",
        ),
        (
            with("/observation/images/front", json!([1, 2])),
            "invalid_request",
            "has the shape [2]",
        ),
        (
            with("/observation/images/front", json!([[300]])),
            "invalid_request",
            "holds 300",
        ),
        (
            with("/observation/state", Value::Null),
            "invalid_request",
            "state is missing",
        ),
        (
            with("/action/joint_positions", json!([1.0])),
            "invalid_request",
            "action holds 1 numbers",
        ),
        (
            with("/action", json!({"extra": {"plan": [[0, 0]]}})),
            "invalid_request",
            "plan",
        ),
    ] {
        let answer = step(&app, &session, &body).await;
        assert_eq!(answer.status, 400, "{body}");
        let error = &answer.json()["error"];
        assert_eq!(
            (&error["code"], &error["committed_step_id"]),
            (&json!(code), &json!(0)),
            "{error}"
        );
        assert!(
            error["message"].as_str().unwrap().contains(words),
            "{error}; expected {words}"
        );
    }
    for body in [
        json!({}),
        with("/observation/images/front", json!([[1], [1, 2]])),
        with("/step_id", json!(-1)),
    ] {
        assert!(!step(&app, &session, &body).await.detail(422).is_empty());
    }
    assert_eq!(status(&app, &session).await, (json!(0), json!(1), json!(false)));
    assert_eq!(step(&app, &session, &step_body(1)).await.status, 200);
}

#[tokio::test]
async fn a_session_is_reset_and_closed() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let session = open(&app).await;
    let mut with_gripper = step_body(0);
    with_gripper["action"] = json!({"joint_positions": [0.5], "gripper_position": -0.5});
    with_gripper["observation"]["images"]["front"] = json!(vec![vec![[9; 3]; 30]; 20]);
    with_gripper["observation"]["extra"] = json!({"resize": "stretch"});
    assert_eq!(step(&app, &session, &with_gripper).await.status, 200);
    let post_to = async |what: &str| post(&app, &format!("{session}/{what}"), &json!({})).await;
    assert_eq!(post_to("reset").await.json()["committed_step_id"], -1);
    assert_eq!(step(&app, &session, &step_body(0)).await.status, 200);
    for _ in 0..2 {
        assert_eq!(post_to("close").await.json()["closed"], true);
    }
    assert_eq!(status(&app, &session).await, (json!(0), json!(1), json!(true)));
    let refused = step(&app, &session, &step_body(1)).await;
    assert_eq!(
        (refused.status.as_u16(), &refused.json()["error"]["code"]),
        (410, &json!("session_closed"))
    );
    post_to("reset").await.detail(410);
}

#[tokio::test]
async fn sessions_are_bounded_and_belong_to_their_key() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path());
    let keys = Keys::open(store.clone(), true).await.unwrap();
    let config = ServerConfig {
        max_environments: 1,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config).with_keys(keys.clone());
    let (maker, other) = (new_key(&store, &keys).await, new_key(&store, &keys).await);
    let ask = async |key: &str, path: &str, body: Value| {
        let request = axum::http::Request::post(path)
            .header("authorization", format!("Bearer {key}"))
            .header("content-type", "application/json");
        send(&app, request.body(axum::body::Body::from(body.to_string())).unwrap()).await
    };
    ask("ffk_wrong", SESSIONS, json!({"model": "moving"})).await.detail(401);
    ask(&maker.text, SESSIONS, json!({"model": "nothing"}))
        .await
        .detail(404);
    ask(
        &maker.text,
        SESSIONS,
        json!({"model": "moving", "mode": "policy_inference"}),
    )
    .await
    .detail(422);
    let opened = ask(&maker.text, SESSIONS, json!({"model": "moving"})).await.json();
    let path = format!("{SESSIONS}/{}/step", opened["session_id"].as_str().unwrap());
    ask(&maker.text, SESSIONS, json!({"model": "moving"})).await.detail(503);
    let refused = ask(&other.text, &path, step_body(0)).await;
    assert_eq!(
        (refused.status.as_u16(), &refused.json()["error"]["code"]),
        (404, &json!("session_not_found"))
    );
    assert_eq!(ask(&maker.text, &path, step_body(0)).await.status, 200);
}

#[tokio::test]
async fn a_step_that_cannot_be_computed_now_says_why_and_when_to_try_again() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let session = open(&app).await;
    app.predictor().stop();
    let refused = step(&app, &session, &step_body(0)).await;
    assert_eq!(
        (refused.status.as_u16(), &refused.json()["error"]["message"]),
        (503, &json!("the predictor has stopped"))
    );
    assert_eq!(refused.headers["retry-after"], "1");
}
