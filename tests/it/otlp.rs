//! Traces that the real program sends to a collector.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpListener;

use crate::process::RunningServer;

/// Accepts one request and returns its first line and body.
fn first_trace(collector: &TcpListener) -> (String, Vec<u8>) {
    let (stream, _) = collector.accept().unwrap();
    let mut stream = BufReader::new(stream);
    let (mut path, mut length) = (String::new(), 0);
    loop {
        let mut line = String::new();
        stream.read_line(&mut line).unwrap();
        if line == "\r\n" {
            break;
        }
        if path.is_empty() {
            line.trim().clone_into(&mut path);
        } else if let Some(value) = line.to_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().unwrap();
        }
    }
    let mut body = vec![0; length];
    stream.read_exact(&mut body).unwrap();
    let answer = b"HTTP/1.1 200 OK\r\ncontent-type: application/x-protobuf\r\ncontent-length: 0\r\n\r\n";
    stream.get_mut().write_all(answer).unwrap();
    (path, body)
}

#[test]
fn request_traces_reach_the_collector() {
    let (dir, collector) = (tempfile::tempdir().unwrap(), TcpListener::bind("127.0.0.1:0").unwrap());
    let endpoint = format!("otlp_endpoint=http://{}", collector.local_addr().unwrap());
    let server = RunningServer::start(dir.path(), &["--set", &endpoint]);
    server.get("/v1/models");
    server.program.terminate();
    let (path, body) = first_trace(&collector);
    server.program.wait_for_exit();
    assert_eq!(path, "POST /v1/traces HTTP/1.1");
    let holds = |text: &str| body.windows(text.len()).any(|part| part == text.as_bytes());
    // The service's name, and the request with its path.
    assert!(holds("service.name") && holds("foreframe") && holds("request") && holds("/v1/models"));
}
