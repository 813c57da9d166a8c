//! Collections, imports and evaluations in parts: the same bytes as one worker, also if workers are killed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use foreframe::server::{App, ServerConfig};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::jobs_killed::{KillOnDrop, address, ask, serve, start, wait_for, wait_until};
use crate::recordings::images_with_csv;
use crate::service::{app, get, poll_until, post};
use crate::store::postgres;

fn collect(name: &str, parts: usize) -> Value {
    json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 52, "parts": parts})
}

/// A data set that is enough for an evaluation of several batches.
fn small() -> Value {
    json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 40})
}

/// The files of a data set with their bytes.
fn files(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut dirs = vec![dir.to_owned()];
    while let Some(next) = dirs.pop() {
        for entry in std::fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                dirs.push(path);
            } else {
                let name = path.strip_prefix(dir).unwrap().display().to_string();
                found.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// A job of a server in this process, when it has succeeded.
async fn succeeded(app: &App, id: &str) -> Value {
    poll_until(async || {
        let job = get(app, &format!("/v1/jobs/{id}")).await.json();
        assert_ne!(job["state"], "failed", "{job}");
        (job["state"] == "succeeded").then_some(job)
    })
    .await
}

#[tokio::test]
async fn a_collection_in_parts_has_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let whole = post(&app, "/v1/jobs", &collect("whole", 1)).await.json();
    assert_eq!(whole.get("parts"), None);
    // There are no more parts than shards.
    let parts = post(&app, "/v1/jobs", &collect("parts", 9)).await.json();
    assert_eq!(parts["parts"]["total"], 2);
    let job = succeeded(&app, "job-2").await;
    assert_eq!(
        (&job["result"]["episodes"], &job["parts"]["done"]),
        (&json!(52), &json!(2))
    );
    let listed = get(&app, "/v1/jobs?part_of=job-2").await.json();
    let shards: Vec<&Value> = listed["jobs"]
        .as_array()
        .unwrap()
        .iter()
        .map(|job| &job["result"]["shards"])
        .collect();
    assert_eq!(shards, [&json!([1, 2]), &json!([0, 1])]);
    let [whole, parts] = ["whole", "parts"].map(|name| files(&dir.path().join("datasets").join(name)));
    assert!(whole == parts, "{:?} {:?}", whole.keys(), parts.keys());
    assert!(std::fs::read_dir(dir.path().join("runs")).unwrap().next().is_none());

    let mut part = collect("other", 2);
    part["part"] = json!(1);
    let refused = post(&app, "/v1/jobs", &part).await.detail(422);
    assert!(refused.starts_with("part: only the server makes parts"), "{refused}");
}

/// Three machines with one database and one object store: each has a data directory of its own.
struct Machines {
    shared: TempDir,
    own: [TempDir; 3],
    database: String,
    objects: String,
}

impl Machines {
    /// With SQLite and a shared directory.
    fn new() -> Self {
        let shared = tempfile::tempdir().unwrap();
        let database = format!("sqlite:{}", shared.path().join("jobs.db").display());
        let objects = shared.path().join("objects").display().to_string();
        Self {
            shared,
            own: [(); 3].map(|()| tempfile::tempdir().unwrap()),
            database,
            objects,
        }
    }

    /// The shared directory.
    fn objects(&self) -> PathBuf {
        self.shared.path().join("objects")
    }

    fn start(&self, machine: usize, arguments: &[&str]) -> (KillOnDrop, String) {
        let store = ["--database-url", &self.database, "--objects-url", &self.objects];
        start(
            self.own[machine].path(),
            &[arguments, &store, &["--set", "job_lease_ms=1000"]].concat(),
        )
    }

    /// A server without workers.
    fn serve(&self) -> (KillOnDrop, String) {
        let (server, line) = self.start(0, &["serve", "--bind", "127.0.0.1:0", "--run-jobs", "false"]);
        (server, address(&line))
    }

    fn worker(&self, machine: usize) -> KillOnDrop {
        self.start(machine, &["worker"]).0
    }
}

/// Submits a job; returns its id.
fn submit(address: &str, body: &Value) -> String {
    let job = ask(address, "POST /v1/jobs", body);
    job["id"].as_str().unwrap_or_else(|| panic!("{job}")).to_owned()
}

#[test]
fn a_killed_worker_leaves_its_part_to_another() {
    let alone = tempfile::tempdir().unwrap();
    let (server, address) = serve(alone.path(), &[]);
    ask(&address, "POST /v1/jobs", &collect("seen", 1));
    wait_for(&address, "job-1", "succeeded");
    drop(server);

    let machines = Machines::new();
    let (_server, address) = machines.serve();
    ask(&address, "POST /v1/jobs", &collect("seen", 2));
    let killed = machines.worker(1);
    wait_until(&address, "job-2", |job| job["progress"]["done"].as_u64().unwrap() > 0);
    drop(killed);
    let _other = machines.worker(2);
    let job = wait_for(&address, "job-1", "succeeded");
    assert_eq!(job["parts"], json!({"total": 2, "done": 2, "running": 0, "failed": 0}));
    assert_eq!(ask(&address, "GET /v1/jobs/job-2", &Value::Null)["attempts"], 2);
    let log = ask(&address, "GET /v1/jobs/job-1/logs", &Value::Null).to_string();
    assert!(!log.contains("done again"), "{log}");
    let made = files(&machines.objects().join("datasets/seen"));
    assert!(made == files(&alone.path().join("datasets/seen")));
}

/// Small, and with two sets of several batches.
fn train() -> Value {
    let settings = json!({
        "model": {"features": 8, "hidden": 8, "context": 2, "horizon": 1},
        "data": {"windows": 8, "validation_windows": 4},
        "pretrain": {"steps": 3, "batch_size": 4},
        "sequence": {"steps": 3, "batch_size": 4},
        "run": {"validate_every_steps": 3, "checkpoint_every_steps": 3},
    });
    json!({"kind": "train", "name": "m", "preset": "paper", "dataset": "seen", "settings": settings})
}

fn evaluate(parts: usize) -> Value {
    json!({"kind": "evaluate", "model": "m", "dataset": "seen", "windows": 100, "resamples": 100, "parts": parts})
}

/// The files of a report; its duration is replaced.
fn report(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = files(dir);
    let json: Value = serde_json::from_slice(&files["report.json"]).unwrap();
    assert!(json["sets"][0]["windows"].as_u64().unwrap() > 64, "{json}");
    let duration = json["stamp"]["wall_time_s"].to_string();
    let shown = format!("| {:.1} s on", json["stamp"]["wall_time_s"].as_f64().unwrap());
    for (name, text) in &mut files {
        if ["report.json", "report.md"].contains(&name.as_str()) {
            let plain = String::from_utf8(text.clone()).unwrap();
            *text = plain
                .replace(&duration, "DURATION")
                .replace(&shown, "DURATION")
                .into_bytes();
        }
    }
    files
}

#[test]
fn an_evaluation_in_parts_gives_the_same_report_though_a_worker_is_killed() {
    let machines = Machines::new();
    let (_server, address) = machines.serve();
    let run = |body: &Value| submit(&address, body);
    run(&small());
    let mut training = train();
    training["after"] = json!("job-1");
    run(&training);
    let first = machines.worker(1);
    wait_for(&address, "job-2", "succeeded");
    let whole = run(&evaluate(1));
    wait_for(&address, &whole, "succeeded");

    let id = run(&evaluate(2));
    assert_eq!(id, "job-4");
    wait_until(&address, "job-5", |job| job["progress"]["done"].as_u64().unwrap() > 0);
    drop(first);
    let _other = machines.worker(2);
    let job = wait_for(&address, &id, "succeeded");
    assert_eq!(job["parts"], json!({"total": 2, "done": 2, "running": 0, "failed": 0}));
    let reports = machines.objects().join("reports");
    let [whole, parts] = [whole, id].map(|id| report(&reports.join(id)));
    assert_eq!(whole.keys().collect::<Vec<_>>(), parts.keys().collect::<Vec<_>>());
    for (name, bytes) in &whole {
        assert!(bytes == &parts[name], "{name}");
    }
    // What the parts saved is deleted.
    let runs: Vec<String> = files(&machines.objects().join("runs")).into_keys().collect();
    assert!(runs.iter().all(|file| file.starts_with("job-2/")), "{runs:?}");
}

#[tokio::test]
async fn an_import_in_parts_has_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let recordings = dir.path().join("recordings");
    images_with_csv(&recordings.join("walk"), 2050);
    let config = ServerConfig {
        import_dir: Some(recordings),
        ..ServerConfig::default()
    };
    let data = dir.path().join("data");
    let app = app(&data, config);
    let import = |name: &str, parts: usize| json!({"kind": "import", "name": name, "source": "walk", "size": "16x12", "parts": parts});
    let whole = post(&app, "/v1/jobs", &import("whole", 1)).await.json();
    assert_eq!(whole.get("parts"), None);
    // There are two shards, so one part has nothing to do.
    let parts = post(&app, "/v1/jobs", &import("parts", 3)).await.json();
    assert_eq!(parts["parts"]["total"], 3, "{parts}");
    let job = succeeded(&app, "job-2").await;
    assert_eq!(
        (&job["result"]["frames"], &job["parts"]["done"]),
        (&json!(2050), &json!(3))
    );
    let mut part = import("other", 2);
    part["part"] = json!(0);
    let refused = post(&app, "/v1/jobs", &part).await.detail(422);
    assert!(refused.starts_with("part: only the server makes parts"), "{refused}");
    let whole = get(&app, "/v1/jobs/job-1").await.json();
    assert_eq!(whole["result"]["content_hash"], job["result"]["content_hash"]);
    let [whole, parts] = ["whole", "parts"].map(|name| {
        let mut files = files(&data.join("datasets").join(name));
        // The name of the data set is in its description and its tables.
        files.retain(|file, _| file.starts_with("data/"));
        files
    });
    assert!(
        whole.len() == 2 && whole == parts,
        "{:?} {:?}",
        whole.keys(),
        parts.keys()
    );
    assert!(std::fs::read_dir(data.join("runs")).unwrap().next().is_none());
}

