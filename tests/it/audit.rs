//! The audit trail: no change without its entry, also if the client closes its connection before the answer.

use std::collections::BTreeSet;
use std::io::Write as _;
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::time::Duration;

use foreframe::server::ServerConfig;
use foreframe_core::nn::Conditioning;
use foreframe_jobs::store::Store;
use foreframe_jobs::versions::Versions;
use serde_json::{Value, json};

use crate::service::{app, get, model, post, run, spec, store};

/// The operations that write an entry, each with a test below.
const AUDITED: [&str; 6] = [
    "POST /v1/jobs",
    "POST /v1/jobs/{id}/cancel",
    "POST /v1/jobs/{id}/resume",
    "POST /v1/models/{model}/versions/{version}/activate",
    "DELETE /v1/models/{model}/versions/{version}",
    "DELETE /v1/datasets/{dataset}",
];
/// The operations that change nothing that lasts.
const NOT_AUDITED: [&str; 18] = [
    "POST /v1/models/{model}/predict",
    "POST /v1/models/{model}/rollouts",
    "POST /v1/models/{model}/plan",
    "POST /v1/sessions",
    "POST /v1/sessions/{id}/rollouts",
    "POST /v1/sessions/{id}/plan",
    "DELETE /v1/sessions/{id}",
    "POST /v1/jobs/estimate",
    // Kept only until its import has ended.
    "POST /v1/uploads",
    "DELETE /v1/uploads/{id}",
    "POST /v1/realtime/sessions",
    "POST /v1/realtime/sessions/{id}/step",
    "POST /v1/realtime/sessions/{id}/reset",
    "POST /v1/realtime/sessions/{id}/close",
    "POST /v1/environments",
    "POST /v1/environments/{id}/reset",
    "POST /v1/environments/{id}/step",
    "DELETE /v1/environments/{id}",
];
/// Requests of each kind.
const REQUESTS: u64 = 40;

#[tokio::test]
async fn every_operation_is_audited_or_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let document = get(&app(dir.path(), ServerConfig::default()), "/openapi.json")
        .await
        .json();
    let mut operations = BTreeSet::new();
    for (path, methods) in document["paths"].as_object().unwrap() {
        let changing = methods
            .as_object()
            .unwrap()
            .keys()
            .filter(|method| ["post", "put", "patch", "delete"].contains(&method.as_str()));
        operations.extend(changing.map(|method| format!("{} {path}", method.to_uppercase())));
    }
    let known: BTreeSet<String> = AUDITED
        .iter()
        .chain(&NOT_AUDITED)
        .map(|known| (*known).to_owned())
        .collect();
    assert_eq!(operations, known);
}

/// Sends a request and closes the connection `delay` later, without reading the answer.
fn send_and_leave(address: SocketAddr, operation: &str, body: &Value, delay: Duration) {
    let body = if body.is_null() {
        String::new()
    } else {
        body.to_string()
    };
    let (length, mut stream) = (body.len(), TcpStream::connect(address).unwrap());
    let head = format!("{operation} HTTP/1.1\r\nhost: a\r\ncontent-type: application/json\r\ncontent-length: {length}");
    stream.write_all(format!("{head}\r\n\r\n{body}").as_bytes()).unwrap();
    std::thread::sleep(delay);
}

/// Sends one request for each number to a server that then stops, and returns the targets of the action's entries. The clients
/// leave after 0 to 8 ms.
async fn targets_after(
    dir: &Path,
    action: &str,
    request: impl Fn(u64) -> (String, Value) + Send + 'static,
) -> (Store, Vec<String>) {
    let config = ServerConfig {
        run_jobs: false,
        max_queued_jobs: 1000,
        ..ServerConfig::default()
    };
    let server = run(app(dir, config)).await;
    let address = server.address;
    tokio::task::spawn_blocking(move || {
        for number in 0..REQUESTS {
            let (operation, body) = request(number);
            send_and_leave(address, &operation, &body, Duration::from_micros(number * 200));
        }
    })
    .await
    .unwrap();
    server.stop().await;
    let store = store(dir);
    let entries = store.audit(None, 1000).await.unwrap();
    let of_action = entries.into_iter().filter(|entry| entry.action == action);
    let targets = of_action.map(|entry| entry.target).collect();
    (store, targets)
}

fn job(number: u64) -> Value {
    json!({"kind": "collect", "name": format!("set-{number}"), "scenario": "static-observer", "trials": 10})
}

/// The ids of the jobs in a state.
async fn jobs_in(store: &Store, state: &str) -> BTreeSet<String> {
    let page = foreframe_jobs::store::JobPage {
        state: Some(state.to_owned()),
        limit: 1000,
        ..Default::default()
    };
    let jobs = store.jobs(page).await.unwrap();
    jobs.iter().map(|job| job.id.to_string()).collect()
}

