//! Data sets of several machines that keep their objects in one place, each with a data directory and a database of its own.

use std::path::Path;

use axum::body::Body;
use axum::http::Request;
use foreframe::server::{App, ServerConfig};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::service::{Answer, get, post, send, until};

const JOBS: &str = "/v1/jobs";
const SET: &str = "/v1/datasets/d";

/// A server with a data directory of its own and no shipped models.
async fn machine(objects: &Path) -> (TempDir, App) {
    let dir = tempfile::tempdir().unwrap();
    let models_dir = dir.path().join("none-shipped");
    std::fs::create_dir_all(&models_dir).unwrap();
    let config = ServerConfig {
        data_dir: dir.path().to_owned(),
        models_dir,
        objects_url: Some(objects.display().to_string()),
        ..ServerConfig::default()
    };
    let app = App::open(config).await.unwrap();
    (dir, app)
}

fn collect(trials: u32) -> Value {
    json!({"kind": "collect", "name": "d", "scenario": "static-observer", "trials": trials})
}

/// Asks for a collection and waits until it has succeeded.
async fn collected(app: &App, trials: u32) {
    let taken = post(app, JOBS, &collect(trials)).await;
    assert_eq!(taken.status, 202, "{}", taken.json());
    let path = format!("{JOBS}/{}", taken.json()["id"].as_str().unwrap());
    until(async || {
        let job = get(app, &path).await.json();
        assert!(job["state"] != "failed", "{job}");
        (job["state"] == "succeeded").then_some(())
    })
    .await;
}

async fn delete(app: &App) -> Answer {
    send(app, Request::delete(SET).body(Body::empty()).unwrap()).await
}

#[tokio::test]
async fn a_data_set_is_described_without_being_fetched_and_shown_after_it_is() {
    let objects = tempfile::tempdir().unwrap();
    let (_here, one) = machine(objects.path()).await;
    let (there, other) = machine(objects.path()).await;
    collected(&one, 3).await;
    let described = get(&other, SET).await.json();
    assert_eq!(described, get(&one, SET).await.json());
    assert_eq!(
        get(&other, "/v1/datasets").await.json(),
        json!({"datasets": [described]})
    );
    assert!(!there.path().join("datasets/d").exists());
    let picture = get(&other, &format!("{SET}/episodes/2/preview.png")).await;
    assert!(picture.body.starts_with(b"\x89PNG"));
    assert!(there.path().join("datasets/d/meta/info.json").is_file());
}
