//! Common to all responses of the service: the API contract, problem details, request ids, readiness.

use std::collections::BTreeMap;

use axum::body::Body;
use axum::http::Request;
use foreframe::server::{App, ServerConfig, openapi_document};
use foreframe_core::nn::spec::MAX_STEPS;
use serde_json::{Value, json};

use crate::service::{app, get, poll_until, post, post_text, send};

const PLAIN: &str = "/v1/models/plain/predict";

#[tokio::test]
async fn invalid_requests_are_answered_with_problem_details() {
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
    assert_eq!(none, "there is no model \"movin\"; there are: moving, plain");
    assert!(
        get(&app, "/v1/models/plain/stream")
            .await
            .detail(426)
            .contains("WebSocket")
    );
}

#[tokio::test]
async fn every_response_has_a_request_id() {
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
async fn the_server_is_ready_after_warming_its_models() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    assert_eq!(get(&app, "/livez").await.status, 200);
    poll_until(async || (get(&app, "/readyz").await.status == 200).then_some(())).await;
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
    let files = page.split('"').filter(|text| text.starts_with("/page/"));
    for file in files.chain(["/page/dream.js", "/page/what_if.js"]) {
        assert_eq!(get(&app, file).await.status, 200, "{file}");
    }
}

#[test]
fn the_committed_openapi_document_is_current() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi/openapi.json");
    let document = openapi_document();
    if std::env::var_os("UPDATE_OPENAPI").is_some() {
        std::fs::write(path, &document).unwrap();
    }
    let committed = std::fs::read_to_string(path).unwrap_or_default();
    assert!(
        committed == document,
        "openapi/openapi.json differs from the code; update it with\n  \
         UPDATE_OPENAPI=1 cargo test --release --test it the_committed_openapi_document_is_current"
    );
}

#[test]
fn the_openapi_document_says_limits_that_are_constants() {
    let document: Value = serde_json::from_str(&openapi_document()).unwrap();
    let schemas = &document["components"]["schemas"];
    for schema in [
        "ActionExtra",
        "PlanSearch",
        "PredictRequest",
        "RolloutRequest",
        "SessionRolloutRequest",
        "SessionSnapshot",
    ] {
        let steps = &schemas[schema]["properties"]["steps"];
        assert_eq!(
            (&steps["minimum"], &steps["maximum"]),
            (&json!(1), &json!(MAX_STEPS)),
            "{schema}"
        );
    }
    for schema in ["PlanRequest", "SessionPlanRequest"] {
        assert_eq!(
            schemas[schema]["properties"]["present"]["maxItems"], MAX_STEPS,
            "{schema}"
        );
    }
    let position = &schemas["PlanGoal"]["properties"]["position_m"];
    assert_eq!((&position["minItems"], &position["maxItems"]), (&json!(2), &json!(2)));
}

#[tokio::test]
async fn the_contracts_are_served_and_describe_refusals() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    assert!(get(&app, "/asyncapi.yaml").await.body.starts_with(b"asyncapi: 3"));
    let contract = get(&app, "/openapi.json").await.json();
    let predict = &contract["paths"]["/v1/models/{model}/predict"]["post"]["responses"];
    for status in ["401", "404", "422", "503"] {
        let content = predict[status]["content"].as_object().unwrap();
        assert_eq!(
            content.keys().collect::<Vec<_>>(),
            ["application/problem+json"],
            "{status}"
        );
    }
    assert_eq!(predict["503"]["headers"]["Retry-After"]["schema"]["type"], "integer");
    let refused = get(&app, "/v1/models/none").await;
    assert_eq!(refused.headers["content-type"], "application/problem+json");
}

#[tokio::test]
async fn lists_are_paged() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let (mut seen, mut after) = (Vec::new(), String::new());
    loop {
        let page = get(&app, &format!("/v1/models?limit=1&after={after}")).await.json();
        let models = page["models"].as_array().unwrap();
        assert_eq!(models.len(), 1);
        seen.push(models[0]["name"].as_str().unwrap().to_owned());
        match page["next"].as_str() {
            Some(next) => after = next.to_owned(),
            None => break,
        }
    }
    let all = get(&app, "/v1/models").await.json();
    let all: Vec<&str> = all["models"]
        .as_array()
        .unwrap()
        .iter()
        .map(|model| model["name"].as_str().unwrap())
        .collect();
    assert!(all.len() > 1 && seen == all, "{seen:?} {all:?}");
    for path in ["/v1/models", "/v1/datasets", "/v1/sessions", "/v1/jobs"] {
        let refused = get(&app, &format!("{path}?limit=0")).await;
        assert!(refused.detail(422).contains("it must be 1 to 1000"), "{path}");
    }
}