/// The database and the object store of a cluster.
async fn cluster() -> Option<Machines> {
    let bucket = std::env::var("FOREFRAME_TEST_S3")
        .ok()
        .filter(|_| cfg!(feature = "cloud"));
    let Some(bucket) = bucket else {
        println!("skipped: built without the feature cloud, or FOREFRAME_TEST_S3 holds no URL");
        return None;
    };
    let database = postgres("parts_cluster").await?;
    let place: u64 = rand::random();
    Some(Machines {
        database,
        objects: format!("{bucket}/parts-{place:016x}"),
        ..Machines::new()
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_on_postgresql_and_s3_give_the_same_bytes() {
    let Some(machines) = cluster().await else { return };
    let compare = move || {
        let (_server, address) = machines.serve();
        let _workers = [1, 2].map(|machine| machines.worker(machine));
        let run = |body: &Value| {
            let id = submit(&address, body);
            (wait_for(&address, &id, "succeeded"), id)
        };
        run(&small());
        let [whole, parts] = [collect("whole", 1), collect("parts", 2)].map(|body| run(&body).0);
        assert_eq!(parts["parts"]["done"], 2, "{parts}");
        assert_eq!(whole["result"]["content_hash"], parts["result"]["content_hash"]);
        run(&train());
        let [whole, parts] = [1, 2].map(|parts| {
            let (job, id) = run(&evaluate(parts));
            assert_eq!(
                job["parts"]["done"],
                if parts == 1 { Value::Null } else { json!(parts) }
            );
            let mut report = ask(&address, &format!("GET /v1/jobs/{id}/files/report.json"), &Value::Null);
            report["stamp"]["wall_time_s"] = Value::Null;
            report
        });
        assert!(whole["sets"].is_array() && whole == parts, "{whole} {parts}");
    };
    tokio::task::spawn_blocking(compare).await.unwrap();
}
