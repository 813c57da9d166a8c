//! A file system that turns read-only or fails while a server and its training use it. A small library that is preloaded into
//! the program makes its writes fail; without a C compiler the test is skipped.
#![cfg(target_os = "linux")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use serde_json::{Value, json};

use crate::jobs_killed::{copy_dataset, weights};
use crate::jobs_outage::{training, undisturbed};
use crate::process::RunningServer;
use crate::store_away::{status, wait_for_status};

const EIO: u32 = 5;
const EROFS: u32 = 30;

fn compiled(dir: &Path) -> Option<PathBuf> {
    let library = dir.join("failing_files.so");
    let compiler = Command::new("cc")
        .args(["-shared", "-fPIC", "-o"])
        .arg(&library)
        .args([
            concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/failing_files.c"),
            "-ldl",
        ])
        .output();
    let Ok(output) = compiler else {
        println!("skipped: there is no C compiler");
        return None;
    };
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(library)
}

/// Steps of a training that takes some seconds, so that the files fail while it runs.
const STEPS: u32 = 1500;

#[test]
fn a_server_recovers_from_a_failing_file_system() {
    let tools = tempfile::tempdir().unwrap();
    let Some(library) = compiled(tools.path()) else { return };
    let whole = undisturbed(&training(STEPS));
    for number in [EROFS, EIO] {
        recovers_from(number, &library, whole.path());
    }
}

fn recovers_from(number: u32, library: &Path, whole: &Path) {
    let dir = tempfile::tempdir().unwrap();
    let (data, switch) = (dir.path().join("data"), dir.path().join("switch"));
    copy_dataset(whole, &data);
    let [data_text, switch_text, library] = [&data, &switch, library].map(|path: &Path| path.to_str().unwrap());
    let environment = [
        ("LD_PRELOAD", library),
        ("FAILING_DIR", data_text),
        ("FAILING_SWITCH", switch_text),
    ];
    let server = RunningServer::start_with(dir.path(), &["--data-dir", data_text], &environment);
    let wait_for_success = |id: &str| server.wait_for_job(id, |job| job["state"] == "succeeded");
    let collect = |name: &str| json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 1});
    assert_eq!(server.ask("POST", "/v1/jobs", &training(STEPS))["id"], "job-1");
    server.wait_for_job("job-1", |job| job["progress"]["done"].as_u64() > Some(0));

    // Written whole before it is seen.
    let partial = dir.path().join("switch.partial");
    std::fs::write(&partial, number.to_string()).unwrap();
    std::fs::rename(partial, &switch).unwrap();
    wait_for_status(&server, "/readyz", "503");
    let refused = server.send("POST", "/v1/jobs", &collect("refused").to_string());
    assert_eq!(status(&refused), "503", "{refused}");
    assert!(refused.to_lowercase().contains("\r\nretry-after: "), "{refused}");
    assert_eq!(status(&server.get("/livez")), "200");
    assert_eq!(status(&server.get("/v1/models")), "200");
    std::thread::sleep(Duration::from_secs(3));
    std::fs::remove_file(&switch).unwrap();

    wait_for_status(&server, "/readyz", "200");
    assert_eq!(server.ask("POST", "/v1/jobs", &collect("after"))["id"], "job-2");
    let trained = wait_for_success("job-1");
    assert_eq!(
        (&trained["attempts"], &trained["result"]["version"]),
        (&json!(1), &json!(1))
    );
    assert!(weights(&data) == weights(whole), "the weights differ");
    let log = server.get("/v1/jobs/job-1/logs");
    assert!(log.contains("waiting for the store: "), "{log}");
    wait_for_success("job-2");
    let jobs = server.ask("GET", "/v1/jobs", &Value::Null);
    assert_eq!(jobs["jobs"].as_array().unwrap().len(), 2, "{jobs}");
}
