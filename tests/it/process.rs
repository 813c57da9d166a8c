//! The real program as a child process: started, called over sockets, and stopped.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::service::TIMEOUT;

/// A command of the program in a directory, without settings from the environment.
pub(crate) fn foreframe(dir: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_foreframe"));
    command.current_dir(dir).env_remove("CANDLE_NUM_THREADS");
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("FOREFRAME_")) {
        command.env_remove(name);
    }
    command
}

pub(crate) fn output(dir: &Path, arguments: &[&str]) -> Output {
    foreframe(dir).args(arguments).output().unwrap()
}

/// Sends a signal, such as `-STOP`, to a process.
pub(crate) fn signal(name: &str, process: u32) {
    let sent = Command::new("kill").args([name, &process.to_string()]).status();
    assert!(sent.unwrap().success());
}

/// Whether a process runs: it exists and is no zombie.
#[cfg(target_os = "linux")]
pub(crate) fn is_alive(process: u32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    !stat.is_empty() && !stat.rsplit_once(") ").is_some_and(|(_, rest)| rest.starts_with('Z'))
}

pub(crate) fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

/// A running program that has printed its first line. Dropping it kills the process.
pub(crate) struct Program {
    child: Child,
    line: String,
    log: PathBuf,
}

impl Program {
    pub(crate) fn start(dir: &Path, arguments: &[&str]) -> Self {
        Self::start_with(dir, arguments, &[])
    }

    /// The same with variables of its environment.
    pub(crate) fn start_with(dir: &Path, arguments: &[&str], environment: &[(&str, &str)]) -> Self {
        let log = dir.join(format!("{}.log", arguments[0]));
        let mut child = foreframe(dir)
            .args(arguments)
            .envs(environment.iter().copied())
            .env("RUST_LOG", "foreframe=debug")
            .stdout(Stdio::piped())
            .stderr(File::create(&log).unwrap())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.as_mut().unwrap())
            .read_line(&mut line)
            .unwrap();
        Self { child, line, log }
    }

    /// The first line that it printed.
    pub(crate) fn first_line(&self) -> &str {
        &self.line
    }

    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    pub(crate) fn terminate(&self) {
        signal("-TERM", self.id());
    }

    /// Waits for a successful exit and returns the log.
    pub(crate) fn wait_for_exit(mut self) -> String {
        let deadline = Instant::now() + TIMEOUT;
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            assert!(Instant::now() < deadline, "the program did not end");
            std::thread::sleep(Duration::from_millis(5));
        };
        let log = std::fs::read_to_string(&self.log).unwrap();
        assert!(status.success(), "{status}: {log}");
        log
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // In a passing test it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A server process that is ready.
pub(crate) struct RunningServer {
    pub(crate) program: Program,
    pub(crate) address: SocketAddr,
    /// Sent with each request.
    key: Option<String>,
}

impl RunningServer {
    pub(crate) fn start(dir: &Path, arguments: &[&str]) -> Self {
        Self::start_with(dir, arguments, &[])
    }

    /// The same with variables of its environment.
    pub(crate) fn start_with(dir: &Path, arguments: &[&str], environment: &[(&str, &str)]) -> Self {
        let arguments = [&["serve", "--bind", "127.0.0.1:0"], arguments].concat();
        Self::of(Program::start_with(dir, &arguments, environment))
    }

    pub(crate) fn with_key(self, key: &str) -> Self {
        let key = Some(key.to_owned());
        Self { key, ..self }
    }

    /// Waits until a program that serves is ready.
    pub(crate) fn of(program: Program) -> Self {
        let line = &program.line;
        let address = line.split("http://").nth(1).and_then(|rest| rest.split('/').next());
        let server = Self {
            address: address
                .unwrap_or_else(|| panic!("{line}{}", std::fs::read_to_string(&program.log).unwrap()))
                .parse()
                .unwrap(),
            program,
            key: None,
        };
        let deadline = Instant::now() + TIMEOUT;
        while !server.get("/readyz").starts_with("HTTP/1.1 200") {
            assert!(Instant::now() < deadline, "the server did not become ready");
            std::thread::sleep(Duration::from_millis(10));
        }
        server
    }

    /// The whole response, with its headers.
    pub(crate) fn get(&self, path: &str) -> String {
        self.send("GET", path, "")
    }

    /// The JSON body of the response.
    pub(crate) fn ask(&self, method: &str, path: &str, body: &Value) -> Value {
        let answer = self.send(method, path, &body.to_string());
        let body = answer.split_once("\r\n\r\n").map(|(_, body)| body).unwrap();
        serde_json::from_str(body).unwrap_or_else(|_| panic!("{answer}"))
    }

    pub(crate) fn send(&self, method: &str, path: &str, body: &str) -> String {
        let mut stream = TcpStream::connect(self.address).unwrap();
        let head = "host: a\r\nconnection: close\r\ncontent-type: application/json";
        let length = body.len();
        let key = self.key.as_ref();
        let key = key.map_or_else(String::new, |key| format!("authorization: Bearer {key}\r\n"));
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\n{head}\r\n{key}content-length: {length}\r\n\r\n{body}"
        )
        .unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        // Pictures are not text.
        String::from_utf8_lossy(&answer).into_owned()
    }

    /// Polls a job until the condition holds. Panics if the job fails.
    pub(crate) fn wait_for_job(&self, id: &str, is_reached: impl Fn(&Value) -> bool) -> Value {
        let deadline = Instant::now() + TIMEOUT;
        loop {
            let job = self.ask("GET", &format!("/v1/jobs/{id}"), &Value::Null);
            if is_reached(&job) {
                return job;
            }
            assert!(job["state"] != "failed" && Instant::now() < deadline, "{job}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    pub(crate) fn terminate(&self) {
        self.program.terminate();
    }

    /// Waits for a successful exit and returns the log.
    pub(crate) fn wait_for_exit(self) -> String {
        self.program.wait_for_exit()
    }
}
