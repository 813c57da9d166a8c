//! API keys: when a key is required, what it allows, and what happens after it is revoked or has expired.

use axum::body::Body;
use axum::http::{Request, header};
use foreframe::server::keys::{Keys, NewKey};
use foreframe::server::{App, ServerConfig};
use foreframe_jobs::store::{Author, KeyRow, KeyScope, Store, StoreConfig, StoreError, unix_s};
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::{Error, Message};

use crate::service::{Answer, TIMEOUT, app, get, run, send};

async fn app_with_keys(is_required: bool) -> (tempfile::TempDir, Store, Keys, App) {
    let dir = tempfile::tempdir().unwrap();
    let config = StoreConfig {
        data_dir: dir.path().to_owned(),
        ..StoreConfig::default()
    };
    let store = Store::open(&config).await.unwrap();
    let keys = Keys::open(store.clone(), is_required).await.unwrap();
    let app = app(dir.path(), ServerConfig::default()).with_keys(keys.clone());
    (dir, store, keys, app)
}

/// Adds a key that allows everything. Errors: also if the id exists.
pub(crate) async fn create_key(
    store: &Store,
    id: &str,
    name: &str,
    hash: &str,
    created_s: f64,
) -> Result<(), StoreError> {
    let key = KeyRow {
        id: id.to_owned(),
        name: name.to_owned(),
        hash: hash.to_owned(),
        created_s,
        revoked_s: None,
        scope: KeyScope::Admin,
        expires_s: None,
        requests_per_s: None,
    };
    store.add_key(key, &Author::CommandLine).await
}

pub(crate) async fn new_key(store: &Store, keys: &Keys) -> NewKey {
    let key = NewKey::generate().unwrap();
    create_key(store, &key.id, "robot", &key.hash, 1.0).await.unwrap();
    keys.refresh().await.unwrap();
    key
}

async fn models_with(app: &App, authorization: &str) -> Answer {
    let request = Request::get("/v1/models")
        .header(header::AUTHORIZATION, authorization)
        .body(Body::empty())
        .unwrap();
    send(app, request).await
}

#[tokio::test]
async fn authentication_starts_with_the_first_key() {
    let (_dir, store, keys, app) = app_with_keys(false).await;
    assert_eq!(get(&app, "/v1/models").await.status, 200);
    let key = new_key(&store, &keys).await;
    assert_eq!(get(&app, "/v1/models").await.status, 401);
    assert!(store.revoke_key(&key.id, 2.0, &Author::CommandLine).await.unwrap());
    keys.refresh().await.unwrap();
    // Revoking the last key does not switch authentication off.
    assert_eq!(get(&app, "/v1/models").await.status, 401);
    let (_dir, _store, _keys, app) = app_with_keys(true).await;
    assert_eq!(get(&app, "/v1/models").await.status, 401);
}

#[tokio::test]
async fn the_api_requires_a_valid_key() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let (key, other) = (new_key(&store, &keys).await, NewKey::generate().unwrap());
    let refused = get(&app, "/v1/models").await;
    assert!(refused.detail(401).contains("Authorization: Bearer KEY"));
    assert_eq!(refused.headers[header::WWW_AUTHENTICATE], "Bearer realm=\"foreframe\"");
    let secret_of_another = format!("ffk_{}_{}", key.id, other.text.rsplit('_').next().unwrap());
    for wrong in [&other.text, &secret_of_another, "nonsense", ""] {
        let refused = models_with(&app, &format!("Bearer {wrong}")).await;
        assert!(!refused.detail(401).contains("ffk_"), "{wrong}");
    }
    for _ in 0..2 {
        assert_eq!(models_with(&app, &format!("Bearer {}", key.text)).await.status, 200);
    }
    for path in ["/", "/livez", "/metrics", "/openapi.json", "/docs/"] {
        assert_eq!(get(&app, path).await.status, 200, "{path}");
    }
    assert!(store.revoke_key(&key.id, 2.0, &Author::CommandLine).await.unwrap());
    keys.refresh().await.unwrap();
    assert_eq!(models_with(&app, &format!("Bearer {}", key.text)).await.status, 401);
}

