//! A file system that turns read-only or fails while a server and its training use it. A small library that is preloaded into
//! the program makes its writes fail; without a C compiler the test is skipped.
#![cfg(target_os = "linux")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use foreframe_core::nn::Conditioning;
use serde_json::{Value, json};

use crate::jobs_killed::{copy_dataset, weights};
use crate::jobs_outage::{training, undisturbed};
use crate::metrics::wait_for_metric;
use crate::process::{RunningServer, foreframe, output, text};
use crate::recordings;
use crate::service::{context, model, spec};
use crate::store_away::{WRITABLE, status};

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

/// Frames of a recording that takes some seconds to import.
const FRAMES: u32 = 20_000;
/// Steps of a training: enough that it still runs when the files begin to fail. It saves a checkpoint every other step, so it
/// cannot end while they fail.
const STEPS: u32 = 600;

#[test]
fn a_server_recovers_from_a_failing_file_system() {
    let tools = tempfile::tempdir().unwrap();
    let Some(library) = compiled(tools.path()) else { return };
    let whole = undisturbed(&training(STEPS));
    for number in [EROFS, EIO] {
        recovers_from(number, &library, whole.path());
    }
}

/// A server whose files below `data` fail while the switch is on.
struct FailingServer {
    server: RunningServer,
    switch: PathBuf,
}

impl FailingServer {
    fn start(dir: &Path, library: &Path) -> Self {
        let (data, switch, import) = (dir.join("data"), dir.join("switch"), dir.join("recordings"));
        for dir in [&data, &import] {
            std::fs::create_dir_all(dir).unwrap();
        }
        let [data, switch_text, library] = [&data, &switch, library].map(|path: &Path| path.to_str().unwrap());
        let environment = [
            ("LD_PRELOAD", library),
            ("FAILING_DIR", data),
            ("FAILING_SWITCH", switch_text),
        ];
        let import = format!("import_dir={}", import.display());
        let server = RunningServer::start_with(dir, &["--data-dir", data, "--set", &import], &environment);
        Self { server, switch }
    }

    fn fail_with(&self, number: u32) {
        // Written whole before it is seen.
        let partial = self.switch.with_extension("partial");
        std::fs::write(&partial, number.to_string()).unwrap();
        std::fs::rename(partial, &self.switch).unwrap();
    }

    fn mend(&self) {
        std::fs::remove_file(&self.switch).unwrap();
    }

    fn wait_for_success(&self, id: &str) -> Value {
        self.server.wait_for_job(id, |job| job["state"] == "succeeded")
    }
}

fn recovers_from(number: u32, library: &Path, whole: &Path) {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    copy_dataset(whole, &data);
    let models = dir.path().join("models");
    std::fs::create_dir(&models).unwrap();
    model(&models, "plain", spec(Conditioning::None));
    let failing = FailingServer::start(dir.path(), library);
    let server = &failing.server;
    let collect = |name: &str| json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 1});
    assert_eq!(server.ask("POST", "/v1/jobs", &training(STEPS))["id"], "job-1");
    server.wait_for_job("job-1", |job| job["progress"]["done"].as_u64() > Some(0));

    failing.fail_with(number);
    wait_for_metric(server, WRITABLE, 0.0);
    assert_eq!(status(&server.get("/readyz")), "200");
    let refused = server.send("POST", "/v1/jobs", &collect("refused").to_string());
    assert_eq!(status(&refused), "503", "{refused}");
    assert!(refused.to_lowercase().contains("\r\nretry-after: "), "{refused}");
    assert_eq!(status(&server.get("/livez")), "200");
    // Predictions need no file.
    let predicted = server.ask("POST", "/v1/models/plain/predict", &json!({"frames": context()}));
    assert!(predicted["frames"].is_array(), "{predicted}");
    // What needs the database is refused for a while, or answered by a connection that is still open.
    for models in all_at_once(|_| server.get("/v1/models")) {
        assert!(["200", "503"].contains(&status(&models)), "{models}");
    }
    std::thread::sleep(Duration::from_secs(3));
    failing.mend();

    wait_for_metric(server, WRITABLE, 1.0);
    // On every connection to the database, also on those that were opened meanwhile.
    let jobs = all_at_once(|index| server.ask("POST", "/v1/jobs", &collect(&format!("after-{index}"))));
    for job in &jobs {
        assert!(job["id"].is_string(), "{job}");
    }
    let trained = failing.wait_for_success("job-1");
    assert_eq!(
        (&trained["attempts"], &trained["result"]["version"]),
        (&json!(1), &json!(1))
    );
    assert!(weights(&data) == weights(whole), "the weights differ");
    let log = server.get("/v1/jobs/job-1/logs");
    assert!(log.contains("waiting for the store: "), "{log}");
    for job in &jobs {
        failing.wait_for_success(job["id"].as_str().unwrap());
    }
    let known = server.ask("GET", "/v1/jobs", &Value::Null);
    assert_eq!(known["jobs"].as_array().unwrap().len(), 1 + jobs.len(), "{known}");
}

