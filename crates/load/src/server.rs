//! The server under load: the real program with its own data directory.

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::http::{Http, Request};
use crate::process_usage::Process;
use crate::project;
use crate::report::Bounds;

/// How long the server may take to become ready.
const START_LIMIT: Duration = Duration::from_mins(1);
/// Connections that the server takes from one address. All of this program's come from one.
const CONNECTIONS: &str = "max_connections_per_address=100000";

/// The server and model under load.
#[derive(clap::Args, Clone)]
pub(crate) struct Target {
    /// A shipped model
    #[arg(long, default_value = "moving")]
    pub(crate) model: String,
    /// Restrict the server to this core
    #[arg(long)]
    pub(crate) server_cpu: Option<usize>,
}

/// The server's process. Dropping it ends the process.
pub(crate) struct Server {
    child: Child,
    pub(crate) address: SocketAddr,
    pub(crate) process: Process,
    log: PathBuf,
    _data: tempfile::TempDir,
}

impl Server {
    /// Starts the server with these settings and waits until it is ready.
    pub(crate) async fn start(target: &Target, settings: &[(&str, usize)]) -> Self {
        let (program, data) = (project::program(), tempfile::tempdir().unwrap());
        let mut command = match target.server_cpu {
            Some(cpu) => {
                let mut command = Command::new("taskset");
                command.args(["-c", &cpu.to_string()]).arg(program);
                command
            }
            None => Command::new(program),
        };
        let log = data.path().join("log");
        let mut child = command
            .args(["serve", "--bind", "127.0.0.1:0", "--set", CONNECTIONS, "--data-dir"])
            .arg(data.path())
            .args(
                settings
                    .iter()
                    .flat_map(|(name, value)| ["--set".to_owned(), format!("{name}={value}")]),
            )
            .current_dir(project::root())
            .env("RUST_LOG", "warn")
            .stdout(Stdio::piped())
            .stderr(File::create(&log).unwrap())
            .spawn()
            .unwrap();
        let mut line = String::new();
        let said = BufReader::new(child.stdout.take().unwrap()).read_line(&mut line);
        let address = line.split("http://").nth(1).and_then(|rest| rest.split('/').next());
        let address = address.and_then(|address| address.parse().ok());
        let server = Self {
            process: Process(child.id().to_string()),
            address: address.unwrap_or_else(|| panic!("the server did not start, {said:?}: {}", read(&log))),
            child,
            log,
            _data: data,
        };
        server.ready().await;
        server
    }

    async fn ready(&self) {
        let (mut http, since) = (Http::new(self.address), Instant::now());
        while http
            .ask(&Request::get("/readyz"))
            .await
            .is_ok_and(|answer| answer.status != 200)
        {
            assert!(
                since.elapsed() < START_LIMIT,
                "the server does not become ready: {}",
                read(&self.log)
            );
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    /// Checks that the server still runs and its log has no error.
    pub(crate) fn check(&mut self, bounds: &mut Bounds) {
        let log = read(&self.log);
        let errors: Vec<&str> = log
            .lines()
            .filter(|line| line.contains("ERROR") || line.contains("panicked"))
            .collect();
        for line in errors.iter().take(5) {
            println!("  {line}");
        }
        let has_ended = self.child.try_wait().unwrap();
        let what = format!("the server runs, and its log has no errors ({} found)", errors.len());
        bounds.check(has_ended.is_none() && errors.is_empty(), what);
    }
}

fn read(log: &PathBuf) -> String {
    fs::read_to_string(log).unwrap_or_default()
}

impl Drop for Server {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
