//! Small things that users of the command line expect.

use std::process::Command;
use std::time::Instant;

use serde_json::{Value, json};

use crate::process::{Program, RunningServer, foreframe, output, text};
use crate::service;

#[test]
fn a_closed_output_ends_a_command_quietly() {
    let dir = tempfile::tempdir().unwrap();
    let line = format!("'{}' config | head -1", env!("CARGO_BIN_EXE_foreframe"));
    let piped = Command::new("sh")
        .args(["-c", &line])
        .current_dir(dir.path())
        .output()
        .unwrap();
    assert_eq!(
        (text(&piped.stdout).lines().count(), text(&piped.stderr)),
        (1, String::new())
    );
}

#[test]
fn options_without_a_command_are_those_of_the_server() {
    let dir = tempfile::tempdir().unwrap();
    let server = Program::start(dir.path(), &["--port", "0"]);
    assert!(
        server
            .first_line()
            .starts_with("Foreframe listens on http://127.0.0.1:"),
        "{}",
        server.first_line()
    );
    assert!(text(&output(dir.path(), &["--version"]).stdout).starts_with("foreframe "));
}

#[test]
fn a_list_in_an_empty_directory_makes_no_database() {
    let dir = tempfile::tempdir().unwrap();
    for (arguments, code) in [(["models", "list"], 0), (["keys", "list"], 0), (["jobs", "list"], 2)] {
        assert_eq!(
            output(dir.path(), &arguments).status.code(),
            Some(code),
            "{arguments:?}"
        );
    }
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[test]
fn jobs_are_listed_described_and_cancelled() {
    let dir = tempfile::tempdir().unwrap();
    let server = RunningServer::start(dir.path(), &["--run-jobs", "false"]);
    let job = json!({"kind": "collect", "name": "small", "scenario": "static-observer", "trials": 3});
    assert_eq!(server.ask("POST", "/v1/jobs", &job)["id"], "job-1");
    let jobs = |arguments: &[&str]| {
        let all = [&["jobs"], arguments, &["--data-dir", "data"]].concat();
        let done = output(dir.path(), &all);
        assert!(done.status.success(), "{arguments:?}: {}", text(&done.stderr));
        text(&done.stdout)
    };
    let listed = jobs(&["list"]);
    assert!(
        listed.lines().nth(1).unwrap().starts_with("job-1  collect  queued"),
        "{listed}"
    );
    let listed: Value = serde_json::from_str(&jobs(&["list", "--json"])).unwrap();
    assert_eq!(listed[0]["spec"]["trials"], 3);
    assert!(jobs(&["show", "job-1"]).contains("asked for  {\"kind\":\"collect\",\"name\":\"small\""));
    assert_eq!(jobs(&["log", "job-1"]), "");
    assert_eq!(jobs(&["cancel", "job-1"]), "job-1 is cancelled\n");
    assert_eq!(jobs(&["list", "--state", "queued"]), "there are no such jobs\n");
    let unknown = output(dir.path(), &["jobs", "show", "job-7", "--data-dir", "data"]);
    assert!(
        text(&unknown.stderr).contains("there is no job \"job-7\""),
        "{unknown:?}"
    );
}

#[test]
fn completions_are_printed_for_each_shell() {
    let dir = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish"] {
        let script = text(&output(dir.path(), &["completions", shell]).stdout);
        assert!(
            script.contains("foreframe") && script.contains("save-scores"),
            "{shell}"
        );
    }
}

#[test]
fn train_takes_settings_of_the_program_like_every_command() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("mine.toml"), "data_dir = \"there\"\nseed = 5\n").unwrap();
    for (more, found_in) in [
        (["--set", "data_dir=elsewhere"], "elsewhere/datasets"),
        (["--config", "mine.toml"], "there/datasets"),
    ] {
        let refused = output(dir.path(), &[&["train", "--dataset", "none"][..], &more].concat());
        let error = text(&refused.stderr);
        assert!(
            error.contains(&format!("there is no data set \"none\" in {found_in}")),
            "{error}"
        );
    }
    let printed = output(dir.path(), &["train", "--config", "mine.toml", "--print-config"]);
    assert!(text(&printed.stdout).contains("seed = 5"), "{printed:?}");
}

#[test]
fn a_first_key_is_printed_once() {
    let dir = tempfile::tempdir().unwrap();
    service::model(
        &dir.path().join("models"),
        "plain",
        service::spec(foreframe_core::nn::Conditioning::None),
    );
    let arguments = ["serve", "--bind", "0.0.0.0:0"];
    let refused = foreframe(dir.path()).args(arguments).output().unwrap();
    assert!(text(&refused.stderr).contains("start with --set first_key=true to get a first one"));
    let exposed = || Program::start(dir.path(), &["serve", "--bind", "0.0.0.0:0", "--set", "first_key=true"]);
    let server = exposed();
    let line = server.first_line().to_owned();
    let key = line.strip_prefix("API key, printed this once: ").unwrap();
    let key = key.split_whitespace().next().unwrap();
    let (deadline, mut log) = (Instant::now() + service::TIMEOUT, String::new());
    while !log.contains("model loaded") {
        assert!(Instant::now() < deadline, "{log}");
        log = std::fs::read_to_string(dir.path().join("serve.log")).unwrap();
    }
    assert!(!log.contains(key), "the key is in the log");
    drop(server);
    assert!(exposed().first_line().starts_with("Foreframe listens"));
    assert_eq!(text(&output(dir.path(), &["keys", "list"]).stdout).lines().count(), 1);
}
