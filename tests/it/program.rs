//! The real program: shutdown, metrics, health checks, keys and configuration.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use foreframe_core::nn::Conditioning;
use serde_json::{Value, json};

use crate::process::{Program, RunningServer, foreframe, output, text};
use crate::service::{TIMEOUT, context, model, slow_spec, spec};

/// Sends requests until connections are refused. A request counts as accepted once the server asks for its body.
fn send_until_refused(address: SocketAddr, body: &str, accepted: &AtomicUsize, answered: &AtomicUsize) {
    let head = format!(
        "POST /v1/models/slow/predict HTTP/1.1\r\nhost: a\r\ncontent-type: application/json\r\nexpect: 100-continue\r\n\
         content-length: {}\r\n\r\n",
        body.len()
    );
    while let Ok(mut stream) = TcpStream::connect(address) {
        loop {
            let mut interim = [0; 25];
            if stream.write_all(head.as_bytes()).is_err() || stream.read_exact(&mut interim).is_err() {
                break;
            }
            assert_eq!(&interim, b"HTTP/1.1 100 Continue\r\n\r\n");
            accepted.fetch_add(1, Ordering::Relaxed);
            stream.write_all(body.as_bytes()).unwrap();
            if !read_whole_answer(&mut stream) {
                break;
            }
            answered.fetch_add(1, Ordering::Relaxed);
        }
    }
}

fn read_whole_answer(stream: &mut TcpStream) -> bool {
    let mut reader = BufReader::new(stream);
    let (mut line, mut length, mut is_status) = (String::new(), 0, true);
    while line != "\r\n" {
        line.clear();
        if reader.read_line(&mut line).unwrap_or(0) == 0 {
            return false;
        }
        assert!(!is_status || line.contains(" 200 ") || line.contains(" 503 "), "{line}");
        is_status = false;
        if let Some(bytes) = line.strip_prefix("content-length: ") {
            length = bytes.trim().parse().unwrap();
        }
    }
    reader.read_exact(&mut vec![0; length]).is_ok()
}

#[test]
fn sigterm_under_load_answers_every_accepted_request() {
    let dir = tempfile::tempdir().unwrap();
    model(&dir.path().join("models"), "slow", slow_spec());
    let server = RunningServer::start(
        dir.path(),
        &["--set", "drain_ms=300", "--set", "shutdown_deadline_ms=20000"],
    );
    let body = json!({"frames": context()}).to_string();
    let (accepted, answered) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let address = server.address;
    let stopped_at = std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| send_until_refused(address, &body, &accepted, &answered));
        }
        while answered.load(Ordering::Relaxed) < 40 {
            std::thread::sleep(Duration::from_millis(1));
        }
        server.terminate();
        Instant::now()
    });
    let log = server.wait_for_exit();
    assert!(stopped_at.elapsed() < Duration::from_secs(20), "{log}");
    assert_eq!(
        accepted.load(Ordering::Relaxed),
        answered.load(Ordering::Relaxed),
        "{log}"
    );
    assert!(log.contains("stopped") && !log.contains("deadline"), "{log}");
}

