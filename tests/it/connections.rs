//! Connections that are slow, idle, from other origins, or open during shutdown.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use axum::body::Body;
use axum::http::{Request, header};
use foreframe::server::ServerConfig;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::process::RunningServer;
use crate::service::{InProcessServer, TIMEOUT, app, get, run, send};

const ASK: &[u8] = b"GET /livez HTTP/1.1\r\nhost: a\r\n\r\n";

async fn start(config: ServerConfig) -> (tempfile::TempDir, InProcessServer) {
    let dir = tempfile::tempdir().unwrap();
    let server = run(app(dir.path(), config)).await;
    (dir, server)
}

async fn connect(address: SocketAddr) -> TcpStream {
    TcpStream::connect(address).await.unwrap()
}

/// Reads until the server closes the connection.
async fn read_to_end(client: &mut TcpStream) -> String {
    let mut text = Vec::new();
    // A reset counts as the end as well.
    let _ = tokio::time::timeout(TIMEOUT, client.read_to_end(&mut text))
        .await
        .unwrap();
    String::from_utf8_lossy(&text).into_owned()
}

async fn answer(client: &mut TcpStream) -> String {
    let mut text = String::new();
    while !text.contains("\r\n\r\n{") || !text.ends_with('}') {
        let mut byte = [0; 256];
        let count = tokio::time::timeout(TIMEOUT, client.read(&mut byte))
            .await
            .unwrap()
            .unwrap();
        assert!(count > 0, "the connection ended after: {text}");
        text += std::str::from_utf8(&byte[..count]).unwrap();
    }
    text
}

