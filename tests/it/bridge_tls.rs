//! The bridge to a robot with `wss://`, whose certificate `openssl` makes.

use std::net::TcpListener;
use std::process::Stdio;
use std::sync::Arc;

use foreframe_core::nn::Conditioning;
use serde_json::{Value, json};
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::{ServerConfig, ServerConnection, StreamOwned};
use tokio_tungstenite::tungstenite::handshake::server::{Request, Response};
use tokio_tungstenite::tungstenite::http::HeaderValue;
use tokio_tungstenite::tungstenite::{Message, accept_hdr};

use crate::bridge::PROTOCOL;
use crate::process::foreframe;
use crate::service::{TIMEOUT, model, spec};
use crate::tls::CertificateDir;

fn robot(files: &CertificateDir) -> Arc<ServerConfig> {
    let certificate = CertificateDer::from_pem_file(files.path("certificate.pem")).unwrap();
    let key = PrivateKeyDer::from_pem_file(files.path("key.pem")).unwrap();
    let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()));
    let config = config.with_safe_default_protocol_versions().unwrap();
    Arc::new(
        config
            .with_no_client_auth()
            .with_single_cert(vec![certificate], key)
            .unwrap(),
    )
}

#[test]
fn a_robot_is_reached_over_tls_if_its_certificate_is_trusted() {
    let Some(files) = CertificateDir::new() else { return };
    let dir = tempfile::tempdir().unwrap();
    model(dir.path(), "moving", spec(Conditioning::None));
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("wss://localhost:{}", listener.local_addr().unwrap().port());
    let config = robot(&files);
    let bridge = |more: &[&str]| {
        foreframe(dir.path())
            .args(["bridge", &address, "--model", "./moving"])
            .args(more)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    };
    let accept = || {
        let (stream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(TIMEOUT)).unwrap();
        StreamOwned::new(ServerConnection::new(Arc::clone(&config)).unwrap(), stream)
    };
    let choose = |_: &Request, mut response: Response| {
        let headers = response.headers_mut();
        headers.insert("sec-websocket-protocol", HeaderValue::from_static(PROTOCOL));
        Ok(response)
    };
    let certificate = files.path("certificate.pem");
    let trusting = bridge(&["--ca-certificate", certificate.to_str().unwrap()]);
    let mut socket = accept_hdr(accept(), choose).unwrap();
    let info = json!({"op": "serverInfo", "name": "safe robot", "capabilities": ["clientPublish"]});
    socket.send(Message::text(info.to_string())).unwrap();
    let heard: Value = serde_json::from_str(socket.read().unwrap().to_text().unwrap()).unwrap();
    assert_eq!(heard["op"], "advertise");
    drop(socket);
    let ended = trusting.wait_with_output().unwrap();
    assert!(String::from_utf8_lossy(&ended.stdout).contains("connected to \"safe robot\""));
    // The system does not trust it.
    let strict = bridge(&[]);
    assert!(accept_hdr(accept(), choose).is_err());
    let ended = strict.wait_with_output().unwrap();
    let error = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(1), "{error}");
    assert!(error.contains("--ca-certificate"), "{error}");
    for (path, reason) in [("key.pem", "holds no certificate"), ("missing.pem", "cannot be used")] {
        let path = files.path(path);
        let ended = bridge(&["--ca-certificate", path.to_str().unwrap()])
            .wait_with_output()
            .unwrap();
        let error = String::from_utf8_lossy(&ended.stderr);
        assert_eq!(ended.status.code(), Some(2), "{error}");
        assert!(error.contains(reason), "{error}");
    }
}
