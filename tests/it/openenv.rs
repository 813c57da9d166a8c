//! `OpenEnv`'s interface on the wire; `tests/python/openenv_client.py` uses the client that its users have.

use std::net::SocketAddr;

use axum::body::Body;
use axum::http::Request;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::ServerConfig;
use foreframe::server::keys::Keys;
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::{Error, Message};

use crate::client::Socket;
use crate::keys::new_key;
use crate::service::{TIMEOUT, app, get, poll_until, post, run, send, store};

const ENVIRONMENT: &str = "/openenv/static-observer";

struct Trainer(Socket);

impl Trainer {
    async fn connect(address: SocketAddr) -> Result<Self, Box<Error>> {
        let url = format!("ws://{address}{ENVIRONMENT}/ws");
        Ok(Self(tokio_tungstenite::connect_async(url).await.map_err(Box::new)?.0))
    }

    async fn receive(&mut self) -> Message {
        tokio::time::timeout(TIMEOUT, self.0.next())
            .await
            .unwrap()
            .unwrap()
            .unwrap()
    }

    async fn ask_with(&mut self, message: Message) -> Value {
        self.0.send(message).await.unwrap();
        match self.receive().await {
            Message::Text(text) => serde_json::from_str(&text).unwrap(),
            other => panic!("{other:?}"),
        }
    }

    async fn ask(&mut self, message: Value) -> Value {
        self.ask_with(Message::text(message.to_string())).await
    }

    async fn step(&mut self) -> Value {
        self.ask(json!({"type": "step", "data": {"action": [0.2, 0.0]}})).await
    }

    /// The code and the words of a refusal.
    async fn refused(&mut self, message: Message) -> (String, String) {
        let answer = self.ask_with(message).await;
        assert_eq!(answer["type"], "error", "{answer}");
        let text = |field: &str| answer["data"][field].as_str().unwrap().to_owned();
        (text("code"), text("message"))
    }
}

