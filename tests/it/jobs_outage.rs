//! Trainings whose database is away for longer than their lease: they end with the weights of an undisturbed training,
//! published once.

use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};

use crate::jobs_killed::{ask, collect, copy_dataset, serve, wait_for, wait_until, weights};
use crate::store_away::OwnPostgres;

/// The lease of these tests: an outage of a few seconds is longer.
const SHORT_LEASE: [&str; 2] = ["--set", "job_lease_ms=2000"];

/// A short training that saves often.
pub(crate) fn short_training() -> Value {
    training(24)
}

/// The same with this number of steps, each of a few milliseconds.
pub(crate) fn training(steps: u32) -> Value {
    let settings = json!({
        "model": {"features": 16, "hidden": 16},
        "data": {"windows": 32, "validation_windows": 4},
        "pretrain": {"steps": 0, "start": "random"},
        "sequence": {"steps": steps, "batch_size": 8},
        "run": {"validate_every_steps": 8, "checkpoint_every_steps": 2},
    });
    json!({"kind": "train", "name": "m", "preset": "paper", "dataset": "seen", "settings": settings})
}

/// A data directory after an undisturbed collection and training.
pub(crate) fn undisturbed(training: &Value) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let (_server, address) = serve(dir.path(), &[]);
    ask(&address, "POST /v1/jobs", &collect());
    wait_for(&address, "job-1", "succeeded");
    ask(&address, "POST /v1/jobs", training);
    wait_for(&address, "job-2", "succeeded");
    dir
}

fn begins(address: &str, id: &str) {
    ask(address, "POST /v1/jobs", &short_training());
    wait_until(address, id, |job| job["progress"]["done"].as_u64() > Some(0));
}

/// Checks the job and its model after the outage.
fn ends_as_undisturbed(address: &str, data_dir: &Path, whole: &Path) {
    let job = wait_for(address, "job-1", "succeeded");
    assert_eq!((&job["attempts"], &job["result"]["version"]), (&json!(1), &json!(1)));
    assert!(weights(data_dir) == weights(whole), "the weights differ");
    let published = std::fs::read_dir(data_dir.join("models/m")).unwrap();
    assert_eq!(published.count(), 1);
}

#[test]
fn a_training_survives_a_database_that_another_process_locks() {
    let whole = undisturbed(&short_training());
    let dir = tempfile::tempdir().unwrap();
    copy_dataset(whole.path(), dir.path());
    let (_server, address) = serve(dir.path(), &SHORT_LEASE);
    begins(&address, "job-1");
    let other = rusqlite::Connection::open(dir.path().join("foreframe.db")).unwrap();
    other.busy_timeout(Duration::from_secs(10)).unwrap();
    other.execute_batch("BEGIN EXCLUSIVE").unwrap();
    // Statements wait for 10 s, then they fail.
    std::thread::sleep(Duration::from_secs(13));
    let refused = ask(&address, "POST /v1/jobs", &short_training());
    assert_eq!(refused["status"], 503, "{refused}");
    other.execute_batch("COMMIT").unwrap();
    ends_as_undisturbed(&address, dir.path(), whole.path());
}

#[test]
fn a_training_survives_an_outage_of_postgresql() {
    type Outage = fn(&OwnPostgres);
    let outages: [Outage; 2] = [
        |postgres| {
            postgres.stop();
            std::thread::sleep(Duration::from_secs(6));
            postgres.start();
        },
        |postgres| {
            postgres.signal("-STOP");
            std::thread::sleep(Duration::from_secs(6));
            postgres.signal("-CONT");
        },
    ];
    let mut baseline = None;
    for outage in outages {
        let Some(postgres) = OwnPostgres::new() else { return };
        let whole = baseline.get_or_insert_with(|| undisturbed(&short_training()));
        postgres.start();
        let dir = tempfile::tempdir().unwrap();
        copy_dataset(whole.path(), dir.path());
        let url = postgres.url();
        let (_server, address) = serve(dir.path(), &[&["--database-url", &url], &SHORT_LEASE[..]].concat());
        begins(&address, "job-1");
        outage(&postgres);
        ends_as_undisturbed(&address, dir.path(), whole.path());
    }
}
