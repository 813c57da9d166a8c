//! The documents' shell commands, run in a directory with the shipped models and examples, beside a running server.
//! A command without a rule here fails the test, so that no document shows a command that nothing tries.
#![cfg(unix)]

use std::os::unix::fs::{PermissionsExt as _, symlink};
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use foreframe_core::nn::precision::Precision;
use serde_json::Value;

use crate::process::{Program, RunningServer, foreframe, text};
use crate::service::TIMEOUT;

/// The documents whose commands are run, in the order in which a reader would read them.
const DOCUMENTS: [&str; 4] = ["README.md", "docs/http.md", "docs/training.md", "docs/operations.md"];

/// How commands that are not run begin, and why they are not.
const NOT_RUN: [(&str, &str); 10] = [
    (
        "cargo run",
        "it compiles; the server that it starts is started here without cargo",
    ),
    ("cargo build", "it compiles; the tests are built by it already"),
    ("cargo test", "it would start the tests again"),
    ("cargo bench", "it measures for minutes; .ci/run runs the short forms"),
    ("taskset", "it measures for minutes; .ci/run runs the short forms"),
    ("pip install", "it needs the network; .ci/run runs it"),
    ("python", "it needs a Python package; .ci/run runs it"),
    (
        "docker",
        "it needs a container runtime; .ci/run builds and starts the image",
    ),
    ("tensorboard", "it needs a Python package; .ci/run reads the files"),
    ("git clone", "it needs the network"),
];

/// Text that is replaced before a command is run: what takes long, and what a reader fills in.
const REPLACED: [(&str, &str); 11] = [
    ("--trials 5000", "--trials 60"),
    (
        "foreframe train ",
        "foreframe train --set data.windows=16 --set data.validation_windows=4 --set pretrain.steps=2 --set sequence.steps=2 ",
    ),
    (
        "foreframe evaluate ",
        "foreframe evaluate --windows 20 --resamples 100 ",
    ),
    ("\"steps\": 50}", "\"steps\": 5}"),
    ("\"steps\": 200}", "\"steps\": 10}"),
    ("/var/lib/foreframe", "service-data"),
    ("0.0.0.0:8642", "127.0.0.1:0"),
    ("http://127.0.0.1:8642", "http://ADDRESS"),
    ("http://localhost:8642", "http://ADDRESS"),
    ("http://HOST:8642", "http://ADDRESS"),
    // It ends before curl has written everything, which curl reports as an error.
    (" | head -c 300", ""),
];