#[tokio::test]
async fn a_socket_has_an_environment_of_its_own() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let mut trainer = Trainer::connect(server.address).await.unwrap();
    let before = trainer.ask(json!({"type": "state"})).await;
    let state = json!({"episode_id": null, "step_count": 0, "scenario": "static-observer"});
    assert_eq!(before, json!({"type": "state", "data": state}));
    let reset = json!({"type": "reset", "data": {"seed": 3, "episode_id": "mine", "other": 1}});
    let first = trainer.ask(reset.clone()).await;
    assert_eq!(
        (&first["type"], &first["data"]["done"]),
        (&json!("observation"), &json!(false))
    );
    assert_eq!(first["data"]["reward"], Value::Null);
    let second = trainer.step().await;
    assert!(second["data"]["reward"].is_number());
    let after = trainer.ask(json!({"type": "state"})).await;
    assert_eq!(
        (&after["data"]["episode_id"], &after["data"]["step_count"]),
        (&json!("mine"), &json!(1))
    );

    let created = post(
        &app,
        "/v1/environments",
        &json!({"scenario": "static-observer", "seed": 3}),
    )
    .await
    .json();
    assert_eq!(first["data"]["observation"]["frame"], created["observation"]["frame"]);
    let mut other = Trainer::connect(server.address).await.unwrap();
    assert_eq!(other.ask(reset).await, first);
    assert_eq!(other.step().await, second);
    other.0.send(Message::text(r#"{"type":"close"}"#)).await.unwrap();
    assert!(matches!(other.receive().await, Message::Close(Some(frame)) if u16::from(frame.code) == 1000));
}

#[tokio::test]
async fn a_bad_message_is_refused_with_a_code_and_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), ServerConfig::default())).await;
    let mut trainer = Trainer::connect(server.address).await.unwrap();
    let step = Message::text(r#"{"type":"step","data":{"action":[0,0]}}"#);
    let (code, words) = trainer.refused(step).await;
    assert_eq!(code, "EXECUTION_ERROR");
    assert!(words.contains("has not been reset"), "{words}");
    trainer.ask(json!({"type": "reset"})).await;
    let long = format!(r#"{{"type":"reset","data":{{"episode_id":"{}"}}}}"#, "a".repeat(256));
    for (message, expected, contained) in [
        ("{", "INVALID_JSON", "EOF"),
        ("", "INVALID_JSON", "EOF"),
        ("[]", "VALIDATION_ERROR", "invalid length"),
        ("{}", "VALIDATION_ERROR", "type"),
        (r#"{"type":"jump"}"#, "UNKNOWN_TYPE", "must be reset"),
        (r#"{"type":"step"}"#, "VALIDATION_ERROR", "action is missing"),
        (
            r#"{"type":"step","data":{"action":"left"}}"#,
            "VALIDATION_ERROR",
            "invalid type",
        ),
        (r#"{"type":"step","data":{"action":[1]}}"#, "VALIDATION_ERROR", "action"),
        (r#"{"type":"reset","data":{"seed":-1}}"#, "VALIDATION_ERROR", "seed"),
        (&long, "VALIDATION_ERROR", "256 letters"),
    ] {
        let (code, words) = trainer.refused(Message::text(message.to_owned())).await;
        assert_eq!(code, expected, "{message}: {words}");
        assert!(words.contains(contained), "{words}");
    }
    assert_eq!(trainer.refused(Message::binary(vec![0])).await.0, "INVALID_JSON");
    assert!(trainer.step().await["data"]["reward"].is_number());
}

#[tokio::test]
async fn the_limits_of_environments_hold() {
    let config = ServerConfig {
        max_environments: 1,
        environment_evict_ms: 0,
        ..ServerConfig::default()
    };
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), config)).await;
    let mut first = Trainer::connect(server.address).await.unwrap();
    let mut second = Trainer::connect(server.address).await.unwrap();
    first.ask(json!({"type": "reset"})).await;
    second.ask(json!({"type": "reset"})).await;
    // The second took the place of the first, which can begin again.
    let (code, words) = first
        .refused(Message::text(r#"{"type":"step","data":{"action":[0,0]}}"#))
        .await;
    assert_eq!(code, "SESSION_ERROR");
    assert!(words.contains("there is no environment"), "{words}");
    assert_eq!(first.ask(json!({"type": "reset"})).await["type"], "observation");
    assert!(first.step().await["data"]["reward"].is_number());
}

#[tokio::test]
async fn a_full_table_refuses_a_socket_until_another_one_ends() {
    let config = ServerConfig {
        max_environments: 1,
        ..ServerConfig::default()
    };
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), config)).await;
    let mut first = Trainer::connect(server.address).await.unwrap();
    let mut second = Trainer::connect(server.address).await.unwrap();
    first.ask(json!({"type": "reset"})).await;
    let (code, words) = second.refused(Message::text(r#"{"type":"reset"}"#)).await;
    assert_eq!(code, "CAPACITY_REACHED");
    assert!(words.contains("1 environments are in use"), "{words}");
    drop(first);
    poll_until(async || (second.ask(json!({"type": "reset"})).await["type"] == "observation").then_some(())).await;
}

#[tokio::test]
async fn requests_describe_an_environment_and_begin_one_each() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let path = |rest: &str| format!("{ENVIRONMENT}/{rest}");
    let reset = post(&app, &path("reset"), &json!({"seed": 3})).await.json();
    let fields: Vec<&String> = reset.as_object().unwrap().keys().collect();
    assert_eq!(fields, ["done", "observation", "reward"]);
    let step = post(&app, &path("step"), &json!({"action": {"action": [0.0, 0.0]}}))
        .await
        .json();
    assert!(step["reward"].is_number());
    post(&app, &path("step"), &json!({"action": {"action": [0.0]}}))
        .await
        .detail(422);
    assert_eq!(get(&app, &path("state")).await.json()["step_count"], 0);
    assert_eq!(get(&app, &path("health")).await.json(), json!({"status": "healthy"}));
    assert_eq!(get(&app, &path("metadata")).await.json()["name"], "static-observer");
    let schema = get(&app, &path("schema")).await.json();
    for name in schema["observation"]["required"].as_array().unwrap() {
        assert!(reset["observation"].get(name.as_str().unwrap()).is_some(), "{name}");
    }
    assert_eq!(schema["action"]["properties"]["action"]["minItems"], 2);
    for listed in get(&app, &path("openapi.json")).await.json()["paths"]
        .as_object()
        .unwrap()
        .keys()
    {
        assert_ne!(get(&app, &path(&listed[1..])).await.status, 404, "{listed}");
    }
    assert_eq!(get(&app, &path("ws")).await.status, 426);
    get(&app, "/openenv/moon/state").await.detail(404);
}

#[tokio::test]
async fn tools_are_listed_by_the_rules_of_json_rpc() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let call = async |body: &str| {
        let request = Request::post(format!("{ENVIRONMENT}/mcp")).header("content-type", "application/json");
        send(&app, request.body(Body::from(body.to_owned())).unwrap()).await
    };
    let list = call(r#"{"jsonrpc": "2.0", "id": null, "method": "tools/list"}"#)
        .await
        .json();
    assert_eq!(list, json!({"jsonrpc": "2.0", "id": null, "result": {"tools": []}}));
    for (body, id, code) in [
        (
            r#"{"jsonrpc": "2.0", "id": 1, "method": "tools/call"}"#,
            json!(1),
            -32601,
        ),
        (r#"{"jsonrpc": "2.0", "id": "#, json!(null), -32700),
        (r#"{"id": 1, "method": "tools/list"}"#, json!(null), -32600),
        (
            r#"{"jsonrpc": "2.0", "id": [1], "method": "tools/list"}"#,
            json!(null),
            -32600,
        ),
        ("[]", json!(null), -32600),
    ] {
        let answer = call(body).await.json();
        assert_eq!((&answer["id"], &answer["error"]["code"]), (&id, &json!(code)), "{body}");
    }
    let notification = call(r#"{"jsonrpc": "2.0", "method": "notifications/initialized"}"#).await;
    assert_eq!((notification.status.as_u16(), notification.body.len()), (202, 0));
}

#[tokio::test]
async fn a_key_can_be_the_password_of_an_address() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path());
    let keys = Keys::open(store.clone(), true).await.unwrap();
    let app = app(dir.path(), ServerConfig::default()).with_keys(keys.clone());
    let key = new_key(&store, &keys).await;
    let ask = async |credentials: String| {
        let authorization = format!("Basic {}", STANDARD.encode(credentials));
        let request = Request::get(format!("{ENVIRONMENT}/state")).header("authorization", authorization);
        send(&app, request.body(Body::empty()).unwrap()).await.status
    };
    assert_eq!(ask(format!("robot:{}", key.text)).await, 200);
    assert_eq!(ask(format!(":{}", key.text)).await, 200);
    assert_eq!(ask(key.text.clone()).await, 401);
    assert_eq!(ask("robot:ffk_wrong".to_owned()).await, 401);
    assert_eq!(get(&app, &format!("{ENVIRONMENT}/state")).await.status, 401);
}