#[tokio::test]
async fn a_stream_ends_when_its_key_is_revoked() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let [key, other] = [new_key(&store, &keys).await, new_key(&store, &keys).await];
    let server = run(app).await;
    let connect = async |key: &NewKey| {
        let url = format!("ws://{}/v1/models/plain/stream", server.address);
        let mut request = url.into_client_request().unwrap();
        let authorization = format!("Bearer {}", key.text).parse().unwrap();
        request.headers_mut().insert(header::AUTHORIZATION, authorization);
        tokio_tungstenite::connect_async(request).await.unwrap().0
    };
    let (mut revoked, mut kept) = (connect(&key).await, connect(&other).await);
    assert!(store.revoke_key(&key.id, 2.0, &Author::CommandLine).await.unwrap());
    keys.refresh().await.unwrap();
    let mut messages = Vec::new();
    while let Some(Ok(message)) = tokio::time::timeout(TIMEOUT, revoked.next()).await.unwrap() {
        messages.push(message);
    }
    let [.., Message::Text(last), Message::Close(Some(close))] = &messages[..] else {
        panic!("{messages:?}");
    };
    assert!(last.contains("closing") && last.contains("revoked"), "{last}");
    assert_eq!(u16::from(close.code), 1008);
    kept.send(Message::text("{\"type\": \"ping\", \"timestamp_us\": 1}"))
        .await
        .unwrap();
    for expected in ["ready", "pong"] {
        let message = tokio::time::timeout(TIMEOUT, kept.next()).await.unwrap().unwrap();
        assert!(message.unwrap().to_text().unwrap().contains(expected));
    }
    server.stop().await;
}

#[tokio::test]
async fn an_environment_is_its_makers_alone() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let [maker, other] = [new_key(&store, &keys).await, new_key(&store, &keys).await];
    let ask = async |method: &str, path: &str, key: &NewKey| {
        let request = Request::builder()
            .method(method)
            .uri(path)
            .header(header::AUTHORIZATION, format!("Bearer {}", key.text))
            .header(header::CONTENT_TYPE, "application/json");
        let body = match path.rsplit('/').next() {
            Some("environments") => "{\"scenario\": \"static-observer\"}",
            Some("step") => "{\"action\": [0, 0]}",
            _ => "{}",
        };
        send(&app, request.body(Body::from(body)).unwrap()).await
    };
    let made = ask("POST", "/v1/environments", &maker).await;
    assert_eq!(made.status, 201);
    let path = made.headers[header::LOCATION].to_str().unwrap().to_owned();
    for (method, part, status) in [("POST", "/step", 200), ("POST", "/reset", 200), ("DELETE", "", 204)] {
        let path = format!("{path}{part}");
        let refused = ask(method, &path, &other).await.detail(404);
        assert!(refused.starts_with("there is no environment"), "{refused}");
        assert_eq!(ask(method, &path, &maker).await.status, status, "{path}");
    }
}

#[tokio::test]
async fn a_websocket_can_send_its_key_as_a_subprotocol() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let key = new_key(&store, &keys).await;
    let server = run(app).await;
    let connect = async |protocols: String| {
        let url = format!("ws://{}/v1/models/plain/stream", server.address);
        let mut request = url.into_client_request().unwrap();
        request
            .headers_mut()
            .insert("sec-websocket-protocol", protocols.parse().unwrap());
        tokio_tungstenite::connect_async(request).await
    };
    let refused = connect("foreframe.v1.json".to_owned()).await.unwrap_err();
    assert!(matches!(refused, Error::Http(answer) if answer.status() == 401));
    let (_socket, answer) = connect(format!("foreframe.v1.json, foreframe.key.{}", key.text))
        .await
        .unwrap();
    assert_eq!(answer.headers()["sec-websocket-protocol"], "foreframe.v1.json");
    server.stop().await;
}