#[tokio::test]
async fn slow_headers_time_out() {
    let (_dir, server) = start(ServerConfig {
        header_read_ms: 100,
        ..ServerConfig::default()
    })
    .await;
    let mut silent = connect(server.address).await;
    let mut slow = connect(server.address).await;
    let send_slowly = async {
        // Single bytes do not extend the time limit.
        for byte in ASK.iter().cycle() {
            if slow.write_all(&[*byte | 0x40]).await.is_err() {
                return;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(TIMEOUT, send_slowly).await.unwrap();
    assert!(!read_to_end(&mut silent).await.contains("200"));
    server.stop().await;
}

#[tokio::test]
async fn an_idle_connection_is_closed() {
    let (_dir, server) = start(ServerConfig {
        header_read_ms: 200,
        ..ServerConfig::default()
    })
    .await;
    let mut client = connect(server.address).await;
    for _ in 0..2 {
        client.write_all(ASK).await.unwrap();
        assert!(answer(&mut client).await.starts_with("HTTP/1.1 200"));
    }
    let idle = Instant::now();
    assert_eq!(read_to_end(&mut client).await, "");
    assert!(idle.elapsed() >= Duration::from_millis(150));
    server.stop().await;
}

#[tokio::test]
async fn headers_over_the_limit_are_answered_431() {
    let (_dir, server) = start(ServerConfig {
        max_header_bytes: 8192,
        ..ServerConfig::default()
    })
    .await;
    let mut client = connect(server.address).await;
    let head = format!("GET /livez HTTP/1.1\r\nhost: a\r\nx: {}\r\n\r\n", "y".repeat(9000));
    client.write_all(head.as_bytes()).await.unwrap();
    assert!(read_to_end(&mut client).await.starts_with("HTTP/1.1 431"));
    let many: Vec<String> = (0..101).map(|number| format!("x-{number}: y\r\n")).collect();
    let many = many.concat();
    let mut client = connect(server.address).await;
    let head = format!("GET /livez HTTP/1.1\r\nhost: a\r\n{many}\r\n");
    client.write_all(head.as_bytes()).await.unwrap();
    let answer = read_to_end(&mut client).await;
    assert!(
        answer.starts_with("HTTP/1.1 431") && answer.contains("more than 100 headers"),
        "{answer}"
    );
    server.stop().await;
}

#[tokio::test]
async fn an_unreadable_request_is_answered_with_problem_details() {
    let (_dir, server) = start(ServerConfig {
        max_header_bytes: 8192,
        ..ServerConfig::default()
    })
    .await;
    let long_head = format!("GET /livez HTTP/1.1\r\nhost: a\r\nx: {}\r\n\r\n", "y".repeat(9000));
    let long_path = format!("GET /{} HTTP/1.1\r\nhost: a\r\n\r\n", "y".repeat(70_000));
    for (request, statuses) in [
        (long_head.as_str(), &[431][..]),
        (long_path.as_str(), &[414, 431]),
        ("nonsense\r\n\r\n", &[400]),
        ("GET /livez HTTP/1.1\r\na b: c\r\n\r\n", &[400]),
    ] {
        let mut client = connect(server.address).await;
        // The server may answer and close before it has read everything.
        let _ = client.write_all(request.as_bytes()).await;
        let answer = read_to_end(&mut client).await;
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        let problem: serde_json::Value = serde_json::from_str(body).unwrap();
        assert!(statuses.iter().any(|status| problem["status"] == *status), "{answer}");
        assert!(
            head.contains("application/problem+json") && head.contains("nosniff"),
            "{answer}"
        );
        assert!(problem["detail"].as_str().is_some_and(|detail| !detail.is_empty()));
    }
    server.stop().await;
}

#[tokio::test]
async fn every_answer_forbids_guessing_its_type() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    for path in [
        "/",
        "/livez",
        "/docs/",
        "/docs/swagger-ui.css",
        "/v1/models",
        "/nothing",
    ] {
        let headers = get(&app, path).await.headers;
        assert_eq!(headers[header::X_CONTENT_TYPE_OPTIONS], "nosniff", "{path}");
    }
    for path in ["/", "/docs/"] {
        let headers = get(&app, path).await.headers;
        let policy = headers[header::CONTENT_SECURITY_POLICY].to_str().unwrap();
        assert!(
            policy.contains("default-src 'self'") && policy.contains("script-src 'self';"),
            "{policy}"
        );
    }
}

#[tokio::test]
async fn a_client_that_never_reads_is_disconnected() {
    let (_dir, server) = start(ServerConfig {
        write_stall_ms: 100,
        ..ServerConfig::default()
    })
    .await;
    let mut client = connect(server.address).await;
    // Until unread answers fill the buffers of both sides.
    let contract = b"GET /openapi.json HTTP/1.1\r\nhost: a\r\n\r\n".repeat(500);
    let flood = async { while client.write_all(&contract).await.is_ok() {} };
    tokio::time::timeout(TIMEOUT, flood).await.unwrap();
    server.stop().await;
}

#[tokio::test]
async fn a_draining_server_is_not_ready_but_answers() {
    let (_dir, server) = start(ServerConfig {
        drain_ms: 2_000,
        ..ServerConfig::default()
    })
    .await;
    let mut old = connect(server.address).await;
    old.write_all(ASK).await.unwrap();
    assert!(!answer(&mut old).await.contains("connection: close"));
    server.shutdown.send(()).unwrap();
    let refusal = loop {
        let mut fresh = connect(server.address).await;
        fresh
            .write_all(b"GET /readyz HTTP/1.1\r\nhost: a\r\n\r\n")
            .await
            .unwrap();
        let text = answer(&mut fresh).await;
        if text.contains("the server is stopping") {
            break text;
        }
    };
    assert!(refusal.starts_with("HTTP/1.1 503"), "{refusal}");
    old.write_all(ASK).await.unwrap();
    let last = answer(&mut old).await;
    assert!(
        last.starts_with("HTTP/1.1 200") && last.contains("connection: close"),
        "{last}"
    );
    tokio::time::timeout(TIMEOUT, server.task).await.unwrap().unwrap();
    assert!(TcpStream::connect(server.address).await.is_err());
}

#[tokio::test]
async fn a_compressed_body_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let bomb = Request::post("/v1/models/plain/predict")
        .header(header::CONTENT_TYPE, "application/json")
        .header(header::CONTENT_ENCODING, "gzip")
        .body(Body::from(vec![0x1f, 0x8b]))
        .unwrap();
    assert!(send(&app, bomb).await.detail(415).contains("Content-Encoding"));
}

#[tokio::test]
async fn other_origins_are_refused_unless_configured() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        // As people write it.
        cors_origins: vec![
            "https://Robots.example:443/".to_owned(),
            "http://plain.example:80".to_owned(),
            "http://other.example:443".to_owned(),
        ],
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let from = |method: &str, origin: &str| {
        Request::builder()
            .method(method)
            .uri("/v1/models")
            .header(header::HOST, "127.0.0.1:8642")
            .header(header::ORIGIN, origin)
            .body(Body::empty())
            .unwrap()
    };
    let foreign = send(&app, from("GET", "https://evil.example")).await;
    assert!(foreign.detail(403).contains("cors_origins"));
    assert!(!foreign.headers.contains_key(header::ACCESS_CONTROL_ALLOW_ORIGIN));
    let own = send(&app, from("GET", "http://127.0.0.1:8642")).await;
    assert_eq!(own.status, 200);
    assert!(!own.headers.contains_key(header::ACCESS_CONTROL_ALLOW_ORIGIN));
    let named = send(&app, from("GET", "https://robots.example")).await;
    assert_eq!(
        (named.status.as_u16(), &named.headers[header::VARY]),
        (200, &header::HeaderValue::from_static("origin"))
    );
    assert_eq!(
        named.headers[header::ACCESS_CONTROL_ALLOW_ORIGIN],
        "https://robots.example"
    );
    let exposed = named.headers[header::ACCESS_CONTROL_EXPOSE_HEADERS].to_str().unwrap();
    for header in ["location", "retry-after", "x-request-id"] {
        assert!(exposed.split(", ").any(|exposed| exposed == header), "{exposed}");
    }
    for (origin, status) in [
        ("http://plain.example", 200),
        ("http://other.example:443", 200),
        ("http://other.example", 403),
    ] {
        assert_eq!(send(&app, from("GET", origin)).await.status, status, "{origin}");
    }
    let question = send(&app, from("OPTIONS", "https://robots.example")).await;
    assert_eq!(question.status, 204);
    let allowed = question.headers[header::ACCESS_CONTROL_ALLOW_HEADERS].to_str().unwrap();
    for header in ["authorization", "last-event-id"] {
        assert!(allowed.split(", ").any(|allowed| allowed == header), "{allowed}");
    }
}

