//! Limits on what clients can take from each other: memory, connections, and the time of threads.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener as StdListener, TcpStream as StdStream};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use foreframe::server::protocol::{ClosingReason, Codec, ErrorCode, ServerMessage};
use foreframe::server::{self, App, ServerConfig, ServerListeners};
use foreframe_core::types::Seed;
use foreframe_data::dataset::{CollectConfig, collect};
use foreframe_sim::{Scenario, WorldConfig};
use serde_json::json;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::task::{AbortHandle, JoinSet};

use crate::client::Client;
use crate::process::{Program, output, text};
use crate::service::{TIMEOUT, app, context, get, poll_until, post, run};

/// A head that never ends.
const DRIPPING_HEAD: &[u8] = b"GET /livez HTTP/1.1\r\nhost: a\r\nx-slow: ";

/// Sends bytes and reads until the server closes the connection.
async fn exchange(mut client: TcpStream, request: &str) -> String {
    client.write_all(request.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    let read = tokio::time::timeout(TIMEOUT, client.read_to_end(&mut answer)).await;
    // A reset counts as the end as well.
    let _ = read.unwrap();
    String::from_utf8_lossy(&answer).into_owned()
}

async fn ask(address: SocketAddr, path: &str) -> String {
    let request = format!("GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n");
    exchange(TcpStream::connect(address).await.unwrap(), &request).await
}

fn is_refusal(answer: &str) -> bool {
    answer.starts_with("HTTP/1.1 503") && answer.to_ascii_lowercase().contains("retry-after: 1")
}

/// Serves on a public and an admin listener; both end with the test.
async fn serve(app: App) -> (SocketAddr, SocketAddr, AbortHandle) {
    let bind = || TcpListener::bind("127.0.0.1:0");
    let (public, admin) = (bind().await.unwrap(), bind().await.unwrap());
    let addresses = (public.local_addr().unwrap(), admin.local_addr().unwrap());
    let admin = Some(admin);
    let task = tokio::spawn(server::serve(
        ServerListeners { public, admin },
        app,
        std::future::pending(),
    ));
    (addresses.0, addresses.1, task.abort_handle())
}

/// Sends the head of a request and a part of its body.
async fn unfinished(address: SocketAddr, content_type: &str, total: usize, part: &[u8]) -> TcpStream {
    let mut client = TcpStream::connect(address).await.unwrap();
    let head = format!(
        "POST /v1/models/plain/predict HTTP/1.1\r\nhost: localhost\r\ncontent-type: {content_type}\r\n\
         content-length: {total}\r\n\r\n"
    );
    client.write_all(head.as_bytes()).await.unwrap();
    client.write_all(part).await.unwrap();
    client
}

/// Waits until the server answers; gives what it has sent so far.
async fn first_bytes(client: &mut TcpStream) -> String {
    let mut bytes = vec![0; 4096];
    let count = tokio::time::timeout(TIMEOUT, client.read(&mut bytes))
        .await
        .unwrap()
        .unwrap();
    String::from_utf8_lossy(&bytes[..count]).into_owned()
}

#[tokio::test]
async fn unfinished_bodies_beyond_the_budget_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_body_bytes: 64 << 10,
        max_total_body_bytes: 256 << 10,
        ..ServerConfig::default()
    };
    let server = run(app(dir.path(), config)).await;
    let form = "multipart/form-data; boundary=b";
    let start = b"--b\r\ncontent-disposition: form-data; name=\"frames\"\r\n\r\n";
    let mut part = start.to_vec();
    part.resize(60 << 10, b'x');
    let mut held = Vec::new();
    // Four bodies of 60 KiB fit, whatever their kind; a fifth does not.
    for kind in [form, "application/json", form, "application/json"] {
        let mut client = unfinished(server.address, kind, 62 << 10, &part).await;
        let waited = tokio::time::timeout(Duration::from_millis(500), first_bytes(&mut client)).await;
        assert!(waited.is_err(), "{waited:?}");
        held.push(client);
    }
    for kind in [form, "application/json"] {
        let mut client = unfinished(server.address, kind, 62 << 10, &part).await;
        let refusal = first_bytes(&mut client).await;
        assert!(
            is_refusal(&refusal) && refusal.contains("exceed 262144 bytes"),
            "{refusal}"
        );
    }
    drop(held);
    let body = json!({"frames": context()}).to_string();
    let request = format!(
        "POST /v1/models/plain/predict HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\
         content-type: application/json\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    );
    let deadline = Instant::now() + TIMEOUT;
    loop {
        let answer = exchange(TcpStream::connect(server.address).await.unwrap(), &request).await;
        if answer.starts_with("HTTP/1.1 200") {
            break;
        }
        assert!(is_refusal(&answer) && Instant::now() < deadline, "{answer}");
    }
    server.stop().await;
}

