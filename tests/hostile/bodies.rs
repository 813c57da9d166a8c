//! Bodies of requests, JSON and forms, and the state that a session is imported from.

use std::sync::LazyLock;

use foreframe::server::ServerConfig;
use proptest::prelude::*;
use proptest::sample::Index;
use serde_json::{Value, json};

use crate::alone;
use crate::corpus::{Sample, samples};
use crate::mutation::{mutated, mutations};
use crate::service::Answer;
use crate::world::WORLD;

/// An environment that is stepped; where an episode ends, the next begins.
static ENVIRONMENT: LazyLock<String> = LazyLock::new(|| {
    let world = json!({"frame_width_px": 16, "frame_height_px": 12});
    let asked = json!({"scenario": "moving-observer", "world": world}).to_string();
    let answer = WORLD.json("an environment", "/v1/environments", asked.into());
    answer.json()["id"].as_str().unwrap().to_owned()
});

fn path(endpoint: &str) -> String {
    match endpoint {
        "predict" | "rollouts" => format!("/v1/models/moving/{endpoint}"),
        "step" => format!("/v1/environments/{}/step", *ENVIRONMENT),
        other => format!("/v1/{other}"),
    }
}

/// Asks, and gives back what was taken.
fn ask(sample: &Sample, bytes: Vec<u8>) -> Answer {
    let endpoint = sample.part(1);
    let path = path(endpoint);
    let answer = if sample.is("form") {
        WORLD.post(&sample.name, &path, "multipart/form-data; boundary=X", bytes)
    } else {
        WORLD.json(&sample.name, &path, bytes)
    };
    match (endpoint, answer.status.as_u16()) {
        ("environments", 201) => WORLD.delete(answer.headers["location"].to_str().unwrap()),
        // Or its name would be taken.
        ("jobs", 202) => cancel(answer.json()["id"].as_str().unwrap()),
        ("step", 200) if answer.json()["truncated"] == true => reset(),
        _ => {}
    }
    answer
}

fn cancel(job: &str) {
    let path = format!("/v1/jobs/{job}/cancel");
    assert_eq!(WORLD.json("a cancellation", &path, Vec::new()).status, 202);
}

fn reset() {
    let path = format!("/v1/environments/{}/reset", *ENVIRONMENT);
    assert_eq!(WORLD.json("a reset", &path, b"{}".to_vec()).status, 200);
}

/// Opens a session with a state; where it is taken, it also predicts from there.
fn import(name: &str, state: &str) -> Answer {
    let weights = &WORLD.app.predictor().model("moving").unwrap().weights_sha256;
    let body = format!(r#"{{"state":{}}}"#, state.replace("WEIGHTS", weights));
    let answer = WORLD.json(name, "/v1/sessions", body.into());
    if answer.status == 201 {
        let session = answer.json();
        let text = |field: &str| session[field].as_str().unwrap().to_owned();
        let path = |rest| format!("/v1/sessions/{}{rest}?token={}", text("id"), text("token"));
        let candidates = json!({"candidates": [[[0.5, 0.0], [0.0, 0.5]]], "format": "raw"}).to_string();
        let ahead = WORLD.json(name, &path("/rollouts"), candidates.into());
        let expected = if session["have"] == session["need"] { 200 } else { 409 };
        assert_eq!(ahead.status, expected, "{name}");
        WORLD.delete(&path(""));
    }
    answer
}

fn assert_status(sample: &Sample, answer: &Answer) {
    let text = String::from_utf8_lossy(&answer.body);
    assert_eq!(answer.status.as_str(), sample.part(0), "{}: {text}", sample.name);
}

#[test]
fn corpus_bodies_get_the_status_in_their_name() {
    let _alone = alone();
    for sample in samples("bodies") {
        assert_status(&sample, &ask(&sample, sample.bytes.clone()));
    }
}

#[test]
fn corpus_states_get_the_status_in_their_name() {
    let _alone = alone();
    for sample in samples("states") {
        let text = String::from_utf8(sample.bytes.clone()).unwrap();
        assert_status(&sample, &import(&sample.name, &text));
    }
}

proptest! {
    #[test]
    fn mutated_bodies_get_a_documented_status(which: Index, mutations in mutations()) {
        let _alone = alone();
        let samples = samples("bodies");
        let sample = which.get(&samples);
        ask(sample, mutated(&sample.bytes, &mutations));
    }

    #[test]
    fn mutated_states_are_accepted_or_refused(which: Index, mutations in mutations()) {
        let _alone = alone();
        let samples = samples("states");
        let sample = which.get(&samples);
        import(&sample.name, &String::from_utf8_lossy(&mutated(&sample.bytes, &mutations)));
    }
}

#[test]
fn request_memory_is_bounded_by_the_body_length() {
    let _alone = alone();
    let filled = |head: &str, item: &str, bytes: usize| head.to_owned() + &item.repeat(bytes / item.len());
    let long = 1 << 20;
    for (path, body) in [
        ("/v1/models/moving/predict", filled(r#"{"actions":["#, "[],", long)),
        ("/v1/models/moving/predict", filled(r#"{"frames":["#, r#""","#, long)),
        ("/v1/models/moving/predict", filled(r#"{"state":["#, "0,", long)),
        ("/v1/models/moving/predict", filled(r#"{"colour":["#, "0,", long)),
        ("/v1/models/moving/rollouts", filled(r#"{"candidates":["#, "[],", long)),
        ("/v1/models/moving/rollouts", filled(r#"{"candidates":[["#, "[],", long)),
        (
            "/v1/sessions",
            filled(r#"{"state":{"memory":{"features":["#, "[],", long),
        ),
        (
            "/v1/sessions",
            filled(r#"{"state":{"memory":{"actions":["#, "[],", long),
        ),
        (
            "/v1/jobs",
            filled(r#"{"kind":"train","settings":{"a":["#, "0,", 60 << 10),
        ),
        ("/v1/jobs", filled(r#"{"settings":{"a":["#, "{},", 60 << 10)),
        ("/v1/jobs", filled(r#"{"colour":["#, "0,", long)),
        ("/v1/environments", filled(r#"{"scenario":["#, "0,", long)),
    ] {
        let refused = WORLD.json(&body[..40], path, body.clone().into()).status.as_u16();
        assert!([400, 413, 422].contains(&refused), "{refused}: {}", &body[..40]);
    }
}

#[test]
fn a_job_over_the_size_limit_is_refused() {
    let _alone = alone();
    let limit = ServerConfig::default().max_job_bytes;
    let settings: Value = (0..limit / 8).map(|number| (format!("s{number}"), json!(0))).collect();
    let asked = json!({"kind": "train", "name": "a", "preset": "paper", "dataset": "none", "settings": settings});
    let answer = WORLD.json("a long job", "/v1/jobs", asked.to_string().into());
    assert_eq!(answer.detail(413), "the body is longer than this server takes");
}
