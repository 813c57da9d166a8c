//! Imports as jobs, over HTTP.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use foreframe::server::ServerConfig;
use serde_json::{Value, json};

use crate::process::RunningServer;
use crate::recordings;
use crate::service::{app, get, poll_until, post};

const JOBS: &str = "/v1/jobs";

/// An import of `source` with more fields.
fn job(source: &str, fields: Value) -> Value {
    let mut job = json!({"kind": "import", "name": "walk", "source": source});
    job.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
    job
}

#[tokio::test]
async fn a_recording_on_the_server_becomes_a_data_set() {
    let dir = tempfile::tempdir().unwrap();
    let recordings = dir.path().join("recordings");
    recordings::images_with_csv(&recordings.join("walk"), 60);
    fs::write(recordings.join("walk/7.png"), b"no image").unwrap();
    let config = ServerConfig {
        import_dir: Some(recordings),
        ..ServerConfig::default()
    };
    let app = app(&dir.path().join("data"), config);
    let fields = json!({"size": "16x12", "resize": "letterbox", "skip_bad": true, "unit": ["state.heading=deg"],
        "fov": 90.0, "tilt": 15.0, "camera_height": 0.2});
    let created = post(&app, JOBS, &job("walk", fields.clone())).await;
    assert_eq!(created.status, 202, "{}", created.json());
    let path = format!("{JOBS}/{}", created.json()["id"].as_str().unwrap());
    let done = poll_until(async || {
        let job = get(&app, &path).await.json();
        assert!(job["state"] != "failed", "{job}");
        (job["state"] == "succeeded").then_some(job)
    })
    .await;
    let result = &done["result"];
    assert_eq!(
        (&result["frames"], &result["skipped"]),
        (&json!(59), &json!(1)),
        "{done}"
    );
    assert_eq!(
        (&done["progress"]["done"], &done["progress"]["total"]),
        (&json!(60), &json!(60))
    );
    let log = get(&app, &format!("{path}/logs")).await.json().to_string();
    assert!(log.contains("left out") && log.contains("7.png is damaged"), "{log}");
    let set = get(&app, "/v1/datasets/walk").await.json();
    assert_eq!(
        (&set["frame_width_px"], &set["episodes"]),
        (&json!(16), &json!(3)),
        "{set}"
    );
    let sets = get(&app, "/v1/datasets").await.json().to_string();
    assert!(sets.contains("\"walk\""), "{sets}");
    let detail = post(&app, JOBS, &job("walk", fields)).await.detail(409);
    assert!(detail.contains("exists"), "{detail}");
    fs::create_dir_all(dir.path().join("data/datasets/other/meta")).unwrap();
    fs::write(dir.path().join("data/datasets/other/notes.txt"), "").unwrap();
    let detail = post(&app, JOBS, &job("walk", json!({"name": "other"})))
        .await
        .detail(409);
    assert!(detail.contains("its directory holds other files"), "{detail}");
}

#[tokio::test]
async fn wrong_imports_are_refused_with_the_field() {
    let dir = tempfile::tempdir().unwrap();
    let recordings = dir.path().join("recordings");
    recordings::images_with_csv(&recordings.join("walk"), 4);
    fs::write(dir.path().join("secret.csv"), "file\n").unwrap();
    let config = ServerConfig {
        import_dir: Some(recordings),
        run_jobs: false,
        ..ServerConfig::default()
    };
    let app = app(&dir.path().join("data"), config);
    for (source, fields, expected) in [
        (
            "../data",
            json!({}),
            "source: \"../data\" is not a relative path without ..;",
        ),
        (
            "walk/../../data",
            json!({}),
            "source: \"walk/../../data\" is not a relative path",
        ),
        ("/etc", json!({}), "source: \"/etc\" is not a relative path"),
        ("", json!({}), "source: \"\" is not a relative path"),
        (
            "none",
            json!({}),
            "source: \"none\" does not exist; give the path of a recording below",
        ),
        (
            "walk",
            json!({"csv": "../secret.csv"}),
            "csv: \"../secret.csv\" is not a relative path",
        ),
        ("walk", json!({"name": "../walk"}), "name: "),
        (
            "walk",
            json!({"every": 0}),
            "every: 0 is not valid; it must be 1 to 1000000",
        ),
        (
            "walk",
            json!({"rate": 0.0}),
            "rate: 0 is not valid; it must be 0.01 to 1000",
        ),
        (
            "walk",
            json!({"hold": -1.0}),
            "hold: -1 is not valid; it must be 0 to 3600",
        ),
        (
            "walk",
            json!({"fov": 4.0}),
            "fov: 4 is not valid; it must be 5 to 170 degrees",
        ),
        (
            "walk",
            json!({"camera_height": 20.0}),
            "camera_height: 20 is not valid; it must be 0.01 to 10 metres",
        ),
        (
            "walk",
            json!({"size": "64"}),
            "size: \"64\" is not valid; write WIDTHxHEIGHT",
        ),
        (
            "walk",
            json!({"size": "0x64"}),
            "size: 0x64 is not valid; each side must be 1 to",
        ),
        (
            "walk",
            json!({"unit": ["rad"]}),
            "unit: \"rad\" is not valid; write NAME=UNIT",
        ),
    ] {
        let detail = post(&app, JOBS, &job(source, fields)).await.detail(422);
        assert!(detail.starts_with(expected), "{detail}");
    }
}