/// The bytes of a binary message without its last byte.
fn unfinished_message(length: usize) -> Vec<u8> {
    // Binary and final, masked with zeros, 64-bit length.
    let mut bytes = vec![0x82, 0xff];
    bytes.extend((length as u64).to_be_bytes());
    bytes.extend([0; 4]);
    bytes.resize(bytes.len() + length - 1, b'x');
    bytes
}

#[tokio::test]
async fn unfinished_messages_beyond_the_budget_close_their_streams() {
    const MESSAGE_BYTES: usize = 64 << 10;
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_body_bytes: MESSAGE_BYTES,
        max_total_body_bytes: 4 * MESSAGE_BYTES,
        ..ServerConfig::default()
    };
    let server = run(app(dir.path(), config)).await;
    let connect = async || {
        let stream = Client::connect(server.address, "/v1/models/plain/stream", Codec::Msgpack);
        stream.await.unwrap()
    };
    let hold = async || {
        let mut client = connect().await;
        // The server may close it before it has read all.
        let _ = client
            .socket
            .get_mut()
            .write_all(&unfinished_message(MESSAGE_BYTES))
            .await;
        client
    };
    let small_body = format!("{:20000}", "");
    let request = format!(
        "POST /v1/models/plain/predict HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\
         content-type: application/json\r\ncontent-length: {}\r\n\r\n{small_body}",
        small_body.len()
    );
    // Each counts 48 KiB: five fit, and leave less than 20,000 bytes.
    let mut held = Vec::new();
    for _ in 0..5 {
        held.push(hold().await);
    }
    poll_until(async || {
        let answer = exchange(TcpStream::connect(server.address).await.unwrap(), &request).await;
        is_refusal(&answer).then_some(())
    })
    .await;
    for _ in 0..5 {
        let mut refused = hold().await;
        match refused.receive_or_end().await {
            Ok(ServerMessage::Error { code, detail, .. }) => {
                assert_eq!(code, ErrorCode::Overloaded);
                assert!(detail.contains("exceed 262144 bytes; try again in 1 s"), "{detail}");
            }
            other => panic!("{other:?}"),
        }
        assert_eq!(refused.end().await, (Some(ClosingReason::Overloaded), Some(1013)));
    }
    // The budget is used up, but a stream of small frames continues.
    let mut small = connect().await;
    small.send_text("{}").await;
    assert!(matches!(small.receive().await, ServerMessage::Error { code, .. } if code == ErrorCode::Malformed));
    drop(held);
    // The streams that are gone have given back what they held.
    poll_until(async || {
        let mut client = hold().await;
        let _ = client.socket.get_mut().write_all(b"x").await;
        let answer = client.receive_or_end().await;
        matches!(
            answer,
            Ok(ServerMessage::Error {
                code: ErrorCode::Malformed,
                ..
            })
        )
        .then_some(())
    })
    .await;
    server.stop().await;
}

