//! Stores that go away and come back while a server uses them: a PostgreSQL that is not there yet, is stopped, paused and
//! started again, and an object store that fails. The tests start a PostgreSQL of their own; without its programs they are
//! skipped.
#![cfg(unix)]

use std::net::TcpListener;
use std::path::PathBuf;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::metrics::wait_for_metric;
use crate::process::{RunningServer, output, text};
use crate::service::TIMEOUT;
use crate::skip::skip_without;

/// A PostgreSQL server of this test. Dropping it stops it.
pub(crate) struct OwnPostgres {
    dir: tempfile::TempDir,
    tools: PathBuf,
    port: u16,
}

impl OwnPostgres {
    /// A new database cluster that is not started yet; none if PostgreSQL is not installed.
    pub(crate) fn new() -> Option<Self> {
        let Some(tools) = tools() else {
            skip_without("PostgreSQL's programs are not installed");
            return None;
        };
        let dir = tempfile::tempdir().unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let postgres = Self { dir, tools, port };
        if is_root() {
            // PostgreSQL refuses to be run by root.
            let owned = Command::new("chown").arg("postgres").arg(postgres.dir.path()).status();
            assert!(owned.unwrap().success());
        }
        let data = postgres.data();
        postgres.succeed("initdb", &["-D", &data, "-U", "foreframe", "-A", "trust", "--no-sync"]);
        Some(postgres)
    }

    pub(crate) fn url(&self) -> String {
        format!("postgres://foreframe@127.0.0.1:{}/postgres", self.port)
    }

    fn data(&self) -> String {
        self.dir.path().join("data").display().to_string()
    }

    pub(crate) fn port(&self) -> u16 {
        self.port
    }

    pub(crate) fn start(&self) {
        let (data, log) = (self.data(), self.dir.path().join("log").display().to_string());
        let sockets = self.dir.path().display();
        let options = format!(
            "-p {} -k {sockets} -c listen_addresses=127.0.0.1 -c fsync=off",
            self.port
        );
        self.succeed("pg_ctl", &["-D", &data, "-l", &log, "-w", "-o", &options, "start"]);
    }

    /// Ends it without a clean shutdown.
    pub(crate) fn stop(&self) {
        self.succeed("pg_ctl", &["-D", &self.data(), "-m", "immediate", "-w", "stop"]);
    }

    /// Sends a signal to all of its processes.
    pub(crate) fn signal(&self, signal: &str) {
        let file = std::fs::read_to_string(self.dir.path().join("data/postmaster.pid")).unwrap();
        let postmaster = file.lines().next().unwrap().to_owned();
        let children = Command::new("ps")
            .args(["-o", "pid=", "--ppid", &postmaster])
            .output()
            .unwrap();
        let children = text(&children.stdout);
        // The first to be stopped and the last to go on, so that it starts no process in between.
        for process in std::iter::once(postmaster.as_str()).chain(children.split_whitespace()) {
            // A child can have ended meanwhile.
            let _ = Command::new("kill").args([signal, process]).status();
        }
    }

    fn run(&self, tool: &str, arguments: &[&str]) -> Output {
        let tool = self.tools.join(tool);
        let mut command = if is_root() {
            let mut command = Command::new("runuser");
            command.args(["-u", "postgres", "--"]).arg(tool);
            command
        } else {
            Command::new(tool)
        };
        command.args(arguments).current_dir("/").output().unwrap()
    }

    pub(crate) fn succeed(&self, tool: &str, arguments: &[&str]) {
        let output = self.run(tool, arguments);
        assert!(output.status.success(), "{tool}: {}", text(&output.stderr));
    }
}

impl Drop for OwnPostgres {
    fn drop(&mut self) {
        // In a failing test it can be paused, or stopped already.
        let data = self.dir.path().join("data/postmaster.pid");
        if data.exists() {
            self.signal("-CONT");
            self.run("pg_ctl", &["-D", &self.data(), "-m", "immediate", "stop"]);
        }
    }
}