#[test]
fn requests_are_counted_by_route_and_logged_with_ids() {
    let dir = tempfile::tempdir().unwrap();
    model(&dir.path().join("models"), "plain", spec(Conditioning::None));
    let server = RunningServer::start(dir.path(), &["--log-format", "json"]);
    for name in ["plain", "a", "b"] {
        server.get(&format!("/v1/models/{name}"));
    }
    server.get("/nothing HTTP/1.1\r\nx-request-id: robot-7\r\nx:");
    let body = json!({"frames": context()}).to_string();
    let mut stream = TcpStream::connect(server.address).unwrap();
    write!(
        stream,
        "POST /v1/models/plain/predict HTTP/1.1\r\nhost: a\r\nconnection: close\r\ncontent-type: application/json\r\n\
         content-length: {}\r\n\r\n{body}",
        body.len()
    )
    .unwrap();
    stream.read_to_end(&mut Vec::new()).unwrap();
    // A batch is recorded after its answers; this is its last metric.
    let recorded = "foreframe_prediction_queue_wait_seconds_count{model=\"plain\"} 1";
    let deadline = Instant::now() + TIMEOUT;
    let mut metrics = server.get("/metrics");
    while !metrics.contains(recorded) && Instant::now() < deadline {
        metrics = server.get("/metrics");
    }
    for line in [
        "foreframe_http_requests_total{method=\"GET\",route=\"/v1/models/{model}\",status=\"200\"} 1",
        "foreframe_http_requests_total{method=\"GET\",route=\"/v1/models/{model}\",status=\"404\"} 2",
        "foreframe_http_requests_total{method=\"GET\",route=\"none\",status=\"404\"} 1",
        "foreframe_http_request_duration_seconds_count{route=\"/v1/models/{model}/predict\"} 1",
        "foreframe_prediction_batch_size_sum{model=\"plain\"} 1",
        "foreframe_prediction_queue_wait_seconds_count{model=\"plain\"} 1",
        "foreframe_prediction_compute_seconds_count{model=\"plain\"} 1",
        "foreframe_jobs{kind=\"train\",state=\"running\"} 0",
        "foreframe_streams_active 0",
        "foreframe_models_loaded 1",
        "# TYPE process_resident_memory_bytes gauge",
    ] {
        assert!(
            metrics.lines().any(|found| found == line),
            "{line} is not in\n{metrics}"
        );
    }
    assert!(
        !metrics.contains("/v1/models/a") && !metrics.contains("/nothing"),
        "{metrics}"
    );
    server.terminate();
    let log = server.wait_for_exit();
    let entries = log
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap_or_else(|_| panic!("{line}")));
    let answered: Vec<Value> = entries.filter(|entry| entry["message"] == "answered").collect();
    assert!(
        answered.len() >= 6 && answered.iter().all(|entry| entry["span"]["id"].is_string()),
        "{log}"
    );
    assert!(
        answered
            .iter()
            .any(|entry| entry["span"]["id"] == "robot-7" && entry["status"] == 404),
        "{log}"
    );
}

#[test]
fn the_healthcheck_exit_code_reports_readiness() {
    let dir = tempfile::tempdir().unwrap();
    let server = RunningServer::start(dir.path(), &[]);
    let bind = server.address.to_string();
    let ready = output(dir.path(), &["healthcheck", "--bind", &bind]);
    assert!(ready.status.success(), "{}", text(&ready.stderr));
    let elsewhere = format!("http://{bind}/nothing");
    let lost = output(dir.path(), &["healthcheck", "--url", &elsewhere]);
    assert_eq!(
        (lost.status.code(), text(&lost.stderr).contains("404")),
        (Some(1), true)
    );
    server.terminate();
    server.wait_for_exit();
    assert_eq!(
        output(dir.path(), &["healthcheck", "--bind", &bind]).status.code(),
        Some(1)
    );
}