#[tokio::test]
async fn probes_are_answered_while_idle_sockets_flood_the_public_port() {
    let dir = tempfile::tempdir().unwrap();
    let (public, admin, _server) = serve(app(dir.path(), ServerConfig::default())).await;
    let mut flood = Vec::new();
    for index in 0..600 {
        let mut socket = TcpStream::connect(public).await.unwrap();
        // Half of them say nothing.
        if index % 2 == 0 {
            let _ = socket.write_all(DRIPPING_HEAD).await;
        }
        flood.push(socket);
    }
    for path in ["/livez", "/readyz", "/metrics"] {
        let answer = ask(admin, path).await;
        assert!(answer.starts_with("HTTP/1.1 200"), "{path}: {answer}");
    }
    assert!(ask(admin, "/v1/models").await.starts_with("HTTP/1.1 404"));
}

#[tokio::test]
async fn a_new_connection_replaces_the_idlest_one() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_connections: 8,
        connection_evict_ms: 0,
        ..ServerConfig::default()
    };
    let server = run(app(dir.path(), config)).await;
    let mut stream = Client::connect(server.address, "/v1/models/plain/stream", Codec::Json)
        .await
        .unwrap();
    let mut flood = Vec::new();
    for _ in 0..50 {
        let mut socket = TcpStream::connect(server.address).await.unwrap();
        let _ = socket.write_all(DRIPPING_HEAD).await;
        flood.push(socket);
        assert!(ask(server.address, "/livez").await.starts_with("HTTP/1.1 200"));
    }
    // A stream is not idle.
    stream.send_text("{\"type\": \"ping\", \"timestamp_us\": 1}").await;
    stream.receive().await;
    server.stop().await;
}

#[tokio::test]
async fn an_address_with_all_its_connections_busy_leaves_room_for_others() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_connections_per_address: 3,
        ..ServerConfig::default()
    };
    let server = run(app(dir.path(), config)).await;
    let mut busy = Vec::new();
    for _ in 0..3 {
        busy.push(unfinished(server.address, "application/json", 100, b"{").await);
    }
    let refused = ask(server.address, "/livez").await;
    assert!(
        is_refusal(&refused) && refused.contains("too many connections"),
        "{refused}"
    );
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind("127.0.0.2:0".parse().unwrap()).unwrap();
    let other = socket.connect(server.address).await.unwrap();
    let answer = exchange(other, "GET /livez HTTP/1.1\r\nhost: a\r\nconnection: close\r\n\r\n").await;
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    drop(busy);
    server.stop().await;
}

#[tokio::test]
async fn watchers_of_a_job_leave_the_places_of_streams() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        run_jobs: false,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let job = json!({"kind": "collect", "name": "a", "scenario": "static-observer", "trials": 1});
    assert_eq!(post(&app, "/v1/jobs", &job).await.status, 202);
    let server = run(app).await;
    let mut watchers = Vec::new();
    for _ in 0..128 {
        let mut watcher = TcpStream::connect(server.address).await.unwrap();
        let request = b"GET /v1/jobs/job-1/events HTTP/1.1\r\nhost: a\r\n\r\n";
        watcher.write_all(request).await.unwrap();
        let answer = first_bytes(&mut watcher).await;
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        watchers.push(watcher);
    }
    let refused = ask(server.address, "/v1/jobs/job-1/events").await;
    assert!(
        is_refusal(&refused) && refused.contains("128 event streams are open already"),
        "{refused}"
    );
    Client::connect(server.address, "/v1/models/plain/stream", Codec::Json)
        .await
        .unwrap();
    drop(watchers);
    server.stop().await;
}

#[tokio::test]
async fn requests_beyond_their_limit_leave_the_places_of_streams() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_requests: 2,
        ..ServerConfig::default()
    };
    let server = run(app(dir.path(), config)).await;
    let mut held = Vec::new();
    for _ in 0..2 {
        held.push(unfinished(server.address, "application/json", 100, b"{").await);
    }
    // Until both are being processed.
    let deadline = Instant::now() + TIMEOUT;
    let refused = loop {
        let answer = ask(server.address, "/v1/models").await;
        if is_refusal(&answer) {
            break answer;
        }
        assert!(Instant::now() < deadline, "{answer}");
    };
    assert!(refused.contains("2 requests are being processed already"), "{refused}");
    assert!(ask(server.address, "/livez").await.starts_with("HTTP/1.1 200"));
    Client::connect(server.address, "/v1/models/plain/stream", Codec::Json)
        .await
        .unwrap();
    drop(held);
    server.stop().await;
}

