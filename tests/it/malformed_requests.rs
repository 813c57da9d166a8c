//! Slow, incomplete, compressed, too long and malformed requests, while a healthy robot streams.

use std::net::SocketAddr;
use std::time::Duration;

use foreframe::server::ServerConfig;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::healthy_robot::ServerWithRobot;
use crate::service::TIMEOUT;

const PREDICT: &str = "POST /v1/models/moving/predict HTTP/1.1\r\nhost: a\r\ncontent-type: application/json\r\n";

async fn connect(address: SocketAddr) -> TcpStream {
    TcpStream::connect(address).await.unwrap()
}

/// Sends all parts, then reads until the server closes the connection.
async fn send_and_read(address: SocketAddr, parts: &[&[u8]]) -> String {
    let mut client = connect(address).await;
    for part in parts {
        client.write_all(part).await.unwrap();
    }
    let mut text = Vec::new();
    let read = tokio::time::timeout(TIMEOUT, client.read_to_end(&mut text))
        .await
        .unwrap();
    let text = String::from_utf8_lossy(&text).into_owned();
    read.unwrap_or_else(|error| panic!("{error} after: {text}"));
    text
}

/// Checks that the answer is a complete problem response with this status.
fn assert_problem(answer: &str, status: u16, detail: &str) {
    assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")), "{answer}");
    let (_, body) = answer.split_once("\r\n\r\n").unwrap();
    let problem: serde_json::Value = serde_json::from_str(body).unwrap();
    assert_eq!(problem["status"], status);
    assert!(problem["detail"].as_str().unwrap().contains(detail), "{problem}");
}

#[tokio::test]
async fn endless_headers_time_out() {
    let mut setup = ServerWithRobot::open(ServerConfig {
        header_read_ms: 200,
        ..ServerConfig::default()
    })
    .await;
    let address = setup.address();
    let slow = async {
        let mut clients = Vec::new();
        for _ in 0..50 {
            let mut client = connect(address).await;
            client
                .write_all(b"GET /livez HTTP/1.1\r\nhost: a\r\nx: ")
                .await
                .unwrap();
            clients.push(client);
        }
        for client in &mut clients {
            // Single bytes do not extend the time limit.
            let send_slowly = async {
                while client.write_all(b"y").await.is_ok() {
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
            };
            tokio::time::timeout(TIMEOUT, send_slowly).await.unwrap();
        }
    };
    setup.while_robot_streams(slow).await;
    setup.close().await;
}

#[tokio::test]
async fn an_incomplete_body_is_answered_408() {
    let mut setup = ServerWithRobot::open(ServerConfig {
        request_deadline_ms: 200,
        ..ServerConfig::default()
    })
    .await;
    let address = setup.address();
    let length = format!("{PREDICT}content-length: 99\r\n\r\n{{");
    let chunks = format!("{PREDICT}transfer-encoding: chunked\r\n\r\n5\r\n{{\"fra\r\n");
    for half in [&length, &chunks] {
        let answer = setup
            .while_robot_streams(send_and_read(address, &[half.as_bytes()]))
            .await;
        assert_problem(&answer, 408, "longer than 200 ms");
    }
    let gone = async { connect(address).await.write_all(length.as_bytes()).await.unwrap() };
    setup.while_robot_streams(gone).await;
    setup.close().await;
}

#[tokio::test]
async fn a_compressed_body_is_answered_415() {
    let mut setup = ServerWithRobot::open(ServerConfig::default()).await;
    let address = setup.address();
    // The size of a gzip file that expands to gigabytes.
    let compressed = [b"\x1f\x8b\x08".as_slice(), &vec![0; 4 << 20]].concat();
    let length = compressed.len();
    for encoding in ["gzip", "br, gzip", "zstd"] {
        let head = format!("{PREDICT}content-encoding: {encoding}\r\ncontent-length: {length}\r\n\r\n");
        let answer = setup
            .while_robot_streams(send_and_read(address, &[head.as_bytes(), &compressed]))
            .await;
        assert_problem(&answer, 415, "Content-Encoding");
    }
    setup.close().await;
}

#[tokio::test]
async fn a_body_over_the_limit_is_answered_413() {
    let mut setup = ServerWithRobot::open(ServerConfig {
        max_body_bytes: 4096,
        ..ServerConfig::default()
    })
    .await;
    let address = setup.address();
    let long = vec![b' '; 3 << 20];
    let length = format!("{PREDICT}content-length: {}\r\n\r\n", long.len());
    let chunks = format!("{PREDICT}transfer-encoding: chunked\r\n\r\n{:x}\r\n", long.len());
    for head in [&length, &chunks] {
        let answer = setup
            .while_robot_streams(send_and_read(address, &[head.as_bytes(), &long]))
            .await;
        assert_problem(&answer, 413, "longer than this server takes");
    }
    setup.close().await;
}

#[tokio::test]
async fn malformed_http_closes_the_connection() {
    let mut setup = ServerWithRobot::open(ServerConfig::default()).await;
    let address = setup.address();
    for bytes in [
        &b"\x16\x03\x01\x02\0\x01\0\x01\xFC\x03\x03"[..],
        b"GET\r\n\r\n",
        b"GET / HTTP/9.9\r\nhost: a\r\n\r\n",
        b"POST /v1/jobs HTTP/1.1\r\nhost: a\r\ncontent-length: -1\r\n\r\n",
        b"POST /v1/jobs HTTP/1.1\r\nhost: a\r\ncontent-length: 99999999999999999999999\r\n\r\n",
        b"POST /v1/jobs HTTP/1.1\r\nhost: a\r\ntransfer-encoding: chunked\r\n\r\nFFFFFFFFFFFFFFFFFF\r\n",
    ] {
        let answer = setup.while_robot_streams(send_and_read(address, &[bytes])).await;
        assert!(answer.is_empty() || answer.starts_with("HTTP/1.1 4"), "{answer}");
    }
    setup.close().await;
}
