//! Collections in parts: the same bytes as one worker, also if workers are killed.

use std::collections::BTreeMap;
use std::path::Path;

use foreframe::server::ServerConfig;
use serde_json::{Value, json};

use crate::jobs_killed::{ask, serve, start, wait_for, wait_until};
use crate::service::{app, get, poll_until, post};

fn collect(name: &str, parts: usize) -> Value {
    json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 52, "parts": parts})
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

#[tokio::test]
async fn a_collection_in_parts_has_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let whole = post(&app, "/v1/jobs", &collect("whole", 1)).await.json();
    assert_eq!(whole.get("parts"), None);
    // There are no more parts than shards.
    let parts = post(&app, "/v1/jobs", &collect("parts", 9)).await.json();
    assert_eq!(parts["parts"]["total"], 2);
    let job = poll_until(async || {
        let job = get(&app, "/v1/jobs/job-2").await.json();
        assert_ne!(job["state"], "failed", "{job}");
        (job["state"] == "succeeded").then_some(job)
    })
    .await;
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

#[test]
fn a_killed_worker_leaves_its_part_to_another() {
    let alone = tempfile::tempdir().unwrap();
    let (server, address) = serve(alone.path(), &[]);
    ask(&address, "POST /v1/jobs", &collect("seen", 1));
    wait_for(&address, "job-1", "succeeded");
    drop(server);

    // Three machines: each has a data directory of its own.
    let shared = tempfile::tempdir().unwrap();
    let machines = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let database = format!("sqlite:{}", shared.path().join("jobs.db").display());
    let objects = shared.path().join("objects").display().to_string();
    let store = [
        "--database-url",
        &database,
        "--objects-url",
        &objects,
        "--set",
        "job_lease_ms=1000",
    ];
    let (_server, address) = serve(machines[0].path(), &[&store[..], &["--run-jobs", "false"]].concat());
    let worker = |machine: &tempfile::TempDir| start(machine.path(), &[&["worker"], &store[..]].concat()).0;
    ask(&address, "POST /v1/jobs", &collect("seen", 2));
    let killed = worker(&machines[1]);
    wait_until(&address, "job-2", |job| job["progress"]["done"].as_u64().unwrap() > 0);
    drop(killed);
    let _other = worker(&machines[2]);
    let job = wait_for(&address, "job-1", "succeeded");
    assert_eq!(job["parts"], json!({"total": 2, "done": 2, "running": 0, "failed": 0}));
    assert_eq!(ask(&address, "GET /v1/jobs/job-2", &Value::Null)["attempts"], 2);
    let made = files(&Path::new(&objects).join("datasets/seen"));
    assert!(made == files(&alone.path().join("datasets/seen")));
}
