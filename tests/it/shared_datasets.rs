//! Data sets of several machines that share an object store; each has its own data directory and database.

use std::path::Path;
use std::time::Duration;

use axum::body::Body;
use axum::http::Request;
use foreframe::server::{App, ServerConfig};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::service::{Answer, get, poll_until, post, run, send};

const JOBS: &str = "/v1/jobs";
const SET: &str = "/v1/datasets/d";

/// A server with its own data directory and no shipped models.
pub(crate) async fn machine(objects: &Path) -> (TempDir, App) {
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

/// Creates a collection job and waits until it has succeeded.
async fn collected(app: &App, trials: u32) {
    finished(app, &collect(trials)).await;
}

async fn finished(app: &App, job: &Value) {
    let taken = post(app, JOBS, job).await;
    assert_eq!(taken.status, 202, "{}", taken.json());
    let path = format!("{JOBS}/{}", taken.json()["id"].as_str().unwrap());
    poll_until(async || {
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
async fn describing_a_shared_data_set_does_not_download_it() {
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

#[tokio::test]
async fn an_episode_tells_its_camera() {
    let objects = tempfile::tempdir().unwrap();
    let (_here, app) = machine(objects.path()).await;
    let varied = json!({"kind": "collect", "name": "d", "scenario": "moving-observer", "trials": 2, "rooms": "varied", "seed": 1});
    finished(&app, &varied).await;
    let camera = async |episode: usize| get(&app, &format!("{SET}/episodes/{episode}")).await.json()["camera"].clone();
    let (first, second) = (camera(0).await, camera(1).await);
    assert!(
        first["height_m"].is_f64() && second["height_m"].is_f64(),
        "{first} {second}"
    );
    assert_ne!(first, second);
    // As a session takes it.
    let session = json!({"model": "rooms", "camera": first});
    let answer = post(&app, "/v1/sessions", &session).await;
    assert!(
        answer.json()["detail"].as_str().unwrap().contains("no model"),
        "{}",
        answer.json()
    );
}

#[tokio::test]
async fn a_deleted_data_set_is_announced() {
    let objects = tempfile::tempdir().unwrap();
    let (_here, app) = machine(objects.path()).await;
    collected(&app, 3).await;
    let watched = app.clone();
    let watcher = tokio::spawn(async move { get(&watched, "/v1/events").await });
    // The lists as they are have been announced by then.
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert_eq!(delete(&app).await.status, 204);
    tokio::time::sleep(Duration::from_secs(1)).await;
    run(app).await.stop().await;
    let text = String::from_utf8(watcher.await.unwrap().body).unwrap();
    let names: Vec<&str> = text.lines().filter_map(|line| line.strip_prefix("event: ")).collect();
    assert_eq!(names, ["models", "jobs", "jobs", "stopping"], "{text}");
}

#[tokio::test]
async fn data_set_names_are_unique_across_machines() {
    let objects = tempfile::tempdir().unwrap();
    let (_here, one) = machine(objects.path()).await;
    let (_there, other) = machine(objects.path()).await;
    collected(&one, 3).await;
    for trials in [3, 4] {
        let taken = post(&other, JOBS, &collect(trials)).await.detail(409);
        assert_eq!(taken, "name: data set \"d\" exists; choose another name");
    }
}

#[tokio::test]
async fn a_replaced_shared_data_set_is_downloaded_again() {
    let objects = tempfile::tempdir().unwrap();
    let (_here, one) = machine(objects.path()).await;
    let (there, other) = machine(objects.path()).await;
    let picture = async |episode: u32| {
        get(&other, &format!("{SET}/episodes/{episode}/preview.png"))
            .await
            .status
    };
    collected(&one, 3).await;
    assert_eq!(picture(2).await, 200);
    assert_eq!(delete(&one).await.status, 204);
    assert!(there.path().join("datasets/d/meta/info.json").is_file());
    assert_eq!(get(&other, SET).await.status, 404);
    assert_eq!(picture(2).await, 404);
    assert_eq!(get(&other, "/v1/datasets").await.json(), json!({"datasets": []}));
    collected(&one, 4).await;
    assert_eq!(get(&other, SET).await.json()["episodes"], 4);
    assert_eq!(picture(3).await, 200);
}

#[tokio::test]
async fn a_stale_copy_does_not_block_a_new_collection() {
    let objects = tempfile::tempdir().unwrap();
    let (_here, one) = machine(objects.path()).await;
    let (_there, other) = machine(objects.path()).await;
    collected(&one, 3).await;
    assert_eq!(delete(&other).await.status, 204);
    assert!(!objects.path().join("datasets/d/meta/info.json").exists());
    collected(&one, 5).await;
    assert_eq!(get(&other, SET).await.json()["episodes"], 5);
    assert_eq!(delete(&other).await.status, 204);
    // The same arguments give the same data set again.
    collected(&one, 5).await;
    assert_eq!(get(&other, SET).await.json()["episodes"], 5);
}

#[tokio::test]
async fn an_incomplete_shared_data_set_is_hidden_but_deletable() {
    let objects = tempfile::tempdir().unwrap();
    let (_here, app) = machine(objects.path()).await;
    let half = objects.path().join("datasets/d/data");
    std::fs::create_dir_all(&half).unwrap();
    std::fs::write(half.join("shard"), "x").unwrap();
    assert_eq!(get(&app, "/v1/datasets").await.json(), json!({"datasets": []}));
    assert_eq!(get(&app, SET).await.status, 404);
    assert_eq!(delete(&app).await.status, 204);
    assert_eq!(delete(&app).await.status, 404);
}