/// What twelve calls at the same time return: more than there are connections to the database.
fn all_at_once<T: Send>(call: impl Fn(usize) -> T + Sync) -> Vec<T> {
    std::thread::scope(|scope| {
        let call = &call;
        let calls: Vec<_> = (0..12).map(|index| scope.spawn(move || call(index))).collect();
        calls.into_iter().map(|call| call.join().unwrap()).collect()
    })
}

#[test]
fn a_database_that_cannot_be_written_is_refused_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let Some(library) = compiled(dir.path()) else { return };
    let data = dir.path().join("data");
    let list = |database: &Path| {
        let switch = dir.path().join("switch");
        std::fs::write(&switch, EROFS.to_string()).unwrap();
        let arguments = ["models", "list", "--data-dir", data.to_str().unwrap()];
        let mut command = foreframe(dir.path());
        command.args(arguments).env("LD_PRELOAD", &library);
        command.env("FAILING_DIR", database).env("FAILING_SWITCH", switch);
        command.output().unwrap()
    };
    // A list alone makes no database.
    let made = output(
        dir.path(),
        &["keys", "create", "robot", "--data-dir", data.to_str().unwrap()],
    );
    assert!(made.status.success(), "{}", text(&made.stderr));
    assert!(list(Path::new("/nowhere")).status.success());
    let started = Instant::now();
    let refused = list(&data.join("foreframe.db"));
    let error = text(&refused.stderr);
    assert!(!refused.status.success(), "{error}");
    assert!(error.contains("could not open the SQLite database: "), "{error}");
    assert!(started.elapsed() < Duration::from_secs(8), "{error}");
}

#[test]
fn an_import_waits_for_a_failing_file_system() {
    let dir = tempfile::tempdir().unwrap();
    let Some(library) = compiled(dir.path()) else { return };
    let recordings = dir.path().join("recordings");
    let failing = FailingServer::start(dir.path(), &library);
    recordings::npy(&recordings.join("long.npy"), FRAMES);
    let job = json!({"kind": "import", "source": "long.npy", "name": "long", "rate": 10.0, "size": "96x96"});
    assert_eq!(failing.server.ask("POST", "/v1/jobs", &job)["id"], "job-1");
    failing
        .server
        .wait_for_job("job-1", |job| job["progress"]["done"].as_u64() > Some(0));
    failing.fail_with(EIO);
    // On a busy machine the job writes seldom.
    std::thread::sleep(Duration::from_secs(8));
    failing.mend();
    let imported = failing.wait_for_success("job-1");
    assert_eq!(
        (&imported["attempts"], &imported["result"]["frames"]),
        (&json!(1), &json!(FRAMES))
    );
    let log = failing.server.get("/v1/jobs/job-1/logs");
    assert!(log.contains("waiting for the store: "), "{log}");
}
