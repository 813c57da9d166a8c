//! The server's process, started again after it was killed.

use std::fs::{self, File, OpenOptions};
use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::http::{Http, Request};
use crate::project;

/// How long the server may take to become ready.
const START_LIMIT: Duration = Duration::from_mins(2);
const POLL: Duration = Duration::from_millis(20);
/// How long a clean stop may take.
const STOP_LIMIT: Duration = Duration::from_mins(1);

/// Settings of the server: few jobs wait, so that they end soon after the load also on a slow machine, and every ended job is
/// kept, so that all can be checked.
const SETTINGS: [&str; 3] = ["max_queued_jobs=6", "max_ended_jobs=10000", "admin_bind=off"];

/// The server's program with its arguments. Dropping it kills the process.
pub(super) struct Supervisor {
    pub(super) data_dir: PathBuf,
    /// The arguments that name the store.
    pub(super) store_arguments: Vec<String>,
    log: PathBuf,
    child: Option<Child>,
    pub(super) address: SocketAddr,
}

impl Supervisor {
    /// Starts the server on a free port. Its log must not lie on the disk that becomes full.
    pub(super) async fn start(data_dir: &Path, store_arguments: &[String], log: &Path) -> Self {
        let mut supervisor = Self {
            data_dir: data_dir.to_owned(),
            store_arguments: store_arguments.to_vec(),
            log: log.to_owned(),
            child: None,
            address: SocketAddr::from(([127, 0, 0, 1], 0)),
        };
        supervisor.spawn().await;
        supervisor
    }

    /// Starts the server at its address and waits until it is ready.
    pub(super) async fn spawn(&mut self) {
        let log = OpenOptions::new().append(true).create(true).open(&self.log).unwrap();
        self.address = tokio::task::block_in_place(|| self.spawn_process(log));
        let (mut http, since) = (Http::new(self.address), Instant::now());
        while http
            .ask(&Request::get("/readyz"))
            .await
            .map_or(true, |answer| answer.status != 200)
        {
            assert!(since.elapsed() < START_LIMIT, "the server does not become ready");
            tokio::time::sleep(POLL).await;
        }
    }

    fn spawn_process(&mut self, log: File) -> SocketAddr {
        let mut child = Command::new(project::program())
            .args(["serve", "--bind", &self.address.to_string(), "--data-dir"])
            .arg(&self.data_dir)
            .args(&self.store_arguments)
            .args(SETTINGS.iter().flat_map(|setting| ["--set", setting]))
            .current_dir(project::root())
            .env("RUST_LOG", "warn")
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .unwrap();
        let mut line = String::new();
        let read = BufReader::new(child.stdout.take().unwrap()).read_line(&mut line);
        self.child = Some(child);
        let address = line.split("http://").nth(1).and_then(|rest| rest.split('/').next());
        let address = address.and_then(|address| address.parse().ok());
        address.unwrap_or_else(|| panic!("the server did not start, {read:?}: {}", self.log()))
    }

    /// Kills the process with SIGKILL. Returns whether it was running until then.
    pub(super) fn kill(&mut self) -> bool {
        let Some(mut child) = self.child.take() else {
            return false;
        };
        let was_running = child.try_wait().unwrap().is_none();
        child.kill().unwrap();
        child.wait().unwrap();
        was_running
    }

    /// Stops the server by SIGTERM. Returns whether it ended with success in time.
    pub(super) async fn stop(&mut self) -> bool {
        let Some(mut child) = self.child.take() else {
            return false;
        };
        let terminated = Command::new("kill").args(["-TERM", &child.id().to_string()]).status();
        assert!(terminated.unwrap().success());
        let since = Instant::now();
        while since.elapsed() < STOP_LIMIT {
            if let Some(status) = child.try_wait().unwrap() {
                return status.success();
            }
            tokio::time::sleep(POLL).await;
        }
        let _ = child.kill();
        let _ = child.wait();
        false
    }

    pub(super) fn is_running(&mut self) -> bool {
        self.child
            .as_mut()
            .is_some_and(|child| child.try_wait().unwrap().is_none())
    }

    pub(super) fn log(&self) -> String {
        fs::read_to_string(&self.log).unwrap_or_default()
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            // It may have ended already.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}