/// A key with these limits, which the server knows.
async fn limited_key(store: &Store, keys: &Keys, limits: impl FnOnce(&mut KeyRow)) -> NewKey {
    let key = NewKey::generate().unwrap();
    let mut row = KeyRow {
        id: key.id.clone(),
        name: "limited".to_owned(),
        hash: key.hash.clone(),
        created_s: 1.0,
        revoked_s: None,
        scope: KeyScope::Admin,
        expires_s: None,
        requests_per_s: None,
    };
    limits(&mut row);
    store.add_key(row, &Author::CommandLine).await.unwrap();
    keys.refresh().await.unwrap();
    key
}

async fn send_with(app: &App, key: &NewKey, (method, path): (&str, &str), body: &Value) -> Answer {
    let request = Request::builder()
        .method(method)
        .uri(path)
        .header(header::AUTHORIZATION, format!("Bearer {}", key.text))
        .header(header::CONTENT_TYPE, "application/json");
    send(app, request.body(Body::from(body.to_string())).unwrap()).await
}

#[tokio::test]
async fn a_scope_includes_the_smaller_ones_and_no_more() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let requests = [
        (("GET", "/v1/models"), KeyScope::Predict),
        (("POST", "/v1/models/plain/predict"), KeyScope::Predict),
        (("GET", "/v1/sessions"), KeyScope::Predict),
        (("GET", "/v1/datasets"), KeyScope::Jobs),
        (("POST", "/v1/jobs"), KeyScope::Jobs),
        (("POST", "/v1/jobs/job-1/cancel"), KeyScope::Jobs),
        (("DELETE", "/v1/datasets/none"), KeyScope::Admin),
        (("POST", "/v1/models/plain/versions/1/activate"), KeyScope::Admin),
        (("DELETE", "/v1/models/plain/versions/9"), KeyScope::Admin),
        (("GET", "/v1/audit"), KeyScope::Admin),
    ];
    for scope in KeyScope::ALL {
        let key = limited_key(&store, &keys, |row| row.scope = scope).await;
        for (request, needed) in requests {
            let answer = send_with(&app, &key, request, &json!({})).await;
            if scope >= needed {
                assert!(![401, 403].contains(&answer.status.as_u16()), "{scope} {request:?}");
            } else {
                let detail = answer.detail(403);
                assert!(
                    detail.contains(&format!("scope {needed}")),
                    "{scope} {request:?}: {detail}"
                );
            }
        }
    }
}

#[tokio::test]
async fn an_expired_key_is_refused() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let valid = limited_key(&store, &keys, |row| row.expires_s = Some(unix_s() + 60.0)).await;
    let expired = limited_key(&store, &keys, |row| row.expires_s = Some(unix_s() - 1.0)).await;
    assert_eq!(
        send_with(&app, &valid, ("GET", "/v1/models"), &Value::Null)
            .await
            .status,
        200
    );
    let refused = send_with(&app, &expired, ("GET", "/v1/models"), &Value::Null).await;
    assert!(refused.detail(401).contains("expired"));
    // It expires between two reads of the keys, too.
    let soon = limited_key(&store, &keys, |row| row.expires_s = Some(unix_s() + 0.2)).await;
    tokio::time::sleep(std::time::Duration::from_millis(250)).await;
    assert_eq!(
        send_with(&app, &soon, ("GET", "/v1/models"), &Value::Null).await.status,
        401
    );
}

#[tokio::test]
async fn a_key_over_its_rate_is_told_when_to_try_again() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let slow = limited_key(&store, &keys, |row| row.requests_per_s = Some(0.01)).await;
    let other = limited_key(&store, &keys, |_| {}).await;
    assert_eq!(
        send_with(&app, &slow, ("GET", "/v1/models"), &Value::Null).await.status,
        200
    );
    // Reading the keys again does not reset what was used.
    keys.refresh().await.unwrap();
    let refused = send_with(&app, &slow, ("GET", "/v1/models"), &Value::Null).await;
    assert!(refused.detail(429).contains("0.01 requests a second"));
    let retry_after: u64 = refused.headers[header::RETRY_AFTER].to_str().unwrap().parse().unwrap();
    assert!((95..=100).contains(&retry_after), "{retry_after}");
    assert_eq!(
        send_with(&app, &other, ("GET", "/v1/models"), &Value::Null)
            .await
            .status,
        200
    );
}