#[tokio::test]
async fn wrong_types_are_refused_with_an_explanation() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let list = post(&app, "/v1/sessions", &json!(["plain"])).await.detail(422);
    assert!(list.contains("expected an object"), "{list}");
    let path = post(&app, "/v1/models/plain/versions/x/activate", &Value::Null).await;
    assert_eq!(
        path.detail(400),
        "\"x\" in the path is not a whole number, or too large"
    );
}

#[tokio::test]
async fn every_documented_path_exists() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let contract = get(&app, "/openapi.json").await.json();
    assert!(contract["openapi"].as_str().unwrap().starts_with("3.1"));
    let paths = contract["paths"].as_object().unwrap();
    // The answer of the events ends with the server.
    for (path, methods) in paths.iter().filter(|(path, _)| *path != "/v1/events") {
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

#[tokio::test]
async fn every_example_of_the_contract_succeeds() {
    let dir = tempfile::tempdir().unwrap();
    // The shipped models, which the examples name.
    let config = ServerConfig {
        data_dir: dir.path().to_owned(),
        ..ServerConfig::default()
    };
    let app = App::open(config).await.unwrap();
    let contract = get(&app, "/openapi.json").await.json();
    let mut ids = BTreeMap::new();
    let mut token: Option<String> = None;
    let mut bodies = 0;
    // The order of paths lets `/v1/sessions` create what `/v1/sessions/{id}/rollouts` needs.
    for (path, methods) in contract["paths"].as_object().unwrap() {
        let operation = &methods["post"];
        let Some(content) = operation["requestBody"]["content"].get("application/json") else {
            continue;
        };
        let parameters = operation["parameters"].as_array().into_iter().flatten();
        let model = parameters
            .clone()
            .find(|parameter| parameter["name"] == "model")
            .map_or("", |parameter| parameter["example"].as_str().unwrap());
        let resource = path.split('/').nth(2).unwrap();
        let id = ids.get(resource).map_or("", String::as_str);
        let address = path.replace("{model}", model).replace("{id}", id);
        let address = match (resource, &token) {
            ("sessions", Some(token)) => format!("{address}?token={token}"),
            _ => address,
        };
        let ask = async || post(&app, &address, &content["example"]).await;
        let answer = match path.as_str() {
            // The data set that it names is being collected by the example before it.
            "/v1/jobs/estimate" => poll_until(async || Some(ask().await).filter(|answer| answer.status != 422)).await,
            _ => ask().await,
        };
        let text = String::from_utf8_lossy(&answer.body).into_owned();
        // A new session has no frames yet; the contract says so.
        if ["/v1/sessions/{id}/rollouts", "/v1/sessions/{id}/plan"].contains(&path.as_str()) {
            assert!(operation["responses"]["409"].is_object());
            assert_eq!(answer.status, 409, "{path}: {text}");
        } else {
            assert!(answer.status.is_success(), "{path}: {text}");
            let created = answer.json();
            if let Some(id) = created["id"].as_str().or(created["session_id"].as_str()) {
                ids.insert(resource.to_owned(), id.to_owned());
                token = token.or_else(|| answer.json()["token"].as_str().map(str::to_owned));
            }
        }
        bodies += 1;
    }
    assert_eq!(bodies, 13);
}

#[tokio::test]
async fn without_a_model_the_server_says_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        data_dir: dir.path().to_owned(),
        models_dir: dir.path().join("none"),
        ..ServerConfig::default()
    };
    let app = App::open(config).await.unwrap();
    // Training jobs can run without a model, so the server is ready.
    assert_eq!(get(&app, "/readyz").await.status, 200);
    let models = get(&app, "/v1/models").await.json();
    let detail = models["notice"].as_str().unwrap();
    assert!(
        detail.starts_with("no model found in ") && detail.contains("POST /v1/jobs"),
        "{detail}"
    );
    let dir = tempfile::tempdir().unwrap();
    let full = self::app(dir.path(), ServerConfig::default());
    assert!(get(&full, "/v1/models").await.json().get("notice").is_none());
}
