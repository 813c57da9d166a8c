//! Plans with the frames of a stream: which frames get one, bad goals, and that predictions do not wait for them.

use std::path::Path;

use foreframe::server::protocol::{
    ClientMessage, Codec, ConfigureMessage, ErrorCode, FrameMessage, PingMessage, ServerMessage,
};
use foreframe::server::{App, ServerConfig, SessionPlanRequest};
use foreframe_core::nn::Conditioning;
use serde_json::{Value, json};

use crate::client::{Client, SessionHandle, numbered_frame};
use crate::service::{CONTEXT, model, post, run, spec, start, with_data};

fn moving(dir: &Path) -> App {
    let config = with_data(dir, ServerConfig::default());
    start(config, vec![model(dir, "moving", spec(Conditioning::StateAction))])
}

fn body(ahead_m: f64, solver: &Value) -> Value {
    let limits = json!([{"low": 0.0, "high": 0.5}, {"low": -0.8, "high": 0.8}]);
    json!({"format": "raw", "goal": {"position_m": [ahead_m, 0.1]}, "with_frames": true,
        "search": {"solver": solver, "limits": limits, "budget_ms": 1500}})
}

fn plans(every: Option<u64>, body: Option<Value>) -> ClientMessage {
    let request = body.map(|body| serde_json::from_value::<SessionPlanRequest>(body).unwrap());
    ClientMessage::Configure(ConfigureMessage {
        plan_every: every,
        plan_request: request.map(Box::new),
        ..ConfigureMessage::default()
    })
}

fn step(seq: u64) -> ClientMessage {
    ClientMessage::Frame(FrameMessage {
        action: Some(vec![0.2, 0.1]),
        state: Some(vec![0.25]),
        ..numbered_frame(seq)
    })
}

/// The next message, which is a plan: the `seq` of its frame, the answer, and how many were skipped.
async fn plan(client: &mut Client) -> (u64, Value, u64) {
    match client.receive().await {
        ServerMessage::Plan {
            seq, answer, skipped, ..
        } => {
            // As text, like the answer over HTTP.
            let text = serde_json::to_string(&answer).unwrap();
            (seq, untimed(serde_json::from_str(&text).unwrap()), skipped)
        }
        other => panic!("not a plan: {other:?}"),
    }
}

fn untimed(mut answer: Value) -> Value {
    answer.as_object_mut().unwrap().remove("time_ms").unwrap();
    answer
}

async fn predict(client: &mut Client, seq: u64) {
    let answer = client.ask(&step(seq)).await;
    assert!(
        matches!(answer, ServerMessage::Prediction { seq: found, .. } if found == seq),
        "{answer:?}"
    );
}

async fn open(app: &App, address: std::net::SocketAddr, codec: Codec) -> (SessionHandle, Client) {
    let session = SessionHandle::open(app, &json!({"model": "moving"})).await;
    let client = Client::connect(address, &session.path("/stream"), codec).await.unwrap();
    (session, client)
}

#[tokio::test]
async fn every_second_prediction_is_followed_by_the_plan_of_its_frame() {
    let dir = tempfile::tempdir().unwrap();
    let app = moving(dir.path());
    let server = run(app.clone()).await;
    for codec in [Codec::Json, Codec::Msgpack] {
        let (session, mut client) = open(&app, server.address, codec).await;
        let solver = json!({"samples": 64, "seed": 7});
        let configured = client.ask(&plans(Some(2), Some(body(0.5, &solver)))).await;
        assert!(matches!(configured, ServerMessage::Configured(_)), "{configured:?}");
        for seq in 0..CONTEXT as u64 - 1 {
            client.ask(&step(seq)).await;
        }
        let first = CONTEXT as u64 - 1;
        let over_http = async |ahead_m| {
            let answer = post(&app, &session.path("/plan"), &body(ahead_m, &solver)).await;
            assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
            untimed(answer.json())
        };
        predict(&mut client, first).await;
        assert_eq!(plan(&mut client).await, (first, over_http(0.5).await, 0));
        predict(&mut client, first + 1).await;
        // Another goal from here on.
        let configured = client.ask(&plans(None, Some(body(0.1, &solver)))).await;
        assert!(matches!(configured, ServerMessage::Configured(_)), "{configured:?}");
        predict(&mut client, first + 2).await;
        let (seq, answer, _) = plan(&mut client).await;
        assert_eq!((seq, &answer), (first + 2, &over_http(0.1).await));
        assert_ne!(answer["plan"]["actions"], over_http(0.5).await["plan"]["actions"]);
        client.ask(&plans(Some(0), None)).await;
        for seq in first + 3..first + 6 {
            predict(&mut client, seq).await;
        }
    }
    server.stop().await;
}

