//! Request bodies (JSON and forms), and exported session states.

use std::sync::LazyLock;

use foreframe::server::ServerConfig;
use proptest::prelude::*;
use proptest::sample::Index;
use serde_json::{Value, json};

use crate::corpus::{CorpusFile, files};
use crate::exclusive;
use crate::mutation::{mutated, mutations};
use crate::service::Answer;
use crate::test_service::SERVICE;

/// The environment that is stepped. When an episode ends, it is reset.
static ENVIRONMENT: LazyLock<String> = LazyLock::new(|| {
    let world = json!({"frame_width_px": 16, "frame_height_px": 12});
    let asked = json!({"scenario": "moving-observer", "world": world}).to_string();
    let answer = SERVICE.json("an environment", "/v1/environments", asked.into());
    answer.json()["id"].as_str().unwrap().to_owned()
});

/// A step of a world model; the body is read before its session is looked up.
const WORLD_STEP: &str = "/v1/realtime/sessions/none/step";

fn path(endpoint: &str) -> String {
    match endpoint {
        "predict" | "rollouts" => format!("/v1/models/moving/{endpoint}"),
        "step" => format!("/v1/environments/{}/step", *ENVIRONMENT),
        "openenv" => "/openenv/static-observer/step".to_owned(),
        other => format!("/v1/{other}"),
    }
}

/// Sends a body, and releases what the request created.
fn ask(file: &CorpusFile, bytes: Vec<u8>) -> Answer {
    let endpoint = file.part(1);
    let path = path(endpoint);
    let answer = if file.is("form") {
        SERVICE.post(&file.name, &path, "multipart/form-data; boundary=X", bytes)
    } else {
        SERVICE.json(&file.name, &path, bytes)
    };
    match (endpoint, answer.status.as_u16()) {
        ("environments", 201) => SERVICE.delete(answer.headers["location"].to_str().unwrap()),
        // Otherwise its name would stay in use.
        ("jobs", 202) => cancel(answer.json()["id"].as_str().unwrap()),
        ("step", 200) if answer.json()["truncated"] == true => reset(),
        _ => {}
    }
    answer
}

fn cancel(job: &str) {
    let path = format!("/v1/jobs/{job}/cancel");
    assert_eq!(SERVICE.json("a cancellation", &path, Vec::new()).status, 202);
}

fn reset() {
    let path = format!("/v1/environments/{}/reset", *ENVIRONMENT);
    assert_eq!(SERVICE.json("a reset", &path, b"{}".to_vec()).status, 200);
}

/// Opens a session with a state; if it is accepted, also asks for a rollout.
fn import(name: &str, state: &str) -> Answer {
    let weights = &SERVICE.app.predictor().model("moving").unwrap().weights_sha256;
    let body = format!(r#"{{"state":{}}}"#, state.replace("WEIGHTS", weights));
    let answer = SERVICE.json(name, "/v1/sessions", body.into());
    if answer.status == 201 {
        let session = answer.json();
        let text = |field: &str| session[field].as_str().unwrap().to_owned();
        let path = |rest| format!("/v1/sessions/{}{rest}?token={}", text("id"), text("token"));
        let plans = json!({"plans": [[[0.5, 0.0], [0.0, 0.5]]], "format": "raw"}).to_string();
        let ahead = SERVICE.json(name, &path("/rollouts"), plans.into());
        let expected = if session["have"] == session["need"] { 200 } else { 409 };
        assert_eq!(ahead.status, expected, "{name}");
        SERVICE.delete(&path(""));
    }
    answer
}

fn assert_status(file: &CorpusFile, answer: &Answer) {
    let text = String::from_utf8_lossy(&answer.body);
    assert_eq!(answer.status.as_str(), file.part(0), "{}: {text}", file.name);
}

#[test]
fn corpus_bodies_get_the_status_in_their_name() {
    let _alone = exclusive();
    for file in files("bodies") {
        assert_status(&file, &ask(&file, file.bytes.clone()));
    }
}

#[test]
fn corpus_states_get_the_status_in_their_name() {
    let _alone = exclusive();
    for file in files("states") {
        let text = String::from_utf8(file.bytes.clone()).unwrap();
        assert_status(&file, &import(&file.name, &text));
    }
}

proptest! {
    #[test]
    fn mutated_bodies_get_a_documented_status(which: Index, mutations in mutations()) {
        let _alone = exclusive();
        let files = files("bodies");
        let file = which.get(&files);
        ask(file, mutated(&file.bytes, &mutations));
    }

    #[test]
    fn mutated_states_are_accepted_or_refused(which: Index, mutations in mutations()) {
        let _alone = exclusive();
        let files = files("states");
        let file = which.get(&files);
        import(&file.name, &String::from_utf8_lossy(&mutated(&file.bytes, &mutations)));
    }
}

#[test]
fn request_memory_is_bounded_by_the_body_length() {
    let _alone = exclusive();
    let filled = |head: &str, item: &str, bytes: usize| head.to_owned() + &item.repeat(bytes / item.len());
    let long = 1 << 20;
    for (path, body) in [
        ("/v1/models/moving/predict", filled(r#"{"actions":["#, "[],", long)),
        ("/v1/models/moving/predict", filled(r#"{"frames":["#, r#""","#, long)),
        ("/v1/models/moving/predict", filled(r#"{"state":["#, "0,", long)),
        ("/v1/models/moving/predict", filled(r#"{"colour":["#, "0,", long)),
        ("/v1/models/moving/rollouts", filled(r#"{"plans":["#, "[],", long)),
        ("/v1/models/moving/rollouts", filled(r#"{"plans":[["#, "[],", long)),
        (
            "/v1/sessions",
            filled(r#"{"state":{"snapshot":{"features":["#, "[],", long),
        ),
        (
            "/v1/sessions",
            filled(r#"{"state":{"snapshot":{"actions":["#, "[],", long),
        ),
        (
            "/v1/jobs",
            filled(r#"{"kind":"train","settings":{"a":["#, "0,", 60 << 10),
        ),
        ("/v1/jobs", filled(r#"{"settings":{"a":["#, "{},", 60 << 10)),
        ("/v1/jobs", filled(r#"{"colour":["#, "0,", long)),
        ("/v1/environments", filled(r#"{"scenario":["#, "0,", long)),
        (WORLD_STEP, filled(r#"{"observation":{"images":{"a":["#, "0,", long)),
        (WORLD_STEP, filled(r#"{"observation":{"images":{"a":["#, "[],", long)),
        (WORLD_STEP, filled(r#"{"observation":{"extra":{"colour":["#, "0,", long)),
        ("/openenv/crowded/step", filled(r#"{"action":{"action":["#, "0,", long)),
    ] {
        let refused = SERVICE.json(&body[..40], path, body.clone().into()).status.as_u16();
        assert!([400, 413, 422].contains(&refused), "{refused}: {}", &body[..40]);
    }
}

#[test]
fn a_job_over_the_size_limit_is_refused() {
    let _alone = exclusive();
    let limit = ServerConfig::default().max_job_bytes;
    let settings: Value = (0..limit / 8).map(|number| (format!("s{number}"), json!(0))).collect();
    let asked = json!({"kind": "train", "name": "a", "preset": "paper", "dataset": "none", "settings": settings});
    let answer = SERVICE.json("a long job", "/v1/jobs", asked.to_string().into());
    let detail = answer.detail(413);
    assert!(
        detail.starts_with("the body is longer than this server takes"),
        "{detail}"
    );
}
