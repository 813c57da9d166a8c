//! Every metric of the real program, checked after the events that it counts.

use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

use foreframe::server::protocol::{ClientMessage, Codec, ConfigureMessage, OnLate, ServerMessage};
use foreframe::server::{ImageBytes, ImageFormat};
use foreframe_core::metric_names;
use foreframe_core::nn::{Conditioning, ModelSpec};
use serde_json::{Value, json};

use crate::client::{Client, SessionHandle, numbered_frame, numbered_message};
use crate::process::RunningServer;
use crate::service::{TIMEOUT, context, model, slow_spec, spec};

const SIDE: u32 = 256;
const CONNECTIONS: usize = 24;

/// The scraped value of a series.
fn metric(server: &RunningServer, series: &str) -> Option<f64> {
    let text = server.get("/metrics");
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix(series)?.strip_prefix(' '));
    line.map(|value| value.parse().unwrap())
}

/// Waits for a value: some events are counted only after they are answered, so that no client waits for the metrics.
#[track_caller]
pub(crate) fn wait_for_metric(server: &RunningServer, series: &str, value: f64) {
    let deadline = Instant::now() + TIMEOUT;
    while metric(server, series) != Some(value) {
        let found = metric(server, series);
        assert!(Instant::now() < deadline, "{series} is {found:?}, not {value}");
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
}

#[track_caller]
fn assert_metric(server: &RunningServer, series: &str, value: f64) {
    assert_eq!(metric(server, series), Some(value), "{series}");
}

fn models(dir: &Path) {
    model(dir, "plain", spec(Conditioning::None));
    model(dir, "slow", slow_spec());
    model(dir, "steered", spec(Conditioning::Action));
    // A model whose answers soon fill a socket.
    let large = ModelSpec {
        frame_width_px: SIDE,
        frame_height_px: SIDE,
        context: 1,
        horizon: 8,
        ..spec(Conditioning::None)
    };
    model(dir, "large", large);
    model(dir, "broken", spec(Conditioning::None));
    std::fs::write(dir.join("broken/model.safetensors"), "no weights").unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_metric_is_measured() {
    let dir = tempfile::tempdir().unwrap();
    models(&dir.path().join("models"));
    let limits = [
        "session_grace_ms=1000".to_owned(),
        "max_stream_buffer_bytes=1048576".to_owned(),
        "max_queued_predictions=1".to_owned(),
        format!("max_connections={CONNECTIONS}"),
        "connection_evict_ms=60000".to_owned(),
    ];
    let settings: Vec<&str> = limits.iter().flat_map(|limit| ["--set", limit]).collect();
    let server = RunningServer::start(dir.path(), &settings);
    assert_metric(&server, "foreframe_models_loaded", 4.0);
    assert_metric(&server, "foreframe_model_loads_total{outcome=\"ok\"}", 4.0);
    assert_metric(&server, "foreframe_model_loads_total{outcome=\"refused\"}", 1.0);
    for name in [
        metric_names::SESSIONS_EVICTED,
        metric_names::STREAM_DROPPED,
        metric_names::AUTH_REFUSED,
        metric_names::HTTP_CONNECTIONS_REFUSED,
        metric_names::HTTP_CONNECTIONS_EVICTED,
    ] {
        assert_metric(&server, name, 0.0);
    }
    sessions(&server).await;
    late_frames(&server).await;
    a_slow_reader(&server).await;
    a_full_queue(&server);
    a_plan(&server);
    jobs(&server);
    connections(&server);
    let text = server.get("/metrics");
    for name in metric_names::ALL {
        assert!(text.contains(&format!("# HELP {name} ")), "{name} is not in\n{text}");
    }
    server.terminate();
    server.wait_for_exit();
}

fn a_plan(server: &RunningServer) {
    let limit = json!({"low": -1.0, "high": 1.0});
    let search = json!({"limits": [limit, limit], "budget_ms": 5000});
    let body = json!({"frames": context(), "goal": {"heading_rad": 0.2}, "search": search});
    server.ask("POST", "/v1/models/steered/plan", &body);
    assert_metric(server, "foreframe_plans_total{model=\"steered\",outcome=\"safe\"}", 1.0);
    assert_metric(server, "foreframe_plan_seconds_count{model=\"steered\"}", 1.0);
}

async fn sessions(server: &RunningServer) {
    let mut clients = Vec::new();
    for _ in 0..2 {
        let opened = SessionHandle::of(&server.ask("POST", "/v1/sessions", &json!({"model": "plain"})));
        let path = opened.path("/stream");
        clients.push(Client::connect(server.address, &path, Codec::Msgpack).await.unwrap());
    }
    for seq in 0..3 {
        clients[0].ask(&numbered_message(seq)).await;
    }
    // A refused frame counts as well.
    let refused = clients[1].ask(&numbered_message(9)).await;
    assert!(matches!(refused, ServerMessage::Error { .. }), "{refused:?}");
    wait_for_metric(server, "foreframe_sessions_active", 2.0);
    wait_for_metric(server, "foreframe_streams_active", 2.0);
    wait_for_metric(server, "foreframe_stream_frames_total{model=\"plain\"}", 4.0);
    assert_metric(server, "foreframe_sessions_evicted_total", 0.0);
    drop(clients);
    wait_for_metric(server, "foreframe_sessions_evicted_total", 2.0);
    wait_for_metric(server, "foreframe_sessions_active", 0.0);
    wait_for_metric(server, "foreframe_streams_active", 0.0);
}

async fn late_frames(server: &RunningServer) {
    let path = "/v1/models/plain/stream";
    let mut client = Client::connect(server.address, path, Codec::Msgpack).await.unwrap();
    let configure = ConfigureMessage {
        on_late: Some(OnLate::Skip),
        ..ConfigureMessage::default()
    };
    client.ask(&ClientMessage::Configure(configure)).await;
    let sent = 100;
    for seq in 0..sent {
        client.send(&numbered_message(seq)).await;
    }
    let mut overtaken = 0;
    for _ in 0..sent {
        overtaken += u32::from(matches!(client.receive().await, ServerMessage::Overtaken { .. }));
    }
    assert!(overtaken > 0);
    let name = "foreframe_stream_frames_overtaken_total{model=\"plain\"}";
    wait_for_metric(server, name, f64::from(overtaken));
}

async fn a_slow_reader(server: &RunningServer) {
    let path = "/v1/models/large/stream";
    let mut client = Client::connect(server.address, path, Codec::Msgpack).await.unwrap();
    let frame = ClientMessage::Frame(foreframe::server::protocol::FrameMessage {
        steps: None,
        image: ImageBytes(vec![7; (SIDE * SIDE) as usize]),
        format: ImageFormat::Raw,
        action: None,
        state: None,
        ..numbered_frame(0)
    });
    client.ask(&frame).await;
    let sent = 100;
    for _ in 0..sent {
        // The server sends the cached answer for each.
        client.send(&frame).await;
    }
    let (mut dropped_total, mut read) = (0, 0);
    while dropped_total + read < sent {
        if let ServerMessage::Prediction { dropped, .. } = client.receive().await {
            dropped_total += dropped;
            read += 1;
        }
    }
    assert!(dropped_total > 0);
    wait_for_metric(
        server,
        "foreframe_stream_predictions_dropped_total",
        dropped_total as f64,
    );
    wait_for_metric(
        server,
        "foreframe_stream_frames_total{model=\"large\"}",
        1.0 + sent as f64,
    );
}

/// Sends concurrent requests until one finds the queue full.
fn a_full_queue(server: &RunningServer) {
    let body = json!({"frames": context()});
    let (mut computed, mut refused) = (0, 0);
    let deadline = Instant::now() + TIMEOUT;
    while refused == 0 {
        assert!(Instant::now() < deadline);
        std::thread::scope(|scope| {
            let ask = || server.ask("POST", "/v1/models/slow/predict", &body)["status"] == 503;
            let asked: Vec<_> = (0..8).map(|_| scope.spawn(ask)).collect();
            for is_refused in asked.into_iter().map(|asked| asked.join().unwrap()) {
                *(if is_refused { &mut refused } else { &mut computed }) += 1;
            }
        });
    }
    wait_for_metric(
        server,
        "foreframe_predictions_refused_total{reason=\"full\"}",
        f64::from(refused),
    );
    for name in [
        "foreframe_prediction_batch_size_sum",
        "foreframe_prediction_queue_wait_seconds_count",
    ] {
        wait_for_metric(server, &format!("{name}{{model=\"slow\"}}"), f64::from(computed));
    }
    let seconds = metric(server, "foreframe_prediction_compute_seconds_sum{model=\"slow\"}");
    assert!(seconds.is_some_and(|seconds| seconds > 0.0), "{seconds:?}");
    wait_for_metric(server, "foreframe_predictions_waiting", 0.0);
    let route = "method=\"POST\",route=\"/v1/models/{model}/predict\"";
    for (status, count) in [(200, computed), (503, refused)] {
        let series = format!("foreframe_http_requests_total{{{route},status=\"{status}\"}}");
        wait_for_metric(server, &series, f64::from(count));
    }
}

fn jobs(server: &RunningServer) {
    let collect = |name: &str, trials: u64| json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": trials});
    let post = |body: &Value| server.ask("POST", "/v1/jobs", body);
    post(&collect("seen", 40));
    server.wait_for_job("job-1", |job| job["state"] == "succeeded");
    let settings = json!({
        "model": {"features": 8, "hidden": 8},
        "data": {"windows": 8, "validation_windows": 4},
        "pretrain": {"steps": 2, "batch_size": 4},
        "sequence": {"steps": 2, "batch_size": 4},
        "run": {"validate_every_steps": 2, "checkpoint_every_steps": 2},
    });
    post(&json!({"kind": "train", "name": "new", "preset": "paper", "dataset": "seen", "settings": settings}));
    let trained = server.wait_for_job("job-2", |job| job["state"] == "succeeded");
    for split in ["train", "validation"] {
        let series = format!("foreframe_training_loss{{split=\"{split}\"}}");
        wait_for_metric(server, &series, trained["losses"][split].as_f64().unwrap());
    }
    post(&collect("long", 100_000));
    server.wait_for_job("job-3", |job| job["state"] == "running");
    wait_for_metric(server, "foreframe_jobs{kind=\"collect\",state=\"running\"}", 1.0);
    post_cancel(server, "job-3");
    for (kind, state, count) in [
        ("collect", "succeeded", 1.0),
        ("train", "succeeded", 1.0),
        ("collect", "cancelled", 1.0),
    ] {
        wait_for_metric(
            server,
            &format!("foreframe_jobs{{kind=\"{kind}\",state=\"{state}\"}}"),
            count,
        );
        wait_for_metric(
            server,
            &format!("foreframe_jobs_ended_total{{kind=\"{kind}\",outcome=\"{state}\"}}"),
            count,
        );
    }
    wait_for_metric(server, "foreframe_jobs{kind=\"collect\",state=\"running\"}", 0.0);
    wait_for_metric(server, "foreframe_models_loaded", 5.0);
    wait_for_metric(server, "foreframe_model_loads_total{outcome=\"ok\"}", 5.0);
}

fn post_cancel(server: &RunningServer, id: &str) {
    server.ask("POST", &format!("/v1/jobs/{id}/cancel"), &Value::Null);
    server.wait_for_job(id, |job| job["state"] == "cancelled");
}

fn connections(server: &RunningServer) {
    // The connection that asks for the metrics.
    wait_for_metric(server, "foreframe_http_connections_open", 1.0);
    let held: Vec<TcpStream> = (0..CONNECTIONS + 4)
        .map(|_| TcpStream::connect(server.address).unwrap())
        .collect();
    // Which ones are refused depends on when the connection above ends.
    let is_refused = |connection: &&TcpStream| {
        let mut beginning = [0; 12];
        connection.set_nonblocking(true).unwrap();
        connection.peek(&mut beginning).is_ok() && &beginning == b"HTTP/1.1 503"
    };
    let deadline = Instant::now() + TIMEOUT;
    while held.iter().filter(is_refused).count() < 4 {
        assert!(Instant::now() < deadline);
        std::thread::sleep(Duration::from_millis(10));
    }
    drop(held);
    let refused = loop {
        if let Some(refused) = metric(server, "foreframe_http_connections_refused_total") {
            break refused;
        }
        assert!(Instant::now() < deadline);
    };
    assert!(refused >= 4.0, "{refused}");
}
