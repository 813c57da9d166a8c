//! HTTPS by certificate files. The certificates are made by `openssl`; without it the tests are skipped.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use foreframe::server::protocol::ServerMessage;
use foreframe::server::{ServerConfig, ServerTls};
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::{ClientConfig, RootCertStore};
use tokio_tungstenite::tungstenite::Message;

use crate::service::{InProcessServer, TIMEOUT, app, poll_until, run};

/// A directory with a certificate, its key, and a server's settings that name them.
pub(crate) struct CertificateDir {
    dir: tempfile::TempDir,
}

impl CertificateDir {
    /// None without `openssl`.
    pub(crate) fn new() -> Option<Self> {
        if Command::new("openssl").arg("version").output().is_err() {
            println!("skipped: openssl is not installed");
            return None;
        }
        let dir = tempfile::tempdir().unwrap();
        let own = Self { dir };
        own.renew();
        Some(own)
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn config(&self) -> ServerConfig {
        ServerConfig {
            tls_certificate: Some(self.path("certificate.pem")),
            tls_key: Some(self.path("key.pem")),
            ..ServerConfig::default()
        }
    }

    /// A new certificate with a new key.
    fn renew(&self) {
        openssl(
            self.dir.path(),
            "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 30 -subj /CN=localhost -addext \
             subjectAltName=DNS:localhost -addext basicConstraints=critical,CA:FALSE -keyout key.pem -out certificate.pem",
        );
    }

    /// The same key with a certificate that has expired.
    fn expire(&self) {
        let config = "[ca]\ndefault_ca = a\n[a]\ndatabase = index\nserial = serial\nnew_certs_dir = .\ndefault_md = sha256\n\
                      policy = p\nx509_extensions = e\n[p]\ncommonName = supplied\n\
                      [e]\nbasicConstraints = critical,CA:FALSE\n";
        std::fs::write(self.path("ca.conf"), config).unwrap();
        std::fs::write(self.path("index"), "").unwrap();
        std::fs::write(self.path("serial"), "01").unwrap();
        openssl(
            self.dir.path(),
            "req -new -key key.pem -subj /CN=localhost -out request.pem",
        );
        openssl(
            self.dir.path(),
            "ca -batch -notext -config ca.conf -selfsign -keyfile key.pem -in request.pem -startdate 20200101000000Z \
             -enddate 20200201000000Z -out certificate.pem",
        );
    }

    async fn serve(&self, config: ServerConfig) -> InProcessServer {
        let tls = ServerTls::open(&self.config()).unwrap();
        run(app(self.dir.path(), config).with_tls(tls)).await
    }

    /// A connection that trusts only the certificate that is in the file now.
    async fn connect(&self, server: &InProcessServer) -> std::io::Result<TlsStream<TcpStream>> {
        let mut roots = RootCertStore::empty();
        let certificate = CertificateDer::from_pem_file(self.path("certificate.pem")).unwrap();
        roots.add(certificate).unwrap();
        let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(roots)
            .with_no_client_auth();
        let name = ServerName::try_from("localhost").unwrap();
        let stream = TcpStream::connect(server.address).await?;
        TlsConnector::from(Arc::new(config)).connect(name, stream).await
    }
}

fn openssl(dir: &Path, arguments: &str) {
    let output = Command::new("openssl")
        .args(arguments.split_whitespace())
        .current_dir(dir)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Reads to the end; a reset is one too.
async fn read_all(mut stream: impl tokio::io::AsyncRead + Unpin) -> String {
    let mut answer = Vec::new();
    let _ = tokio::time::timeout(TIMEOUT, stream.read_to_end(&mut answer))
        .await
        .unwrap();
    String::from_utf8_lossy(&answer).into_owned()
}

const LIVEZ: &[u8] = b"GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";

#[tokio::test]
async fn requests_and_streams_work_over_tls() {
    let Some(files) = CertificateDir::new() else { return };
    let server = files.serve(ServerConfig::default()).await;
    let mut client = files.connect(&server).await.unwrap();
    client.write_all(LIVEZ).await.unwrap();
    let answer = read_all(client).await;
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    let mut malformed = files.connect(&server).await.unwrap();
    malformed
        .write_all(b"GET / HTTP/1.1\r\nhost : x\r\n\r\n")
        .await
        .unwrap();
    let answer = read_all(malformed).await;
    assert!(answer.contains("application/problem+json"), "{answer}");

    let client = files.connect(&server).await.unwrap();
    let url = "wss://localhost/v1/models/plain/stream";
    let (mut socket, _) = tokio_tungstenite::client_async(url, client).await.unwrap();
    let mut receive = async |text: &str| {
        if !text.is_empty() {
            socket.send(Message::text(text)).await.unwrap();
        }
        let message = socket.next().await.unwrap().unwrap().into_text().unwrap();
        serde_json::from_str::<ServerMessage>(&message).unwrap()
    };
    assert!(matches!(receive("").await, ServerMessage::Ready { .. }));
    let ping = "{\"type\": \"ping\", \"timestamp_us\": 7}";
    assert_eq!(receive(ping).await, ServerMessage::Pong { timestamp_us: 7 });
    server.stop().await;
}

#[tokio::test]
async fn plain_http_at_a_tls_address_is_told_so() {
    let Some(files) = CertificateDir::new() else { return };
    let server = files.serve(ServerConfig::default()).await;
    let mut client = TcpStream::connect(server.address).await.unwrap();
    client.write_all(LIVEZ).await.unwrap();
    let answer = read_all(client).await;
    assert!(
        answer.starts_with("HTTP/1.1 400") && answer.contains("takes HTTPS only"),
        "{answer}"
    );
    let mut client = TcpStream::connect(server.address).await.unwrap();
    client.write_all(b"\x16\x03\x01\x00\x05hello").await.unwrap();
    assert!(!read_all(client).await.contains("HTTP"));
    server.stop().await;
}

#[tokio::test]
async fn a_handshake_counts_as_a_connection_and_has_a_time_limit() {
    let Some(files) = CertificateDir::new() else { return };
    let config = ServerConfig {
        max_connections: 1,
        max_connections_per_address: 1,
        connection_evict_ms: 60_000,
        header_read_ms: 1000,
        ..ServerConfig::default()
    };
    let server = files.serve(config).await;
    let silent = TcpStream::connect(server.address).await.unwrap();
    // Connections are accepted in order.
    let refused = read_all(TcpStream::connect(server.address).await.unwrap()).await;
    assert!(refused.starts_with("HTTP/1.1 503"), "{refused}");
    assert_eq!(read_all(silent).await, "");
    poll_until(async || files.connect(&server).await.ok()).await;
    server.stop().await;
}

#[tokio::test]
async fn a_renewed_certificate_is_used_without_a_restart() {
    let Some(files) = CertificateDir::new() else { return };
    let server = files.serve(ServerConfig::default()).await;
    files.connect(&server).await.unwrap();
    let before = std::fs::read(files.path("certificate.pem")).unwrap();
    files.renew();
    assert!(files.connect(&server).await.is_err());
    let renewed = async || {
        tokio::time::sleep(Duration::from_millis(100)).await;
        files.connect(&server).await.ok()
    };
    poll_until(renewed).await;
    // A certificate that does not fit the key changes nothing.
    let after = std::fs::read(files.path("certificate.pem")).unwrap();
    std::fs::write(files.path("certificate.pem"), before).unwrap();
    tokio::time::sleep(Duration::from_secs(3)).await;
    std::fs::write(files.path("certificate.pem"), after).unwrap();
    files.connect(&server).await.unwrap();
    server.stop().await;
}

#[test]
fn wrong_certificate_files_are_refused_in_a_sentence() {
    let Some(files) = CertificateDir::new() else { return };
    let key = std::fs::read(files.path("key.pem")).unwrap();
    let error = |config: &ServerConfig| ServerTls::open(config).err().unwrap().to_string();
    let alone = ServerConfig {
        tls_key: None,
        ..files.config()
    };
    assert_eq!(
        error(&alone),
        "tls_certificate is set, but tls_key is not; set both, or none for plain HTTP"
    );
    let with = |name: &str, content: Option<&[u8]>| {
        let fresh = CertificateDir::new().unwrap();
        match content {
            Some(content) => std::fs::write(fresh.path(name), content).unwrap(),
            None => std::fs::remove_file(fresh.path(name)).unwrap(),
        }
        error(&fresh.config())
    };
    let begin = "-----BEGIN CERTIFICATE-----\n";
    let damaged = format!("{begin}AAAA\n-----END CERTIFICATE-----\n");
    let cases: [(&str, Option<&[u8]>, &str); 7] = [
        ("certificate.pem", None, "could not read tls_certificate "),
        ("key.pem", None, "could not read tls_key "),
        (
            "certificate.pem",
            Some(b""),
            "holds no certificate; name a PEM file with a certificate",
        ),
        (
            "key.pem",
            Some(b""),
            "holds no private key; name a PEM file with a private key",
        ),
        ("certificate.pem", Some(begin.as_bytes()), "cannot be used: "),
        ("certificate.pem", Some(damaged.as_bytes()), "cannot be used: "),
        (
            "key.pem",
            Some(&key),
            "does not fit the certificate in tls_certificate ",
        ),
    ];
    for (name, content, expected) in cases {
        let sentence = with(name, content);
        assert!(
            sentence.contains(expected) && !sentence.contains('\n'),
            "{name}: {sentence}"
        );
    }
}

#[test]
fn an_expired_certificate_is_warned_of() {
    let Some(files) = CertificateDir::new() else { return };
    files.expire();
    let dir = files.dir.path();
    let set = |setting: &str, name: &str| format!("{setting}={}", files.path(name).display());
    let (certificate, key) = (set("tls_certificate", "certificate.pem"), set("tls_key", "key.pem"));
    let arguments = ["serve", "--port", "0", "--set", &certificate, "--set", &key];
    let server = crate::process::Program::start(dir, &arguments);
    assert!(
        server.first_line().contains("listens on https://"),
        "{}",
        server.first_line()
    );
    server.terminate();
    let log = server.wait_for_exit();
    assert!(log.contains("clients will refuse the TLS certificate"), "{log}");
}
