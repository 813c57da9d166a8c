//! Sessions: reconnection, expiry, access tokens, and export and import of their state.

use std::time::Duration;

use axum::body::Body;
use axum::http::Request;
use foreframe::server::ServerConfig;
use foreframe::server::protocol::{ClientMessage, ClosingReason, Codec, ErrorCode, ServerMessage};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::Error;

use crate::client::{Client, SessionHandle, numbered_frame, numbered_message};
use crate::service::{CONTEXT, app, get, poll_until, post, run, send};

const MOVING: &str = r#"{"model": "moving"}"#;

pub(crate) fn moving() -> Value {
    serde_json::from_str(MOVING).unwrap()
}

pub(crate) fn frames(message: &ServerMessage) -> &[foreframe::server::ImageBytes] {
    match message {
        ServerMessage::Prediction { frames, .. } => frames,
        other => panic!("{other:?}"),
    }
}

pub(crate) fn code(message: &ServerMessage) -> (ErrorCode, u64) {
    match message {
        ServerMessage::Error { code, next_seq, .. } => (*code, *next_seq),
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_session_continues_after_reconnecting() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let (broken, whole) = (
        SessionHandle::open(&app, &moving()).await,
        SessionHandle::open(&app, &moving()).await,
    );
    let mut reference = Client::connect(server.address, &whole.path("/stream"), Codec::Json)
        .await
        .unwrap();
    for seq in 0..6 {
        // Each frame over a new socket, in alternating sub-protocols.
        let codec = [Codec::Json, Codec::Msgpack][seq as usize % 2];
        let mut client = Client::connect(server.address, &broken.path("/stream"), codec)
            .await
            .unwrap();
        assert_eq!(client.next_seq, seq);
        let (answer, expected) = (
            client.ask(&numbered_message(seq)).await,
            reference.ask(&numbered_message(seq)).await,
        );
        if seq + 1 < CONTEXT as u64 {
            assert_eq!(answer, expected);
        } else {
            assert_eq!(frames(&answer), frames(&expected));
        }
    }
    let state = |session: &SessionHandle| {
        let path = session.path("/state");
        let app = app.clone();
        async move { get(&app, &path).await.json() }
    };
    assert_eq!(state(&broken).await, state(&whole).await);
    let described = get(&app, &format!("/v1/sessions/{}", whole.id)).await.json();
    assert_eq!(
        (&described["next_seq"], &described["connected"]),
        (&json!(6), &json!(true))
    );
    assert!(described.get("token").is_none());
    drop(reference);
    server.stop().await;
}

#[tokio::test]
async fn a_new_connection_replaces_the_old_one() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    let path = session.path("/stream");
    let mut older = Client::connect(server.address, &path, Codec::Msgpack).await.unwrap();
    older.ask(&numbered_message(0)).await;
    let mut newer = Client::connect(server.address, &path, Codec::Msgpack).await.unwrap();
    assert_eq!(newer.next_seq, 1);
    assert_eq!(older.end().await, (Some(ClosingReason::Replaced), Some(1008)));
    assert!(matches!(
        newer.ask(&numbered_message(1)).await,
        ServerMessage::Buffering { have: 2, .. }
    ));
    let gone = Request::delete(session.path("")).body(Body::empty()).unwrap();
    assert_eq!(send(&app, gone).await.status, 204);
    assert_eq!(newer.end().await, (Some(ClosingReason::Deleted), Some(1000)));
    get(&app, &format!("/v1/sessions/{}", session.id)).await.detail(404);
    server.stop().await;
}

#[tokio::test]
async fn session_state_requires_the_token() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    assert!(session.token.len() >= 32 && session.id.len() >= 32);
    for (path, status) in [
        (format!("/v1/sessions/{}/state", session.id), 403),
        (format!("/v1/sessions/{}/state?token=guess", session.id), 403),
        (format!("/v1/sessions/none/state?token={}", session.token), 404),
    ] {
        get(&app, &path).await.detail(status);
    }
    let by_header =
        Request::get(format!("/v1/sessions/{}/state", session.id)).header("x-session-token", &session.token);
    assert_eq!(send(&app, by_header.body(Body::empty()).unwrap()).await.status, 200);
    let path = format!("/v1/sessions/{}/stream?token=guess", session.id);
    let Error::Http(refused) = *Client::connect(server.address, &path, Codec::Json).await.err().unwrap() else {
        panic!()
    };
    assert_eq!(refused.status(), 403);
    server.stop().await;
}

#[tokio::test]
async fn an_unused_session_expires_and_is_answered_410() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        session_grace_ms: 50,
        max_sessions: 1,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    let mut client = Client::connect(server.address, &session.path("/stream"), Codec::Json)
        .await
        .unwrap();
    tokio::time::sleep(Duration::from_millis(80)).await;
    // While its stream is open, the session does not expire and counts towards the limit.
    assert!(matches!(
        client.ask(&numbered_message(0)).await,
        ServerMessage::Buffering { .. }
    ));
    let full = post(&app, "/v1/sessions", &moving()).await;
    assert_eq!(full.detail(503), "1 sessions are open already; try again later");
    assert_eq!(full.headers["retry-after"], "1");
    drop(client);
    let path = session.path("/state");
    // A request with the token would count as use.
    let peek = format!("/v1/sessions/{}", session.id);
    poll_until(async || (get(&app, &peek).await.status == 410).then_some(())).await;
    assert!(
        get(&app, &path)
            .await
            .detail(410)
            .contains("was not used for 50 ms and has expired")
    );
    get(&app, "/v1/sessions/another").await.detail(404);
    SessionHandle::open(&app, &moving()).await;
    server.stop().await;
}