#[tokio::test]
async fn imports_are_off_by_default() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let detail = post(&app, JOBS, &job("walk", json!({}))).await.detail(422);
    assert!(
        detail.contains("imports are off on this server; set its setting import_dir"),
        "{detail}"
    );
}

/// Frames of a recording that takes a few seconds to import.
const FRAMES: u32 = 20_000;
/// Time limit of every wait: jobs have a low priority, so a busy machine imports few frames per second.
const IMPORT_TIMEOUT: Duration = Duration::from_mins(5);

fn start(dir: &Path) -> RunningServer {
    let models = dir.join("none-shipped");
    fs::create_dir_all(&models).unwrap();
    let set = |key: &str, value: &Path| format!("{key}={}", value.display());
    let (models, import) = (set("models_dir", &models), set("import_dir", dir));
    RunningServer::start(dir, &["--data-dir", "data", "--set", &models, "--set", &import])
}

fn wait_until(server: &RunningServer, id: &str, is_reached: impl Fn(&Value) -> bool) -> Value {
    let deadline = Instant::now() + IMPORT_TIMEOUT;
    loop {
        let job = server.ask("GET", &format!("{JOBS}/{id}"), &Value::Null);
        if is_reached(&job) {
            return job;
        }
        assert!(job["state"] != "failed" && Instant::now() < deadline, "{job}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn is_importing(job: &Value) -> bool {
    job["progress"]["done"].as_u64() > Some(0) && job["state"] == "running"
}

#[test]
fn an_import_continues_after_a_kill_and_after_a_cancellation() {
    let dir = tempfile::tempdir().unwrap();
    recordings::npy(&dir.path().join("long.npy"), FRAMES);
    let job = |name: &str| job("long.npy", json!({"rate": 10.0, "size": "96x96", "name": name}));
    let succeeded = |job: &Value| job["state"] == "succeeded";
    let server = start(dir.path());
    server.ask("POST", JOBS, &job("unbroken"));
    let unbroken = wait_until(&server, "job-1", succeeded);
    server.ask("POST", JOBS, &job("killed"));
    wait_until(&server, "job-2", is_importing);
    // Dropping it kills it.
    drop(server);
    let server = start(dir.path());
    let killed = wait_until(&server, "job-2", succeeded);
    assert_eq!(
        (&killed["result"]["content_hash"], &killed["attempts"]),
        (&unbroken["result"]["content_hash"], &json!(2))
    );
    server.ask("POST", JOBS, &job("cancelled"));
    let running = wait_until(&server, "job-3", is_importing);
    assert_eq!(running["progress"]["message"], "importing");
    server.ask("POST", "/v1/jobs/job-3/cancel", &Value::Null);
    wait_until(&server, "job-3", |job| job["state"] == "cancelled");
    server.ask("POST", "/v1/jobs/job-3/resume", &Value::Null);
    let resumed = wait_until(&server, "job-3", succeeded);
    assert_eq!(resumed["result"]["content_hash"], unbroken["result"]["content_hash"]);
}