#[tokio::test]
async fn without_keys_public_host_names_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        cors_origins: vec!["https://robots.example:443".to_owned()],
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let asked = |host: &str| {
        let request = Request::get("/v1/models").header(header::HOST, host);
        // As a page of this host sends it.
        let request = request.header(header::ORIGIN, format!("http://{host}"));
        send(&app, request.body(Body::empty()).unwrap())
    };
    let own = [
        "localhost:8642",
        "127.0.0.1:8642",
        "127.0.0.1",
        "[::1]:8642",
        "robot-7",
        "a.localhost",
        "robots.example",
    ];
    for host in own {
        assert_eq!(asked(host).await.status, 200, "{host}");
    }
    for host in [
        "evil.example:8642",
        "evil.example",
        "127.0.0.1.evil.example:8642",
        "localhost.:8642",
    ] {
        let refused = asked(host).await.detail(403);
        assert!(refused.contains(host) && refused.contains("cors_origins"), "{refused}");
    }
}

#[tokio::test]
async fn the_api_documentation_works_offline() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    assert_eq!(get(&app, "/docs").await.headers[header::LOCATION], "/docs/");
    let page = String::from_utf8(get(&app, "/docs/").await.body).unwrap();
    for part in page.split(['"', '\'']).filter(|part| part.starts_with("./")) {
        let asset = get(&app, &format!("/docs/{}", &part[2..])).await;
        assert!(asset.status == 200 && !asset.body.is_empty(), "{part}");
        let text = String::from_utf8_lossy(&asset.body);
        assert!(
            !part.ends_with("initializer.js") || text.contains("/openapi.json"),
            "{text}"
        );
    }
    assert!(
        page.contains("./swagger-ui-bundle.js") && !page.contains("https://"),
        "{page}"
    );
}

#[test]
fn a_request_names_one_host() {
    let dir = tempfile::tempdir().unwrap();
    let served = RunningServer::start(dir.path(), &[]);
    let status = |head: &str| -> u16 {
        let mut stream = std::net::TcpStream::connect(served.address).unwrap();
        std::io::Write::write_all(&mut stream, head.as_bytes()).unwrap();
        let mut answer = String::new();
        std::io::Read::read_to_string(&mut stream, &mut answer).unwrap();
        if answer.starts_with("HTTP/1.1 400") {
            assert!(answer.contains("\"detail\""), "{answer}");
        }
        answer.split(' ').nth(1).unwrap().parse().unwrap()
    };
    let get = |target: &str, hosts: &str| status(&format!("GET {target} HTTP/1.1\r\nconnection: close\r\n{hosts}\r\n"));
    for (target, hosts) in [
        ("/v1/models", "host: localhost\r\n"),
        ("/v1/models", "host: 127.0.0.1:8642\r\n"),
        ("http://LOCALHOST/v1/models", "host: localhost\r\n"),
        ("http://localhost/v1/models", "host: localhost:80\r\n"),
        ("/v1/models", "host: [::1]:8642\r\n"),
        ("/v1/models", "host: LOCALHOST\r\norigin: http://localhost:80\r\n"),
    ] {
        assert_eq!(get(target, hosts), 200, "{target} {hosts}");
    }
    for (target, hosts) in [
        ("/v1/models", ""),
        ("/v1/models", "host:\r\n"),
        ("/v1/models", "host: \r\n"),
        ("/v1/models", "host: :8642\r\n"),
        ("/v1/models", "host: l\u{f6}calhost\r\n"),
        ("/v1/models", "host: user@localhost\r\n"),
        ("/v1/models", "host: local host\r\n"),
        ("/v1/models", "host: localhost:http\r\n"),
        ("/v1/models", "host: localhost:99999\r\n"),
        ("/v1/models", "host: [::1]x\r\n"),
        ("/v1/models", "host: []\r\n"),
        ("/v1/models", "host: [evil.com]:80\r\n"),
        (
            "/v1/models",
            "host: localhost\r\norigin: http://localhost\r\norigin: http://evil.com\r\n",
        ),
        ("/v1/models", "host: localhost\r\nhost: localhost\r\n"),
        ("http://robot-7/v1/models", "host: localhost\r\n"),
        ("http://localhost:1/v1/models", "host: localhost\r\n"),
    ] {
        assert_eq!(get(target, hosts), 400, "{target} {hosts}");
    }
    // HTTP/1.0 has no Host header.
    assert_eq!(status("GET /livez HTTP/1.0\r\n\r\n"), 200);
    // Other hosts and other origins than the server's own.
    assert_eq!(status("GET http://evil.com/v1/models HTTP/1.0\r\n\r\n"), 403);
    assert_eq!(
        get("/v1/models", "host: localhost\r\norigin: evil://localhost\r\n"),
        403
    );
}