#[tokio::test]
async fn each_client_has_idempotency_keys_of_its_own() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let clients = [new_key(&store, &keys).await, new_key(&store, &keys).await];
    let submit = async |key: &NewKey, name: &str| {
        let body = json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 100_000});
        let request = Request::post("/v1/jobs")
            .header("authorization", format!("Bearer {}", key.text))
            .header("content-type", "application/json")
            .header("idempotency-key", "same");
        send(&app, request.body(Body::from(body.to_string())).unwrap()).await
    };
    let ids = [
        submit(&clients[0], "a").await.json(),
        submit(&clients[1], "b").await.json(),
    ];
    assert_ne!(ids[0]["id"], ids[1]["id"]);
    assert_eq!(submit(&clients[1], "b").await.json()["id"], ids[1]["id"]);
    assert!(
        submit(&clients[1], "a")
            .await
            .detail(422)
            .contains("it was used for a different job")
    );
}

#[tokio::test]
async fn changes_are_audited_with_their_key() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let (one, other) = (new_key(&store, &keys).await, new_key(&store, &keys).await);
    let job = json!({"kind": "collect", "name": "a", "scenario": "static-observer", "trials": 100_000});
    let created = send_with(&app, &one, ("POST", "/v1/jobs"), &job).await.json();
    assert_eq!(created["submitter"], one.id);
    assert_eq!(
        send_with(&app, &other, ("POST", "/v1/jobs/job-1/cancel"), &Value::Null)
            .await
            .status,
        202
    );
    // A refused change is none.
    assert_eq!(
        send_with(&app, &other, ("DELETE", "/v1/datasets/none"), &Value::Null)
            .await
            .status,
        404
    );
    let page = send_with(&app, &one, ("GET", "/v1/audit?limit=1"), &Value::Null)
        .await
        .json();
    let entry = |page: &Value| {
        let entry = &page["entries"][0];
        ["number", "who", "name", "action", "target"].map(|field| entry[field].clone())
    };
    assert_eq!(
        entry(&page),
        [
            json!(4),
            json!(other.id),
            json!("robot"),
            json!("job.cancel"),
            json!("job-1")
        ]
    );
    assert_eq!(page["next"], 4);
    let page = send_with(&app, &one, ("GET", "/v1/audit?before=4&limit=1"), &Value::Null)
        .await
        .json();
    assert_eq!(
        entry(&page),
        [
            json!(3),
            json!(one.id),
            json!("robot"),
            json!("job.create"),
            json!("job-1")
        ]
    );
    assert!(page["entries"][0]["unix_s"].as_f64().unwrap() > 1e9);
}

#[tokio::test]
async fn a_key_sees_its_own_sessions_only() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let mut owners = Vec::new();
    for scope in [KeyScope::Predict, KeyScope::Predict, KeyScope::Admin] {
        owners.push(limited_key(&store, &keys, |row| row.scope = scope).await);
    }
    let (one, other, admin) = (&owners[0], &owners[1], &owners[2]);
    let open = json!({"model": "plain"});
    let created = send_with(&app, one, ("POST", "/v1/sessions"), &open).await.json();
    let path = format!("/v1/sessions/{}", created["id"].as_str().unwrap());
    for (key, seen) in [(one, 1), (other, 0), (admin, 1)] {
        let list = send_with(&app, key, ("GET", "/v1/sessions"), &Value::Null).await.json();
        assert_eq!(list["sessions"].as_array().unwrap().len(), seen, "{list}");
        let status = send_with(&app, key, ("GET", &path), &Value::Null).await.status;
        assert_eq!(status, if seen == 1 { 200 } else { 404 });
        // What changes a session needs its token.
        let state = format!("{path}/state");
        assert_eq!(send_with(&app, key, ("GET", &state), &Value::Null).await.status, 403);
    }
}