#[test]
fn a_public_server_requires_an_api_key() {
    let dir = tempfile::tempdir().unwrap();
    let refused = output(dir.path(), &["serve", "--bind", "0.0.0.0:0"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        text(&refused.stderr).contains("foreframe keys create NAME"),
        "{}",
        text(&refused.stderr)
    );
    let keys = ["robot 7", "robot 8"]
        .map(|name| text(&output(dir.path(), &["keys", "create", name, "--data-dir", "data"]).stdout));
    let listed = text(&output(dir.path(), &["keys", "list"]).stdout);
    assert!(
        listed.contains("valid") && listed.contains("robot 7") && !listed.contains(keys[0].trim()),
        "{listed}"
    );
    let server = RunningServer::start(dir.path(), &["--set", "key_refresh_ms=100"]);
    assert!(server.get("/v1/models").starts_with("HTTP/1.1 401"));
    assert!(server.get("/metrics").contains("\nforeframe_auth_refused_total 1\n"));
    let ask = |key: &str| {
        server.get(&format!(
            "/v1/models HTTP/1.1\r\nauthorization: Bearer {}\r\nx:",
            key.trim()
        ))
    };
    assert!(keys.iter().all(|key| ask(key).starts_with("HTTP/1.1 200")));
    let id = keys[0].split('_').nth(1).unwrap();
    assert!(output(dir.path(), &["keys", "revoke", id]).status.success());
    assert_eq!(output(dir.path(), &["keys", "revoke", id]).status.code(), Some(2));
    let deadline = Instant::now() + TIMEOUT;
    while !ask(&keys[0]).starts_with("HTTP/1.1 401") {
        assert!(Instant::now() < deadline, "the revoked key is still accepted");
    }
    assert!(ask(&keys[1]).starts_with("HTTP/1.1 200"));
    server.terminate();
    server.wait_for_exit();
}

#[test]
fn a_key_is_revoked_by_its_id_or_by_a_name_that_only_it_has() {
    let dir = tempfile::tempdir().unwrap();
    let keys = |arguments: &[&str]| output(dir.path(), &[&["keys"], arguments].concat());
    let ids = ["ada", "bob", "bob"].map(|name| {
        let key = text(&keys(&["create", name]).stdout);
        key.split('_').nth(1).unwrap().to_owned()
    });
    assert!(text(&keys(&["revoke", "ada"]).stdout).starts_with(&format!("{} is revoked", ids[0])));
    assert!(text(&keys(&["revoke", "ada"]).stderr).contains("there is no valid key ada"));
    let unclear = text(&keys(&["revoke", "bob"]).stderr);
    assert!(
        unclear.contains("2 valid keys have the name bob") && ids[1..].iter().all(|id| unclear.contains(id)),
        "{unclear}"
    );
    assert!(keys(&["revoke", &ids[1]]).status.success());
    assert!(text(&keys(&["revoke", "bob"]).stdout).contains("it was the last valid key"));
}

#[test]
fn invalid_directories_are_refused_at_startup() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("file"), "").unwrap();
    let none = "; name a directory that holds models, or leave the setting out to serve those in ./models";
    for (arguments, complaint) in [
        (
            ["serve", "--models-dir", "modles"],
            format!("models_dir is \"modles\" (--models-dir), which does not exist{none}"),
        ),
        (
            ["worker", "--set", "models_dir=file"],
            format!("models_dir is \"file\" (--set), which is a file{none}"),
        ),
        (
            ["serve", "--data-dir", "file"],
            "data_dir is \"file\" (--data-dir), which is a file; name a directory; it is created if it does not exist"
                .to_owned(),
        ),
    ] {
        let refused = output(dir.path(), &arguments);
        assert_eq!(
            (refused.status.code(), text(&refused.stderr).trim()),
            (Some(2), format!("error: {complaint}").as_str())
        );
    }
    // Without models the server starts, and the log says what to do.
    std::fs::create_dir(dir.path().join("empty")).unwrap();
    let server = RunningServer::start(dir.path(), &["--models-dir", "empty"]);
    assert!(server.get("/v1/models").contains("{\"models\":[]"));
    server.terminate();
    assert!(
        server
            .wait_for_exit()
            .contains("publish a trained model with `foreframe publish DIR`")
    );
}

#[test]
fn the_configuration_is_printed_with_its_sources() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("foreframe.toml"), "max_streams = 7\nmax_batch = 8\n").unwrap();
    let config = |more: &[&str]| {
        let mut command = foreframe(dir.path());
        command.args(["config", "--data-dir", "here"]).args(more);
        text(&command.env("FOREFRAME_MAX_BATCH", "9").output().unwrap().stdout)
    };
    let listed: Value = serde_json::from_str(&config(&["--json"])).unwrap();
    assert_eq!(listed["max_streams"], json!({"value": 7, "origin": "foreframe.toml"}));
    let printed = config(&[]);
    for line in [
        "# Maximum number of streams; more are refused with 503.",
        "max_streams = 7  # foreframe.toml; 1 to 1000000",
        "max_batch = 9  # environment FOREFRAME_MAX_BATCH; 1 to 512",
        "data_dir = \"here\"  # --data-dir",
    ] {
        assert!(
            printed.lines().any(|found| found == line),
            "{line} is not in\n{printed}"
        );
    }
    std::fs::write(dir.path().join("foreframe.toml"), "max_stream = 7\n").unwrap();
    let refused = output(dir.path(), &["serve"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("unknown field `max_stream` (foreframe.toml); `foreframe config` lists"));
}