/// What is done with a command.
#[derive(Debug, PartialEq)]
enum Rule {
    /// Run it in a shell until it ends successfully.
    Run,
    /// Run it so if there is a curl, then wait for the job that it created.
    Send,
    /// Start it, wait until it is ready, and kill it.
    Serve,
    Skip(&'static str),
}

impl Rule {
    fn of(command: &str) -> Result<Self, String> {
        if let Some((_, reason)) = NOT_RUN.iter().find(|(start, _)| command.starts_with(start)) {
            return Ok(Self::Skip(reason));
        }
        let mut words = command.split_whitespace();
        match (words.next(), words.next()) {
            (Some("foreframe"), Some("serve")) => Ok(Self::Serve),
            (Some("foreframe"), _) => Ok(Self::Run),
            (Some("curl"), _) => Ok(Self::Send),
            _ => Err(format!(
                "no rule for the command `{command}`; add one to tests/it/readme.rs, or change the document"
            )),
        }
    }
}

/// The commands of a Markdown text: lines of `sh` blocks, and indented lines that begin with a lower-case letter (other
/// indented lines show output).
pub(crate) fn commands(markdown: &str) -> Vec<String> {
    let (mut commands, mut open) = (Vec::new(), String::new());
    let (mut fence, mut was_blank, mut is_indented) = (None, true, false);
    for line in markdown.lines() {
        if let Some(language) = line.trim_start().strip_prefix("```") {
            fence = fence.is_none().then(|| language.to_owned());
            continue;
        }
        is_indented = line.starts_with("    ") && (was_blank || is_indented);
        was_blank = line.trim().is_empty();
        let is_command = match fence.as_deref() {
            Some(language) => ["sh", "bash", "shell", "console"].contains(&language),
            None => is_indented && (!open.is_empty() || line.trim().starts_with(|c: char| c.is_ascii_lowercase())),
        };
        if !is_command || was_blank {
            continue;
        }
        open += line.trim().trim_start_matches("$ ");
        if let Some(start) = open.strip_suffix('\\') {
            open = format!("{} ", start.trim_end());
        } else if open.matches('\'').count() % 2 == 1 {
            open += "\n";
        } else if !open.starts_with('#') {
            commands.push(std::mem::take(&mut open));
        } else {
            open.clear();
        }
    }
    commands
}

/// A directory as a reader has it, with `foreframe` and a curl that fails on refusals in `bin`.
pub(crate) fn checkout() -> tempfile::TempDir {
    let (dir, project) = (tempfile::tempdir().unwrap(), Path::new(env!("CARGO_MANIFEST_DIR")));
    for name in ["models", "examples"] {
        symlink(project.join(name), dir.path().join(name)).unwrap();
    }
    let bin = dir.path().join("bin");
    std::fs::create_dir(&bin).unwrap();
    for (name, program) in [
        ("foreframe", format!("'{}'", env!("CARGO_BIN_EXE_foreframe"))),
        (
            "curl",
            format!(
                "'{}' --fail-with-body --show-error --max-time 600",
                curl().unwrap_or_default()
            ),
        ),
    ] {
        std::fs::write(bin.join(name), format!("#!/bin/sh\nexec {program} \"$@\"\n")).unwrap();
        std::fs::set_permissions(bin.join(name), std::fs::Permissions::from_mode(0o755)).unwrap();
    }
    dir
}

fn curl() -> Option<String> {
    let paths = std::env::var_os("PATH")?;
    let found = std::env::split_paths(&paths)
        .map(|dir| dir.join("curl"))
        .find(|path| path.is_file());
    found.map(|path| path.display().to_string())
}

/// Runs a command in a shell, with the directory as home, and returns its standard output.
pub(crate) fn run(dir: &Path, command: &str) -> String {
    let path = format!("{}:{}", dir.join("bin").display(), std::env::var("PATH").unwrap());
    // For its directory and environment only.
    let template = foreframe(dir);
    let mut shell = Command::new("sh");
    for (name, _) in template.get_envs() {
        shell.env_remove(name);
    }
    let output = shell
        .args(["-c", command])
        .current_dir(dir)
        .env("PATH", path)
        .env("HOME", dir)
        .output()
        .unwrap();
    let (stdout, stderr) = (String::from_utf8_lossy(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{command}: {stderr} {stdout}");
    stdout.into_owned()
}

/// Waits for the end of the job that an answer describes, and for the model that it trains, as a reader would before the
/// next command.
fn wait_for_created_job(server: &RunningServer, answer: &str) {
    let created: Value = serde_json::from_str(answer).unwrap_or_default();
    let Some(id) = created["id"].as_str().filter(|id| id.starts_with("job-")) else {
        return;
    };
    let job = server.wait_for_job(id, |job| job["state"] == "succeeded");
    if let Some(model) = job["result"]["model"]
        .as_str()
        .filter(|_| job["spec"]["kind"] == "train")
    {
        let deadline = Instant::now() + TIMEOUT;
        while !server.get(&format!("/v1/models/{model}")).starts_with("HTTP/1.1 200") {
            assert!(Instant::now() < deadline, "{model} is not served");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

#[test]
fn every_command_in_the_documents_succeeds() {
    let dir = checkout();
    let server = RunningServer::start(dir.path(), &[]);
    let mut counts = (0, 0);
    for document in DOCUMENTS {
        let document = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(document)).unwrap();
        for written in commands(&document) {
            let replaced = REPLACED
                .iter()
                .fold(written.clone(), |command, (from, to)| command.replace(from, to));
            let command = replaced.replace("ADDRESS", &server.address.to_string());
            eprintln!("{command}");
            match Rule::of(&written).unwrap() {
                Rule::Skip(reason) => eprintln!("  not run: {reason}"),
                Rule::Send if curl().is_none() => eprintln!("  skipped: there is no curl in PATH"),
                Rule::Send => {
                    wait_for_created_job(&server, &run(dir.path(), &command));
                    counts.1 += 1;
                }
                Rule::Run => {
                    run(dir.path(), &command);
                    counts.0 += 1;
                }
                Rule::Serve => {
                    let command = command.split(" #").next().unwrap();
                    if command.contains("precision=int8") && !Precision::Int8.is_supported() {
                        eprintln!("  skipped: this processor has no instructions for int8");
                        continue;
                    }
                    let arguments: Vec<&str> = command.split_whitespace().skip(1).collect();
                    // Dropping it ends it.
                    RunningServer::of(Program::start(dir.path(), &arguments));
                }
            }
        }
    }
    assert!(
        counts.0 > 0 && (counts.1 > 0 || curl().is_none()),
        "too few commands were found: {counts:?}"
    );
}

#[test]
fn a_command_without_a_rule_is_refused() {
    assert!(Rule::of("rm -r runs").is_err());
    assert!(Rule::of("foreframes collect").is_err());
    assert_eq!(Rule::of("foreframe collect --trials 3"), Ok(Rule::Run));
}

#[test]
fn commands_are_found_in_blocks_and_indented_lines() {
    let markdown = "Text:\n\n    foreframe a  # why\n    Output\n\n```sh\ncurl b \\\n  -c 'd\n  e'\n# comment\nfoo\n```\n\n```json\n{}\n```\n";
    assert_eq!(commands(markdown), ["foreframe a  # why", "curl b -c 'd\ne'", "foo"]);
}
