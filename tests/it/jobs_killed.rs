//! Jobs of processes that are killed with SIGKILL: the final weights are those of an uninterrupted training.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use foreframe_core::types::Seed;
use rand::Rng as _;
use serde_json::{Value, json};

const KILLS: u32 = 10;
/// Time limit of every wait: longer than any step takes, even on a busy machine.
const TIMEOUT: Duration = Duration::from_mins(3);
/// The default lease duration.
const LEASE: Duration = Duration::from_secs(30);

/// A running program. Dropping it kills the process.
pub(crate) struct KillOnDrop(Child);

impl Drop for KillOnDrop {
    fn drop(&mut self) {
        // On Unix this is SIGKILL.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts the program with a data directory and no shipped models. Returns also its first line of output.
pub(crate) fn start(data_dir: &Path, arguments: &[&str]) -> (KillOnDrop, String) {
    let no_models = data_dir.join("none-shipped");
    std::fs::create_dir_all(&no_models).unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_foreframe"))
        .args(arguments)
        .arg("--data-dir")
        .arg(data_dir)
        .arg("--set")
        .arg(format!("models_dir={}", no_models.display()))
        .env("RUST_LOG", "warn")
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    let stdout = child.stdout.take().unwrap();
    BufReader::new(stdout).read_line(&mut line).unwrap();
    (KillOnDrop(child), line)
}

pub(crate) fn serve(data_dir: &Path, more: &[&str]) -> (KillOnDrop, String) {
    let (program, line) = start(data_dir, &[&["serve", "--bind", "127.0.0.1:0"], more].concat());
    let address = address(&line);
    (program, address)
}

/// The address in a server's first line of output.
pub(crate) fn address(line: &str) -> String {
    let address = line.split("http://").nth(1).unwrap().split('/').next().unwrap();
    address.to_owned()
}

/// Sends a request and returns the JSON body of the response.
pub(crate) fn ask(address: &str, request: &str, body: &Value) -> Value {
    let body = if body.is_null() {
        String::new()
    } else {
        body.to_string()
    };
    let mut stream = TcpStream::connect(address).unwrap();
    let head = "Host: x\r\nConnection: close\r\nContent-Type: application/json";
    write!(
        stream,
        "{request} HTTP/1.1\r\n{head}\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    )
    .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    serde_json::from_str(answer.split("\r\n\r\n").nth(1).unwrap()).unwrap_or_else(|_| panic!("{answer}"))
}

pub(crate) fn wait_for(address: &str, id: &str, state: &str) -> Value {
    wait_until(address, id, |job| job["state"] == state)
}

pub(crate) fn wait_until(address: &str, id: &str, is_reached: impl Fn(&Value) -> bool) -> Value {
    let deadline = Instant::now() + TIMEOUT;
    loop {
        let job = ask(address, &format!("GET /v1/jobs/{id}"), &Value::Null);
        if is_reached(&job) {
            return job;
        }
        assert!(job["state"] != "failed" && Instant::now() < deadline, "{job}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

pub(crate) fn collect() -> Value {
    json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 40})
}

fn train() -> Value {
    let settings = json!({
        "model": {"features": 16, "hidden": 16},
        "data": {"windows": 64, "validation_windows": 8},
        "pretrain": {"steps": 40, "batch_size": 16},
        "sequence": {"steps": 120, "batch_size": 16},
        "run": {"validate_every_steps": 10, "checkpoint_every_steps": 4},
    });
    json!({"kind": "train", "name": "m", "preset": "paper", "dataset": "seen", "settings": settings})
}

pub(crate) fn weights(data_dir: &Path) -> Vec<u8> {
    std::fs::read(data_dir.join("models/m/1/model.safetensors")).unwrap()
}

/// A data directory after an uninterrupted collection and training, and the duration of the training.
fn uninterrupted() -> (tempfile::TempDir, Duration) {
    let dir = tempfile::tempdir().unwrap();
    let (_server, address) = serve(dir.path(), &[]);
    ask(&address, "POST /v1/jobs", &collect());
    wait_for(&address, "job-1", "succeeded");
    ask(&address, "POST /v1/jobs", &train());
    let job = wait_for(&address, "job-2", "succeeded");
    let took_s = job["ended_unix_s"].as_f64().unwrap() - job["started_unix_s"].as_f64().unwrap();
    (dir, Duration::from_secs_f64(took_s))
}

pub(crate) fn copy_dataset(from: &Path, to: &Path) {
    let mut dirs = vec![PathBuf::from("datasets/seen")];
    while let Some(dir) = dirs.pop() {
        std::fs::create_dir_all(to.join(&dir)).unwrap();
        for entry in std::fs::read_dir(from.join(&dir)).unwrap() {
            let relative = dir.join(entry.unwrap().file_name());
            if from.join(&relative).is_dir() {
                dirs.push(relative);
            } else {
                std::fs::copy(from.join(&relative), to.join(&relative)).unwrap();
            }
        }
    }
}

#[test]
fn a_killed_training_ends_with_the_same_weights() {
    let (whole, took) = uninterrupted();
    killed_at_random_points(whole.path(), took);
    claimed_by_another_machine(whole.path());
}

fn killed_at_random_points(whole: &Path, took: Duration) {
    // If the machine is faster now than when `took` was measured, the training ends before the last kill. Then try again with
    // shorter intervals.
    let killed = [0.06, 0.03, 0.015, 0.007]
        .into_iter()
        .find_map(|share| kill_repeatedly(whole, took.mul_f64(share)));
    let dir = killed.expect("the training ended before it was killed often enough");
    let (_server, address) = serve(dir.path(), &["--set", "job_max_attempts=100"]);
    let job = wait_for(&address, "job-1", "succeeded");
    assert_eq!(job["attempts"], KILLS + 1);
    assert!(weights(dir.path()) == weights(whole), "the weights differ");
    let killed = validations(&address, "job-1");
    let (_server, address) = serve(whole, &[]);
    assert_eq!(killed, validations(&address, "job-2"));
    assert_eq!(killed.len(), 4 + 12);
}

/// A data directory whose training was killed repeatedly, each time at most `at_most` after it was claimed; none if the
/// training ended before the last kill.
fn kill_repeatedly(whole: &Path, at_most: Duration) -> Option<tempfile::TempDir> {
    let dir = tempfile::tempdir().unwrap();
    copy_dataset(whole, dir.path());
    let mut rng = Seed(3).rng();
    for kill in 0..KILLS {
        // It is killed faster than it saves.
        let (_server, address) = serve(dir.path(), &["--set", "job_max_attempts=100"]);
        if kill == 0 {
            ask(&address, "POST /v1/jobs", &train());
        }
        let started = Instant::now();
        let job = wait_until(&address, "job-1", |job| job["attempts"] == kill + 1);
        assert!(
            started.elapsed() < LEASE,
            "the job was claimed only after its lease had expired: {job}"
        );
        std::thread::sleep(at_most.mul_f64(rng.random_range(0.1..1.0)));
        if ask(&address, "GET /v1/jobs/job-1", &Value::Null)["state"] != "running" {
            return None;
        }
    }
    Some(dir)
}

/// The points of the loss curves that have a validation loss.
fn validations(address: &str, id: &str) -> Vec<Value> {
    let curves = ask(address, &format!("GET /v1/jobs/{id}/metrics"), &Value::Null);
    let points = curves["points"].as_array().unwrap().iter();
    points
        .filter(|point| point["validation"].is_number())
        .cloned()
        .collect()
}

/// Machines with separate data directories, one database and one object store.
fn claimed_by_another_machine(whole: &Path) {
    let (of_server, first, second) = (
        tempfile::tempdir().unwrap(),
        tempfile::tempdir().unwrap(),
        tempfile::tempdir().unwrap(),
    );
    let shared = tempfile::tempdir().unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let database = match runtime.block_on(crate::store::postgres("killed")) {
        Some(url) => url,
        None => format!("sqlite:{}", shared.path().join("jobs.db").display()),
    };
    let objects = shared.path().join("objects").display().to_string();
    let shared_settings = [
        "--database-url",
        &database,
        "--objects-url",
        &objects,
        "--set",
        "job_lease_ms=1000",
    ];
    copy_dataset(whole, &shared.path().join("objects"));
    let (_server, address) = serve(
        of_server.path(),
        &[&shared_settings[..], &["--run-jobs", "false"]].concat(),
    );
    let start_worker = |dir: &Path| start(dir, &[&["worker"], &shared_settings[..]].concat()).0;
    ask(&address, "POST /v1/jobs", &train());
    assert_eq!(ask(&address, "GET /v1/jobs/job-1", &Value::Null)["state"], "queued");
    let worker = start_worker(first.path());
    let deadline = Instant::now() + TIMEOUT;
    while !shared
        .path()
        .join("objects/runs/job-1/checkpoint.safetensors")
        .is_file()
    {
        assert!(Instant::now() < deadline);
        std::thread::sleep(Duration::from_millis(1));
    }
    drop(worker);
    let _worker = start_worker(second.path());
    let job = wait_for(&address, "job-1", "succeeded");
    assert_eq!(job["attempts"], 2);
    assert!(weights(second.path()) == weights(whole), "the weights differ");
    // The server has no copy of the files, but loads the new model.
    let deadline = Instant::now() + TIMEOUT;
    while ask(&address, "GET /v1/models", &Value::Null)["models"][0]["name"] != "m" {
        assert!(Instant::now() < deadline);
        std::thread::sleep(Duration::from_millis(20));
    }
    let log = ask(&address, "GET /v1/jobs/job-1/logs", &Value::Null);
    let mut lines = log["lines"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(|line| line["line"].as_str());
    // Log lines of the first worker's last half second are lost.
    let resumed = lines.rfind(|line| line.contains(" from step ")).unwrap();
    assert!(!resumed.starts_with("pretrain from step 0,"), "{resumed}");
}