pub(crate) fn is_root() -> bool {
    text(&Command::new("id").arg("-u").output().unwrap().stdout).trim() == "0"
}

/// The directory of PostgreSQL's programs.
fn tools() -> Option<PathBuf> {
    let versions = std::fs::read_dir("/usr/lib/postgresql").into_iter().flatten().flatten();
    let debian = versions.map(|version| version.path().join("bin"));
    let path = std::env::var_os("PATH").unwrap_or_default();
    let mut found: Vec<PathBuf> = debian.chain(std::env::split_paths(&path)).collect();
    found.retain(|dir| dir.join("initdb").is_file());
    found.into_iter().next()
}

pub(crate) fn status(answer: &str) -> &str {
    answer.split(' ').nth(1).unwrap_or_default()
}

/// Whether the server can write its store, as its metrics tell.
pub(crate) const WRITABLE: &str = "foreframe_store_writable";

pub(crate) fn wait_for_status(server: &RunningServer, path: &str, expected: &str) -> String {
    let deadline = Instant::now() + TIMEOUT;
    loop {
        let answer = server.get(path);
        if status(&answer) == expected {
            return answer;
        }
        assert!(Instant::now() < deadline, "{path}: {answer}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// A job that collects one trial.
fn collect(name: &str) -> Value {
    json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 1})
}

#[test]
fn a_server_survives_a_database_that_goes_away() {
    let Some(postgres) = OwnPostgres::new() else { return };
    postgres.start();
    let dir = tempfile::tempdir().unwrap();
    let url = postgres.url();
    // Shorter than a statement may take.
    let settings = [
        "--run-jobs",
        "false",
        "--database-url",
        &url,
        "--set",
        "request_deadline_ms=5000",
    ];
    let server = RunningServer::start(dir.path(), &settings);
    assert_eq!(server.ask("POST", "/v1/jobs", &collect("before"))["id"], "job-1");

    postgres.stop();
    let refused = wait_for_status(&server, "/v1/jobs", "503");
    assert!(refused.to_lowercase().contains("\r\nretry-after: "), "{refused}");
    assert_eq!(server.ask("POST", "/v1/jobs", &collect("meanwhile"))["status"], 503);
    assert_eq!(status(&server.get("/livez")), "200");
    wait_for_metric(&server, WRITABLE, 0.0);
    // Load balancers send it predictions, which need no database.
    assert_eq!(status(&server.get("/readyz")), "200");
    postgres.start();
    wait_for_metric(&server, WRITABLE, 1.0);
    assert_eq!(server.ask("POST", "/v1/jobs", &collect("after"))["id"], "job-2");

    postgres.signal("-STOP");
    wait_for_metric(&server, WRITABLE, 0.0);
    assert_eq!(status(&server.get("/readyz")), "200");
    let refused = wait_for_status(&server, "/v1/jobs", "503");
    assert!(refused.contains("no answer was ready within 5000 ms"), "{refused}");
    assert_eq!(status(&server.get("/livez")), "200");
    postgres.signal("-CONT");
    wait_for_metric(&server, WRITABLE, 1.0);
    let jobs = server.ask("GET", "/v1/jobs", &Value::Null);
    let names: Vec<_> = jobs["jobs"]
        .as_array()
        .unwrap()
        .iter()
        .map(|job| &job["spec"]["name"])
        .collect();
    assert_eq!(names, ["after", "before"]);
}

#[test]
fn a_database_that_only_reads_for_a_while_refuses_writes_until_later() {
    let Some(postgres) = OwnPostgres::new() else { return };
    postgres.start();
    let dir = tempfile::tempdir().unwrap();
    let url = postgres.url();
    let server = RunningServer::start(dir.path(), &["--run-jobs", "false", "--database-url", &url]);
    let create = |name: &str| server.ask("POST", "/v1/jobs", &collect(name));
    let read_only = |value: &str| {
        let setting = format!("ALTER SYSTEM SET default_transaction_read_only = {value}");
        for statement in [setting.as_str(), "SELECT pg_reload_conf()"] {
            postgres.succeed("psql", &["-q", "-d", &url, "-c", statement]);
        }
    };
    // The server's connections notice a changed setting between two statements.
    let wait_until = |name: &str, is_reached: &dyn Fn(&Value) -> bool| {
        let deadline = Instant::now() + TIMEOUT;
        loop {
            let answer = create(name);
            if is_reached(&answer) {
                return;
            }
            assert!(Instant::now() < deadline, "{answer}");
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    assert_eq!(create("before")["id"], "job-1");

    read_only("on");
    wait_until("meanwhile", &|answer| answer["status"] == 503);
    assert_eq!(status(&server.get("/v1/jobs")), "200");
    assert_eq!(status(&server.get("/livez")), "200");
    read_only("off");
    wait_until("after", &|answer| answer["id"].is_string());
    let kept = server.get("/v1/jobs");
    assert!(kept.contains("\"before\"") && kept.contains("\"after\""), "{kept}");
}

#[test]
fn a_starting_server_waits_for_its_database() {
    let Some(postgres) = OwnPostgres::new() else { return };
    let dir = tempfile::tempdir().unwrap();
    let url = postgres.url();
    std::thread::scope(|scope| {
        let starting = scope.spawn(|| RunningServer::start(dir.path(), &["--database-url", &url]));
        // Until it has tried at least once.
        let deadline = Instant::now() + TIMEOUT;
        let log = || std::fs::read_to_string(dir.path().join("serve.log")).unwrap_or_default();
        while !log().contains("waiting for the database") {
            assert!(Instant::now() < deadline, "{}", log());
            std::thread::sleep(Duration::from_millis(50));
        }
        postgres.start();
        let server = starting.join().unwrap();
        assert_eq!(status(&server.get("/v1/jobs")), "200");
    });
}

#[test]
fn a_server_gives_up_on_a_database_that_does_not_come() {
    let dir = tempfile::tempdir().unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("postgres://nobody@{}/none", listener.local_addr().unwrap());
    drop(listener);
    let settings = ["--database-url", &url, "--set", "database_wait_s=0", "--port", "0"];
    let output = output(dir.path(), &[&["serve"], &settings[..]].concat());
    let error = text(&output.stderr);
    let last = error.lines().last().unwrap();
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(
        last.starts_with("error: gave up after waiting ") && last.contains("could not open the PostgreSQL database"),
        "{error}"
    );
}

#[test]
fn a_job_waits_for_its_object_store() {
    let (dir, shared) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let url = shared.path().display().to_string();
    let server = RunningServer::start(dir.path(), &["--objects-url", &url, "--log-format", "json"]);
    assert_eq!(server.ask("POST", "/v1/jobs", &collect("seen"))["id"], "job-1");
    server.wait_for_job("job-1", |job| job["state"] == "running");
    // Nothing can be written below a file.
    let obstacle = shared.path().join("datasets");
    std::fs::write(&obstacle, "").unwrap();
    let waits = |job: &Value| {
        let message = job["progress"]["message"].as_str().unwrap_or_default();
        message.starts_with("waiting for the store: could not")
    };
    let job = server.wait_for_job("job-1", waits);
    assert_eq!(job["state"], "running", "{job}");
    let log = server.get("/v1/jobs/job-1/logs");
    assert!(log.contains("waiting for the store: could not"), "{log}");
    std::fs::remove_file(obstacle).unwrap();
    let job = server.wait_for_job("job-1", |job| job["state"] == "succeeded");
    assert!(job["attempts"] == 1 && !waits(&job), "{job}");
    assert!(shared.path().join("datasets/seen/meta/info.json").is_file());
    server.terminate();
    let log = server.wait_for_exit();
    // The job's process writes it.
    assert!(log.contains("a job waits for the store"), "{log}");
    for line in log.lines() {
        assert!(serde_json::from_str::<Value>(line).is_ok(), "not JSON: {line}");
    }
}