#[tokio::test]
async fn sessions_are_listed_in_pages() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    for _ in 0..5 {
        SessionHandle::open(&app, &moving()).await;
    }
    let (mut after, mut seen) = (String::new(), Vec::new());
    loop {
        let page = get(&app, &format!("/v1/sessions?limit=2&after={after}")).await.json();
        seen.extend(
            page["sessions"]
                .as_array()
                .unwrap()
                .iter()
                .map(|session| session["id"].clone()),
        );
        match page["next"].as_str() {
            Some(next) => after = next.to_owned(),
            None => break,
        }
    }
    assert_eq!(seen.len(), 5);
    assert!(seen.is_sorted_by_key(|id| id.as_str().unwrap().to_owned()));
    assert_eq!(
        get(&app, "/v1/sessions?limit=0").await.detail(422),
        "limit is 0; it must be 1 to 1000"
    );
    get(&app, "/v1/sessions?colour=red").await.detail(422);
}

#[tokio::test]
async fn an_exported_state_continues_on_another_server() {
    let (here, there) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (first, second) = (
        app(here.path(), ServerConfig::default()),
        app(there.path(), ServerConfig::default()),
    );
    let (old, new) = (run(first.clone()).await, run(second.clone()).await);
    let session = SessionHandle::open(&first, &moving()).await;
    let mut client = Client::connect(old.address, &session.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    for seq in 0..5 {
        client.ask(&numbered_message(seq)).await;
    }
    let state = get(&first, &session.path("/state")).await.json();
    let last = client.ask(&numbered_message(4)).await;
    let next = client.ask(&numbered_message(5)).await;

    let moved = SessionHandle::open(&second, &json!({"state": state})).await;
    assert_eq!(get(&second, &moved.path("/state")).await.json(), state);
    let mut client = Client::connect(new.address, &moved.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    assert_eq!(client.next_seq, 5);
    // The exported state has no cached answer: the server computes it again, and `next_seq` does not change.
    assert_eq!(frames(&client.ask(&numbered_message(4)).await), frames(&last));
    assert_eq!(frames(&client.ask(&numbered_message(5)).await), frames(&next));
    old.stop().await;
    new.stop().await;
}

#[tokio::test]
async fn an_invalid_state_is_refused_with_the_field() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let session = SessionHandle::open(&app, &moving()).await;
    let mut client = Client::connect(server.address, &session.path("/stream"), Codec::Json)
        .await
        .unwrap();
    client.ask(&numbered_message(0)).await;
    let mut state = get(&app, &session.path("/state")).await.json();
    state["snapshot"]["past_errors"] = json!([[0.5, 1.0]]);
    for (pointer, value, status, detail) in [
        ("/weights_sha256", json!("00"), 409, "here version 1"),
        ("/model", json!("none"), 404, "there is no model"),
        ("/snapshot/next_seq", json!(0), 422, "state.snapshot.next_seq is 0"),
        (
            "/snapshot/features",
            json!(vec![vec![0.0; 8]; 4]),
            422,
            "state.snapshot.features holds 4 frames",
        ),
        (
            "/snapshot/features/0",
            json!([0.5]),
            422,
            "state.snapshot.features[0] holds 1 numbers",
        ),
        (
            "/snapshot/features/0/2",
            json!(1.5),
            422,
            "state.snapshot.features[0][2] is 1.5",
        ),
        ("/snapshot/actions", json!([]), 422, "actions holds 0 actions"),
        ("/snapshot/state", json!([1, 2, 3]), 422, "state holds 3 numbers"),
        (
            "/snapshot/past_errors",
            json!([[0.5, 1.0], [8.0, 1.0]]),
            422,
            "state.snapshot.past_errors[1] is not possible",
        ),
        (
            "/snapshot/past_errors",
            json!(vec![[0.5, 1.0]; 3]),
            422,
            "past_errors[2] is not possible: the model predicts 2 steps",
        ),
        ("/on_gap", json!("dance"), 422, "state.on_gap: unknown variant `dance`"),
    ] {
        let mut changed = state.clone();
        *changed.pointer_mut(pointer).unwrap() = value;
        let found = post(&app, "/v1/sessions", &json!({"state": changed}))
            .await
            .detail(status);
        assert!(found.contains(detail), "{pointer}: {found}");
    }
    let found = post(&app, "/v1/sessions", &json!({"state": state, "model": "plain"}))
        .await
        .detail(422);
    assert!(found.contains("the state is of \"moving\""), "{found}");
    let found = post(&app, "/v1/sessions", &json!({})).await.detail(422);
    assert!(found.starts_with("model is missing"), "{found}");
    server.stop().await;
}

#[tokio::test]
async fn a_session_says_once_that_its_camera_is_not_used() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let camera = json!({"horizontal_fov_rad": 1.0, "tilt_down_rad": 0.1});
    let opened = SessionHandle::open(&app, &json!({"model": "plain", "camera": camera})).await;
    let server = run(app).await;
    let path = opened.path("/stream");
    let mut client = Client::connect(server.address, &path, Codec::Json).await.unwrap();
    let mut said = Vec::new();
    for seq in 0..CONTEXT as u64 + 2 {
        let mut frame = numbered_frame(seq);
        (frame.action, frame.state) = (None, None);
        if let ServerMessage::Prediction { warnings, .. } = client.ask(&ClientMessage::Frame(frame)).await {
            said.push(warnings);
        }
    }
    let expected = "camera is not used: the model \"plain\" does not estimate depth".to_owned();
    assert_eq!(said, [vec![expected], Vec::new(), Vec::new()]);
    server.stop().await;
}