/// A data set "seen" with this number of episodes.
fn with_dataset(dir: &Path, episodes: u64) {
    let config = CollectConfig {
        world: WorldConfig {
            frame_width_px: 16,
            frame_height_px: 12,
            ..WorldConfig::default()
        },
        ..CollectConfig::new(Scenario::StaticObserver, episodes, Seed(1), &dir.join("datasets/seen"))
    };
    collect(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
}

fn animation(episode: u64) -> String {
    format!("/v1/datasets/seen/episodes/{episode}/preview.gif")
}

#[tokio::test]
async fn a_prediction_does_not_wait_for_pictures() {
    const PICTURES: u64 = 12;
    let dir = tempfile::tempdir().unwrap();
    with_dataset(dir.path(), PICTURES);
    let config = ServerConfig {
        request_threads: 1,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let mut pictures = JoinSet::new();
    for episode in 0..PICTURES {
        let app = app.clone();
        pictures.spawn(async move { get(&app, &animation(episode)).await });
    }
    // From here on, the others wait for a thread.
    assert_eq!(pictures.join_next().await.unwrap().unwrap().status, 200);
    let predicted = post(&app, "/v1/models/plain/predict", &json!({"frames": context()})).await;
    assert_eq!(predicted.status, 200);
    let mut answered = 0;
    while pictures.try_join_next().is_some() {
        answered += 1;
    }
    assert!(
        answered < PICTURES / 2,
        "{answered} pictures were made before the prediction"
    );
}

#[tokio::test]
async fn a_picture_is_kept_for_the_next_request() {
    for (max_cached_bytes, later) in [(64 << 20, 200), (0, 500)] {
        let dir = tempfile::tempdir().unwrap();
        with_dataset(dir.path(), 1);
        let config = ServerConfig {
            max_cached_bytes,
            ..ServerConfig::default()
        };
        let app = app(dir.path(), config);
        let first = get(&app, &animation(0)).await;
        assert_eq!((first.status.as_u16(), &first.body[..6]), (200, &b"GIF89a"[..]));
        // Without its frames, the picture cannot be made again.
        std::fs::remove_dir_all(dir.path().join("datasets/seen/data")).unwrap();
        let second = get(&app, &animation(0)).await;
        assert_eq!(second.status, later);
        assert!(later != 200 || second.body == first.body);
    }
}

#[test]
fn a_worker_answers_probes_at_admin_bind() {
    let dir = tempfile::tempdir().unwrap();
    let free = StdListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let setting = format!("admin_bind={free}");
    let worker = Program::start(dir.path(), &["worker", "--set", &setting]);
    for path in ["/livez", "/readyz", "/metrics"] {
        let mut client = StdStream::connect(free).unwrap();
        let request = format!("GET {path} HTTP/1.1\r\nhost: a\r\nconnection: close\r\n\r\n");
        client.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        client.read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 200"), "{path}: {answer}");
        assert!(path != "/metrics" || answer.contains("foreframe_jobs"), "{answer}");
    }
    worker.terminate();
    worker.wait_for_exit();
}

#[test]
fn a_used_admin_address_ends_the_program_only_if_it_was_set() {
    let dir = tempfile::tempdir().unwrap();
    let used = StdListener::bind("127.0.0.1:0").unwrap();
    let setting = format!("admin_bind={}", used.local_addr().unwrap());
    let refused = output(dir.path(), &["serve", "--port", "0", "--set", &setting]);
    assert_eq!(refused.status.code(), Some(1));
    let reason = text(&refused.stderr);
    assert!(
        reason.contains("set admin_bind to another address or to off"),
        "{reason}"
    );
    // Another program may have it already.
    let _default = StdListener::bind("127.0.0.1:8643");
    let server = Program::start(dir.path(), &["serve", "--port", "0"]);
    assert!(server.first_line().contains("listens on"));
}
