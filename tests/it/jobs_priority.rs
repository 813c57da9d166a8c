//! Thread priorities of the real program while a job runs. Only Linux has a priority per thread.
#![cfg(target_os = "linux")]

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::process::{Program, RunningServer};
use crate::service::TIMEOUT;

/// Name and nice value of each thread of a process.
fn threads(process: u32) -> Vec<(String, i64)> {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let stats = tasks.filter_map(|task| std::fs::read_to_string(task.unwrap().path().join("stat")).ok());
    stats
        .map(|stat| {
            let (head, rest) = stat.rsplit_once(") ").unwrap();
            let (_, name) = head.split_once('(').unwrap();
            // Field 19 of the file; the first field after the name is field 3.
            let niceness = rest.split(' ').nth(16).unwrap().parse().unwrap();
            (name.to_owned(), niceness)
        })
        .collect()
}

/// Whether all job threads exist and have a lower priority, and all others have the priority of the process.
fn has_lower_priority(process: u32) -> bool {
    let threads = threads(process);
    // With threads shared by candle, predictions would wait for the training.
    assert!(
        !threads.iter().any(|(name, _)| name.starts_with("candle")),
        "{threads:?}"
    );
    let (jobs, others): (Vec<_>, Vec<_>) = threads.iter().partition(|(name, _)| name.starts_with("jobs"));
    let of_process = others.iter().find(|(name, _)| name == "foreframe").unwrap().1;
    assert!(
        others.iter().all(|(_, niceness)| *niceness == of_process),
        "{threads:?}"
    );
    let low = (of_process + 10).min(19);
    // One thread that waits for the work, and two of the pool.
    jobs.len() >= 3 && jobs.iter().all(|(_, niceness)| *niceness == low)
}

fn wait_for_lower_priority(process: u32) {
    let deadline = Instant::now() + TIMEOUT;
    while !has_lower_priority(process) {
        assert!(Instant::now() < deadline, "{:?}", threads(process));
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn collect(name: &str, trials: u64) -> Value {
    json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": trials})
}

#[test]
fn job_threads_of_a_server_have_lower_priority() {
    let dir = tempfile::tempdir().unwrap();
    let server = RunningServer::start(dir.path(), &["--set", "job_threads=2"]);
    server.ask("POST", "/v1/jobs", &collect("seen", 40));
    server.wait_for_job("job-1", |job| job["state"] == "succeeded");
    let settings = json!({"data": {"windows": 64, "validation_windows": 8}});
    let train = json!({"kind": "train", "name": "m", "preset": "paper", "dataset": "seen", "settings": settings});
    for job in [&train, &collect("more", 100_000)] {
        let id = server.ask("POST", "/v1/jobs", job)["id"].as_str().unwrap().to_owned();
        server.wait_for_job(&id, |job| job["progress"]["done"].as_u64() > Some(0));
        wait_for_lower_priority(server.program.id());
        server.ask("POST", &format!("/v1/jobs/{id}/cancel"), &Value::Null);
    }
    let names: Vec<String> = threads(server.program.id()).into_iter().map(|(name, _)| name).collect();
    assert!(names.iter().any(|name| name == "inference"), "{names:?}");
}

#[test]
fn job_threads_of_a_worker_have_lower_priority() {
    let dir = tempfile::tempdir().unwrap();
    let server = RunningServer::start(dir.path(), &["--run-jobs", "false"]);
    let worker = Program::start(dir.path(), &["worker", "--set", "job_threads=2"]);
    server.ask("POST", "/v1/jobs", &collect("seen", 100_000));
    server.wait_for_job("job-1", |job| job["progress"]["done"].as_u64() > Some(0));
    wait_for_lower_priority(worker.id());
}
