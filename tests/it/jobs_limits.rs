//! What limits a job: memory, attempts and time; and that its process is not the server's.
#![cfg(target_os = "linux")]

use foreframe::server::ServerConfig;
use serde_json::{Value, json};

use crate::process::{RunningServer, is_alive, signal};
use crate::service::{app, get, poll_until, post};

const JOBS: &str = "/v1/jobs";

fn collect(name: &str, trials: u64) -> Value {
    json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": trials})
}

/// The process ids of a server's jobs. A child that has not yet become a job does not count: while it is stopped, the server
/// waits for it.
fn children(process: u32) -> Vec<u32> {
    let processes = std::fs::read_dir("/proc").unwrap();
    let ids = processes.filter_map(|entry| entry.unwrap().file_name().to_str()?.parse::<u32>().ok());
    let is_job = |id: &u32| {
        let arguments = std::fs::read_to_string(format!("/proc/{id}/cmdline"));
        arguments.is_ok_and(|arguments| arguments.contains("run-job"))
    };
    ids.filter(|id| parent(*id) == Some(process) && is_job(id)).collect()
}

/// The parent of a process that is alive: the second field of its status after its name.
fn parent(process: u32) -> Option<u32> {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    let mut fields = stat.rsplit_once(") ")?.1.split(' ');
    if fields.next()? == "Z" {
        return None;
    }
    fields.next()?.parse().ok()
}

/// The niceness of a process's first thread: the 19th field of its status, the 17th after its name.
fn niceness(process: u32) -> i64 {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    let (_, rest) = stat.rsplit_once(") ").unwrap();
    rest.split(' ').nth(16).unwrap().parse().unwrap()
}

/// The child that works on the job's given attempt.
fn child_of(served: &RunningServer, attempt: u64) -> u32 {
    served.wait_for_job("job-1", |job| {
        job["attempts"].as_u64() >= Some(attempt) && job["state"] == "running"
    });
    served.wait_for_job("job-1", |_| !children(served.program.id()).is_empty());
    children(served.program.id())[0]
}

#[test]
fn a_killed_job_leaves_the_server_running_and_fails_after_three_attempts() {
    let dir = tempfile::tempdir().unwrap();
    let served = RunningServer::start(dir.path(), &["--set", "job_memory_mib=4000", "--set", "job_threads=1"]);
    // No shard is complete before the kill.
    served.ask("POST", JOBS, &collect("seen", 1_000_000));
    let first = child_of(&served, 1);
    // The child sets its limits after it has started.
    let limits = || std::fs::read_to_string(format!("/proc/{first}/limits")).unwrap_or_default();
    let limit = (4000u64 << 20).to_string();
    served.wait_for_job("job-1", |_| limits().contains(&limit));
    let limits = limits();
    let low = (niceness(served.program.id()) + 10).min(19);
    assert_eq!(niceness(first), low);
    for attempt in 1..=3 {
        let child = child_of(&served, attempt);
        signal("-KILL", child);
        served.wait_while_alive(child);
    }
    let job = served.ended_job("job-1");
    assert_eq!(
        (&job["state"], &job["attempts"]),
        (&json!("failed"), &json!(3)),
        "{job}"
    );
    let error = job["error"].as_str().unwrap();
    assert!(
        error.starts_with("3 attempts in a row ended without progress") && error.contains("killed by signal 9"),
        "{error}"
    );
    assert!(served.get("/readyz").starts_with("HTTP/1.1 200"));
    let data = limits.lines().find(|line| line.starts_with("Max data size")).unwrap();
    assert!(data.contains(&limit), "{limits}");
    served.terminate();
    served.wait_for_exit();
}

#[test]
fn a_job_without_progress_is_stopped() {
    let dir = tempfile::tempdir().unwrap();
    let limits = ["--set", "job_stall_limit_s=1", "--set", "job_max_attempts=1"];
    let served = RunningServer::start(dir.path(), &limits);
    served.ask("POST", JOBS, &collect("seen", 1_000_000));
    let child = child_of(&served, 1);
    signal("-STOP", child);
    let job = served.ended_job("job-1");
    assert_eq!(job["state"], "failed", "{job}");
    let error = job["error"].as_str().unwrap();
    assert!(
        error.contains("reported no progress for 1 s (setting job_stall_limit_s)"),
        "{error}"
    );
    assert!(!is_alive(child));
}

#[test]
fn a_job_ends_with_the_server_that_is_killed() {
    let dir = tempfile::tempdir().unwrap();
    let served = RunningServer::start(dir.path(), &[]);
    served.ask("POST", JOBS, &collect("seen", 1_000_000));
    let child = child_of(&served, 1);
    drop(served);
    let deadline = std::time::Instant::now() + crate::service::TIMEOUT;
    while is_alive(child) {
        assert!(std::time::Instant::now() < deadline);
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
}

impl RunningServer {
    fn wait_while_alive(&self, process: u32) {
        self.job_until_any("job-1", |_| !is_alive(process));
    }

    fn ended_job(&self, id: &str) -> Value {
        self.job_until_any(id, |job| {
            ["failed", "succeeded", "cancelled"].contains(&job["state"].as_str().unwrap())
        })
    }

    /// As `job_until`, also of a job that has failed.
    fn job_until_any(&self, id: &str, has_come: impl Fn(&Value) -> bool) -> Value {
        let deadline = std::time::Instant::now() + crate::service::TIMEOUT;
        loop {
            let job = self.ask("GET", &format!("{JOBS}/{id}"), &Value::Null);
            if has_come(&job) {
                return job;
            }
            assert!(std::time::Instant::now() < deadline, "{job}");
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
    }
}

/// Waits until a job has ended, and returns it.
async fn ended(app: &foreframe::server::App, id: &str) -> Value {
    poll_until(async || {
        let job = get(app, &format!("{JOBS}/{id}")).await.json();
        ["failed", "succeeded", "cancelled"]
            .contains(&job["state"].as_str().unwrap())
            .then_some(job)
    })
    .await
}

#[tokio::test]
async fn a_training_that_cannot_fit_is_refused_when_submitted() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        job_memory_mib: 4096,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    post(&app, JOBS, &collect("small", 12)).await;
    assert_eq!(ended(&app, "job-1").await["state"], "succeeded");
    let mut body = json!({"kind": "train", "name": "big", "preset": "paper", "dataset": "small", "settings": {
        "data": {"windows": "all"}, "model": {"hidden": 2048, "features": 2048},
        "pretrain": {"steps": 0, "start": "random"}, "sequence": {"steps": 10, "batch_size": 4096},
    }});
    let detail = post(&app, JOBS, &body).await.detail(422);
    assert!(
        detail.starts_with("settings: the training needs at least ") && detail.contains("a job can use 4096 MiB"),
        "{detail}"
    );
    body["settings"]["sequence"]["batch_size"] = json!(2);
    body["settings"]["model"] = json!({"hidden": 16, "features": 16});
    assert_eq!(post(&app, JOBS, &body).await.status, 202);
}

#[tokio::test]
async fn an_attempt_beyond_the_time_limit_fails() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        job_time_limit_s: 1,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    post(&app, JOBS, &collect("seen", 1_000_000)).await;
    let job = ended(&app, "job-1").await;
    assert_eq!(job["state"], "failed");
    let error = job["error"].as_str().unwrap();
    assert!(
        error.contains("the time limit of 1 s (setting job_time_limit_s)"),
        "{error}"
    );
}
