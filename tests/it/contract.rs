//! What all answers of the service have in common: its contract, one shape of refusals, ids, readiness.

use axum::body::Body;
use axum::http::Request;
use foreframe::server::{ServerConfig, openapi};
use serde_json::{Value, json};

use crate::service::{app, get, post, post_text, send, until};

const PLAIN: &str = "/v1/models/plain/predict";

#[tokio::test]
async fn what_is_no_request_of_this_service_is_refused_in_one_shape() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let json = "*/*";
    assert!(
        post_text(&app, PLAIN, "{\"frames\":".to_owned(), json)
            .await
            .detail(400)
            .contains("JSON")
    );
    let infinite = post(&app, PLAIN, &json!({"frames": [], "state": [1e39]}))
        .await
        .detail(400);
    assert!(infinite.contains("state[0]: number out of range"), "{infinite}");
    let unknown = post(&app, PLAIN, &json!({"frames": [], "colour": 1})).await.detail(422);
    assert!(unknown.contains("unknown field `colour`"), "{unknown}");
    let untyped = Request::post(PLAIN).body(Body::from("{}")).unwrap();
    assert!(send(&app, untyped).await.detail(415).contains("application/json"));
    assert!(get(&app, PLAIN).await.detail(405).contains("openapi.json"));
    assert!(get(&app, "/nothing").await.detail(404).contains("openapi.json"));
    let none = get(&app, "/v1/models/movin").await.detail(404);
    assert_eq!(none, "no model is named \"movin\"; there are: moving, plain");
    assert!(
        get(&app, "/v1/models/plain/stream")
            .await
            .detail(426)
            .contains("WebSocket")
    );
}

#[tokio::test]
async fn every_answer_carries_the_requests_id() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let request = |id: &str| {
        Request::get("/nothing")
            .header("x-request-id", id)
            .body(Body::empty())
            .unwrap()
    };
    let own = send(&app, request("robot-7")).await;
    assert_eq!(
        (own.detail(404), own.headers["x-request-id"].to_str().unwrap()),
        (own.detail(404), "robot-7")
    );
    let odd = send(&app, request("a b\"c")).await;
    assert_ne!(odd.headers["x-request-id"], "a b\"c");
    assert_ne!(
        get(&app, "/livez").await.headers["x-request-id"],
        odd.headers["x-request-id"]
    );
}

#[tokio::test]
async fn the_server_is_ready_once_its_models_are_warm() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    assert_eq!(get(&app, "/livez").await.status, 200);
    until(async || (get(&app, "/readyz").await.status == 200).then_some(())).await;
    let models = get(&app, "/v1/models").await.json();
    let names: Vec<&Value> = models["models"]
        .as_array()
        .unwrap()
        .iter()
        .map(|model| &model["name"])
        .collect();
    assert_eq!(names, ["moving", "plain"]);
    let moving = get(&app, "/v1/models/moving").await.json();
    assert_eq!(moving["spec"]["conditioning"], "state-action");
    assert_eq!(moving["spec"]["actions"][1]["unit"], "rad/s");
    let page = get(&app, "/").await;
    let page = String::from_utf8(page.body).unwrap();
    for file in ["/dashboard.js", "/dashboard.css"] {
        assert!(page.contains(file));
        assert_eq!(get(&app, file).await.status, 200);
    }
}

#[test]
fn the_committed_contract_is_the_codes() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi/openapi.json");
    let document = openapi::document();
    if std::env::var_os("UPDATE_OPENAPI").is_some() {
        std::fs::write(path, &document).unwrap();
    }
    let committed = std::fs::read_to_string(path).unwrap_or_default();
    assert!(
        committed == document,
        "openapi/openapi.json differs from the code; write it anew by\n  \
         UPDATE_OPENAPI=1 cargo test --release --test it the_committed_contract_is_the_codes"
    );
}

#[tokio::test]
async fn every_path_of_the_contract_is_answered() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let contract = get(&app, "/openapi.json").await.json();
    assert!(contract["openapi"].as_str().unwrap().starts_with("3.1"));
    for (path, methods) in contract["paths"].as_object().unwrap() {
        for method in methods.as_object().unwrap().keys() {
            let path = path.replace("{model}", "plain").replace("{id}", "job-9");
            let method = method.to_uppercase();
            let request = Request::builder()
                .method(method.as_str())
                .uri(&path)
                .body(Body::empty())
                .unwrap();
            let answer = send(&app, request).await;
            let text = String::from_utf8_lossy(&answer.body).into_owned();
            assert!(
                answer.status != 405 && !text.contains("nothing at this path"),
                "{method} {path}: {text}"
            );
        }
    }
}