#[test]
fn a_server_listens_on_the_port_and_name_that_it_is_given() {
    let dir = tempfile::tempdir().unwrap();
    let server = RunningServer::start(dir.path(), &["--port", "0"]);
    assert!(server.get("/livez").starts_with("HTTP/1.1 200"));
    server.terminate();
    server.wait_for_exit();
    let named = Program::start(dir.path(), &["serve", "--bind", "localhost:0"]);
    assert!(
        named.first_line().contains("http://127.0.0.1:"),
        "{}",
        named.first_line()
    );
    named.terminate();
    named.wait_for_exit();
}

#[test]
fn the_directory_of_a_model_gives_it_its_name() {
    let dir = tempfile::tempdir().unwrap();
    let models = dir.path().join("models");
    model(&models, "plain", spec(Conditioning::None));
    std::fs::rename(models.join("plain"), models.join("other")).unwrap();
    model(&models, "plain", spec(Conditioning::None));
    std::fs::rename(models.join("plain"), models.join("my_model")).unwrap();
    let server = RunningServer::start(dir.path(), &[]);
    assert!(server.get("/v1/models/other").contains("\"name\":\"other\""));
    server.terminate();
    let log = server.wait_for_exit();
    assert!(
        log.contains("my_model") && log.contains("is not a valid model name"),
        "{log}"
    );
}

#[test]
fn a_running_server_serves_what_is_published() {
    let dir = tempfile::tempdir().unwrap();
    model(&dir.path().join("models"), "plain", spec(Conditioning::None));
    let server = RunningServer::start(dir.path(), &[]);
    let run = |arguments: &[&str]| {
        let done = output(dir.path(), arguments);
        assert!(done.status.success(), "{arguments:?}: {}", text(&done.stderr));
        text(&done.stdout)
    };
    let wait_for = |model: &str, version: &str| {
        let deadline = Instant::now() + TIMEOUT;
        while !server.get(&format!("/v1/models/{model}")).contains(version) {
            assert!(Instant::now() < deadline, "{model} is not server as {version}");
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    assert_eq!(
        run(&["publish", "models/plain", "--name", "mine"]),
        "published mine@1; it is the active version\n"
    );
    wait_for("mine", "\"active_version\":1");
    assert_eq!(
        run(&["publish", "models/plain"]),
        "published plain@2; it is the active version\n"
    );
    wait_for("plain", "\"active_version\":2");
    let listed = run(&["models", "list"]);
    assert!(
        listed.contains("mine@1                   active data/models/mine/1\n")
            && listed.contains("plain@1                         models/plain\n")
            && listed.contains("plain@2                  active data/models/plain/2\n"),
        "{listed}"
    );
    let refused = output(dir.path(), &["models", "remove", "plain@2"]);
    assert!(refused.status.code() == Some(2) && text(&refused.stderr).contains("is active"));
    run(&["models", "activate", "plain@1"]);
    wait_for("plain", "\"active_version\":1");
    assert_eq!(run(&["models", "remove", "plain@2"]), "removed plain@2\n");
    assert!(!dir.path().join("data/models/plain/2").exists());
    assert!(run(&["models", "remove", "mine"]).contains("no version of mine is left"));
    let refused = output(dir.path(), &["models", "remove", "plain"]);
    assert!(refused.status.code() == Some(2) && text(&refused.stderr).contains("delete its directory there"));
    server.terminate();
    server.wait_for_exit();
}

#[test]
fn one_request_thread_is_enough_to_check_a_job() {
    let dir = tempfile::tempdir().unwrap();
    let arguments = ["--objects-url", "objects", "--set", "request_threads=1"];
    let server = RunningServer::start(dir.path(), &arguments);
    let job = json!({"kind": "train", "name": "a", "preset": "paper", "dataset": "none"});
    for _ in 0..2 {
        let refused = server.ask("POST", "/v1/jobs", &job);
        assert_eq!(refused["status"], 422, "{refused}");
    }
    server.terminate();
    server.wait_for_exit();
}