/// Queues jobs, and cancels them if `cancelled`.
async fn with_jobs(dir: &Path, cancelled: bool) {
    let config = ServerConfig {
        run_jobs: false,
        max_queued_jobs: 1000,
        ..ServerConfig::default()
    };
    let app = app(dir, config);
    for number in 0..REQUESTS {
        let id = post(&app, "/v1/jobs", &job(number)).await.json()["id"].clone();
        if cancelled {
            let path = format!("/v1/jobs/{}/cancel", id.as_str().unwrap());
            assert_eq!(post(&app, &path, &Value::Null).await.status, 202);
        }
    }
}

fn same(targets: &[String], changed: &BTreeSet<String>) {
    let entries: BTreeSet<String> = targets.iter().cloned().collect();
    assert_eq!(&entries, changed);
    assert_eq!(targets.len(), changed.len(), "each change has one entry");
    assert!(!changed.is_empty(), "no request had an effect");
}

#[tokio::test(flavor = "multi_thread")]
async fn no_job_is_made_without_its_entry() {
    let dir = tempfile::tempdir().unwrap();
    let request = |number| ("POST /v1/jobs".to_owned(), job(number));
    let (store, targets) = targets_after(dir.path(), "job.create", request).await;
    same(&targets, &jobs_in(&store, "queued").await);
}

#[tokio::test(flavor = "multi_thread")]
async fn no_job_is_cancelled_without_its_entry() {
    let dir = tempfile::tempdir().unwrap();
    with_jobs(dir.path(), false).await;
    let request = |number| (format!("POST /v1/jobs/job-{}/cancel", number + 1), Value::Null);
    let (store, targets) = targets_after(dir.path(), "job.cancel", request).await;
    same(&targets, &jobs_in(&store, "cancelled").await);
}

#[tokio::test(flavor = "multi_thread")]
async fn no_job_is_resumed_without_its_entry() {
    let dir = tempfile::tempdir().unwrap();
    with_jobs(dir.path(), true).await;
    let request = |number| (format!("POST /v1/jobs/job-{}/resume", number + 1), Value::Null);
    let (store, targets) = targets_after(dir.path(), "job.resume", request).await;
    same(&targets, &jobs_in(&store, "queued").await);
}

/// Publishes versions of the model `mine`, of which the last one is active.
async fn with_versions(dir: &Path, count: u64) {
    let trained = tempfile::tempdir().unwrap();
    model(trained.path(), "mine", spec(Conditioning::None));
    let versions = Versions::new(store(dir), &dir.join("none"));
    for _ in 0..count {
        let trained = trained.path().join("mine");
        versions
            .publish(&"mine".parse().unwrap(), &trained, true)
            .await
            .unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_active_version_is_the_last_audited_one() {
    let dir = tempfile::tempdir().unwrap();
    with_versions(dir.path(), 2).await;
    let request = |number| {
        let version = number % 2 + 1;
        (format!("POST /v1/models/mine/versions/{version}/activate"), Value::Null)
    };
    let before = store(dir.path()).audit(None, 1000).await.unwrap().len();
    let (store, _) = targets_after(dir.path(), "version.activate", request).await;
    let entries = store.audit(None, 1000).await.unwrap();
    assert!(entries.len() > before, "no request had an effect");
    // The latest entry names the version that is active.
    let active = store.active_versions().await.unwrap();
    assert_eq!(active.len(), 1);
    assert_eq!(entries[0].target, format!("mine@{}", active[0].1));
}

#[tokio::test(flavor = "multi_thread")]
async fn no_version_is_deleted_without_its_entry() {
    let dir = tempfile::tempdir().unwrap();
    with_versions(dir.path(), REQUESTS + 1).await;
    let request = |number| (format!("DELETE /v1/models/mine/versions/{}", number + 1), Value::Null);
    let (store, targets) = targets_after(dir.path(), "version.delete", request).await;
    let deleted = store.deleted_versions().await.unwrap();
    same(
        &targets,
        &deleted
            .iter()
            .map(|(model, version)| format!("{model}@{version}"))
            .collect(),
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn no_data_set_is_deleted_without_its_entry() {
    let dir = tempfile::tempdir().unwrap();
    let directory = |number: u64| dir.path().join(format!("datasets/set-{number}"));
    for number in 0..REQUESTS {
        std::fs::create_dir_all(directory(number).join("data")).unwrap();
    }
    let request = |number| (format!("DELETE /v1/datasets/set-{number}"), Value::Null);
    let (_, targets) = targets_after(dir.path(), "dataset.delete", request).await;
    let deleted = (0..REQUESTS).filter(|&number| !directory(number).exists());
    same(&targets, &deleted.map(|number| format!("set-{number}")).collect());
}
