//! TLS handshakes, with a certificate that can be replaced while the server runs.

use std::convert::Infallible;
use std::io;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use tokio::io::AsyncWriteExt as _;
use tokio_rustls::rustls::ServerConfig as RustlsConfig;
use tokio_rustls::rustls::crypto::{CryptoProvider, ring};
use tokio_rustls::rustls::server::{ClientHello, ResolvesServerCert};
use tokio_rustls::rustls::sign::CertifiedKey;
use tokio_rustls::server::TlsStream;
use tracing::{info, warn};

use super::certificate::{CertificateText, out_of_date};
use super::{CertificateFiles, TlsError};
use crate::server::http::listener::BoundedConnection;
use crate::server::http::problem::PLAIN_HTTP_RESPONSE;

/// How often the files are read.
const READ_EVERY: Duration = Duration::from_secs(2);
/// A certificate that expires within this time is warned of.
const WARN_BEFORE: Duration = Duration::from_hours(7 * 24);

/// The certificate in use.
#[derive(Debug)]
struct CurrentCertificate(RwLock<Arc<CertifiedKey>>);

impl ResolvesServerCert for CurrentCertificate {
    fn resolve(&self, _: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(Arc::clone(&self.0.read().unwrap_or_else(PoisonError::into_inner)))
    }
}

/// Does the handshakes; clones share the certificate.
#[derive(Clone)]
pub(in crate::server::http) struct TlsAcceptor {
    files: CertificateFiles,
    text: CertificateText,
    provider: Arc<CryptoProvider>,
    current: Arc<CurrentCertificate>,
    config: Arc<RustlsConfig>,
}

impl TlsAcceptor {
    /// Errors: every [`TlsError`] but `Unsupported` and `Incomplete`.
    pub(super) fn open(files: CertificateFiles) -> Result<Self, TlsError> {
        let provider = Arc::new(ring::default_provider());
        let text = CertificateText::read(&files)?;
        let key = Arc::new(text.parse(&files, &provider)?);
        warn_if_out_of_date(&key, &provider);
        let current = Arc::new(CurrentCertificate(RwLock::new(key)));
        let config = RustlsConfig::builder_with_provider(Arc::clone(&provider))
            .with_safe_default_protocol_versions()
            .map_err(|error| TlsError::Malformed {
                setting: "tls_certificate",
                path: files.certificate.clone(),
                reason: error.to_string(),
            })?;
        let resolver = Arc::<CurrentCertificate>::clone(&current);
        let mut config = config.with_no_client_auth().with_cert_resolver(resolver);
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Self {
            files,
            text,
            provider,
            current,
            config: Arc::new(config),
        })
    }

    /// The handshake. A client that speaks plain HTTP gets an answer in plain HTTP. Errors: those of the connection and of TLS.
    pub(in crate::server::http) async fn accept(
        &self,
        mut connection: BoundedConnection,
    ) -> io::Result<TlsStream<BoundedConnection>> {
        // The first byte of TLS is 22, and that of HTTP a letter.
        if connection.peek().await?.is_some_and(|byte| byte.is_ascii_alphabetic()) {
            connection.write_all(PLAIN_HTTP_RESPONSE.as_bytes()).await?;
            return Err(io::Error::other("the client speaks plain HTTP"));
        }
        tokio_rustls::TlsAcceptor::from(Arc::clone(&self.config))
            .accept(connection)
            .await
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
            match text.parse(&self.files, &self.provider) {
                Ok(key) => {
                    warn_if_out_of_date(&key, &self.provider);
                    *self.current.0.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(key);
                    info!("the TLS certificate was renewed");
                }
                Err(error) => warn!(%error, "the TLS certificate on disk cannot be used; the one before stays"),
            }
            seen = text;
        }
    }
}

fn warn_if_out_of_date(key: &CertifiedKey, provider: &Arc<CryptoProvider>) {
    if let Some(reason) = out_of_date(key, provider, Duration::ZERO) {
        warn!(reason, "clients will refuse the TLS certificate; renew it");
    } else if out_of_date(key, provider, WARN_BEFORE).is_some() {
        warn!("the TLS certificate expires within 7 days; renew it");
    }
}
