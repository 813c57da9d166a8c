//! TLS handshakes, with a certificate that can be replaced while the server runs.

use std::convert::Infallible;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use axum::http::StatusCode;
use tokio::io::AsyncWriteExt as _;
use tokio::sync::watch;
use tokio_rustls::rustls::ServerConfig as RustlsConfig;
use tokio_rustls::rustls::crypto::{CryptoProvider, ring};
use tokio_rustls::rustls::sign::{CertifiedKey, SingleCertAndKey};
use tokio_rustls::server::TlsStream;
use tracing::{info, warn};

use super::TlsError;
use super::certificate::{CertificateFiles, CertificateText, cannot_be_used, out_of_date};
use crate::server::http::listener::BoundedConnection;
use crate::server::http::problem::last_response;

/// How often the files are read.
const READ_EVERY: Duration = Duration::from_secs(2);
/// A certificate that expires within this time is warned of.
const WARN_BEFORE: Duration = Duration::from_hours(7 * 24);

/// Does the handshakes; clones share the certificate.
#[derive(Clone)]
pub(in crate::server::http) struct TlsAcceptor {
    files: CertificateFiles,
    text: CertificateText,
    provider: Arc<CryptoProvider>,
    /// With the certificate in use.
    current: watch::Sender<Arc<RustlsConfig>>,
}

impl TlsAcceptor {
    /// Errors: a file cannot be read or used.
    pub(super) fn open(files: CertificateFiles) -> Result<Self, TlsError> {
        let provider = Arc::new(ring::default_provider());
        let text = CertificateText::read(&files)?;
        let config = config(&text, &files, &provider)?;
        Ok(Self {
            files,
            text,
            provider,
            current: watch::Sender::new(config),
        })
    }

    /// The handshake. A client that speaks plain HTTP gets an answer in plain HTTP. Errors: those of the connection and of TLS.
    pub(in crate::server::http) async fn accept(
        &self,
        mut connection: BoundedConnection,
    ) -> io::Result<TlsStream<BoundedConnection>> {
        // The first byte of TLS is 22, and that of HTTP a letter.
        if connection.peek().await?.is_some_and(|byte| byte.is_ascii_alphabetic()) {
            let detail = "this address takes HTTPS only; use https:// or wss://";
            let refusal = last_response(StatusCode::BAD_REQUEST, "malformed", detail);
            connection.write_all(&refusal).await?;
            return Err(io::Error::other("the client speaks plain HTTP"));
        }
        let config = Arc::clone(&self.current.borrow());
        tokio_rustls::TlsAcceptor::from(config).accept(connection).await
    }

    /// Reads the files again and again. A changed certificate is used from the next handshake on; if it cannot be used, the one
    /// before stays.
    pub(super) async fn keep_fresh(&self) -> Infallible {
        let mut seen = self.text.clone();
        loop {
            tokio::time::sleep(READ_EVERY).await;
            let files = self.files.clone();
            let read = tokio::task::spawn_blocking(move || CertificateText::read(&files)).await;
            let text = match read {
                Ok(Ok(text)) if text != seen => text,
                // A file that is being replaced may be absent for a moment.
                _ => continue,
            };
            match config(&text, &self.files, &self.provider) {
                Ok(config) => {
                    self.current.send_replace(config);
                    info!("the TLS certificate was renewed");
                }
                Err(error) => warn!(%error, "the TLS certificate on disk cannot be used; the one before stays"),
            }
            seen = text;
        }
    }
}

/// What a handshake needs, with that certificate. Errors: it cannot be used.
fn config(
    text: &CertificateText,
    files: &CertificateFiles,
    provider: &Arc<CryptoProvider>,
) -> Result<Arc<RustlsConfig>, TlsError> {
    let key = text.parse(files, provider)?;
    warn_if_out_of_date(&key, provider);
    let config = RustlsConfig::builder_with_provider(Arc::clone(provider)).with_safe_default_protocol_versions();
    let config = config.map_err(|error| files.unusable_certificate(cannot_be_used(error)))?;
    let mut config = config
        .with_no_client_auth()
        .with_cert_resolver(Arc::new(SingleCertAndKey::from(key)));
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(Arc::new(config))
}

fn warn_if_out_of_date(key: &CertifiedKey, provider: &Arc<CryptoProvider>) {
    if let Some(reason) = out_of_date(key, provider, Duration::ZERO) {
        warn!(reason, "clients will refuse the TLS certificate; renew it");
    } else if out_of_date(key, provider, WARN_BEFORE).is_some() {
        warn!("the TLS certificate expires within 7 days; renew it");
    }
}