#[tokio::test]
async fn bad_plans_are_refused_with_the_field() {
    let dir = tempfile::tempdir().unwrap();
    let app = moving(dir.path());
    let server = run(app.clone()).await;
    let (_, mut client) = open(&app, server.address, Codec::Json).await;
    let with = |field: &str, value: Value| {
        let mut body = body(0.5, &json!({}));
        body[field] = value;
        body
    };
    for (every, request, detail) in [
        (
            Some(1),
            None,
            "plan_every is 1, but there is no goal; give plan_request",
        ),
        (Some(1), Some(with("goal", json!({}))), "goal is empty; give position_m"),
        (
            None,
            Some(with("search", json!({"budget_ms": 60_000}))),
            "budget_ms is 60000; it must be 1 to 10000",
        ),
        (
            Some(1),
            Some(with("goal", json!({"image": "A".repeat(1_500_000)}))),
            "goal.image has 1125000 bytes; a stream keeps at most 1048576",
        ),
        (
            Some(1),
            Some(with("search", json!({}))),
            "model \"moving\" is not calibrated, so the ranges of its actions are not known; give limits",
        ),
    ] {
        match client.ask(&plans(every, request)).await {
            ServerMessage::Error {
                code, detail: found, ..
            } => {
                assert_eq!(code, ErrorCode::Invalid);
                assert!(found.contains(detail), "{found}");
            }
            other => panic!("{other:?}"),
        }
    }
    // Nothing was taken: there are no plans.
    for seq in 0..CONTEXT as u64 + 2 {
        client.ask(&step(seq)).await;
    }
    let pong = client.ask(&ClientMessage::Ping(PingMessage::default())).await;
    assert!(matches!(pong, ServerMessage::Pong { .. }), "{pong:?}");
    client
        .send_text(r#"{"type":"configure","plan_every":1,"plan_request":{"goal":{"place":[1,1]}}}"#)
        .await;
    let refused = client.receive().await;
    assert!(
        matches!(&refused, ServerMessage::Error { code: ErrorCode::Malformed, detail, .. } if detail.contains("unknown field `place`")),
        "{refused:?}"
    );
    // An empty list is three bytes here and 24 in memory.
    let mut many = body(0.5, &json!({}));
    many["present"] = json!(vec![[0.0; 0]; 5000]);
    let many = json!({"type": "configure", "plan_every": 1, "plan_request": many});
    client.send_text(&many.to_string()).await;
    let refused = client.receive().await;
    assert!(
        matches!(&refused, ServerMessage::Error { code: ErrorCode::Malformed, detail, .. } if detail.contains("more than 4096 items")),
        "{refused:?}"
    );
    server.stop().await;
}

#[tokio::test]
async fn predictions_do_not_wait_for_a_plan_and_plans_that_are_due_meanwhile_are_counted() {
    let dir = tempfile::tempdir().unwrap();
    let app = moving(dir.path());
    let server = run(app.clone()).await;
    let (_, mut client) = open(&app, server.address, Codec::Msgpack).await;
    // Enough plans to use up the search's budget of 1.5 s.
    let long = json!({"samples": 4096, "iterations": 32});
    client.ask(&plans(Some(1), Some(body(0.5, &long)))).await;
    for seq in 0..CONTEXT as u64 - 1 {
        client.ask(&step(seq)).await;
    }
    let first = CONTEXT as u64 - 1;
    for seq in first..first + 5 {
        predict(&mut client, seq).await;
    }
    let (seq, _, skipped) = plan(&mut client).await;
    assert_eq!((seq, skipped), (first, 0));
    client
        .ask(&plans(None, Some(body(0.5, &json!({"samples": 1, "iterations": 1})))))
        .await;
    predict(&mut client, first + 5).await;
    let (seq, _, skipped) = plan(&mut client).await;
    assert_eq!((seq, skipped), (first + 5, 4));
    server.stop().await;
}
