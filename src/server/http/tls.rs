//! TLS by certificate files (Cargo feature `tls`): what the settings name, and what is wrong with it.

#[cfg(feature = "tls")]
mod acceptor;
#[cfg(feature = "tls")]
mod certificate;

use std::convert::Infallible;

use crate::server::config::ServerConfig;

/// Why TLS could not be set up: which setting is wrong, and what would be right.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct TlsError(String);

/// TLS for the public address. Clones share the certificate. Without the feature there is none.
#[derive(Clone)]
pub struct ServerTls(
    #[cfg(feature = "tls")] pub(super) acceptor::TlsAcceptor,
    #[cfg(not(feature = "tls"))] pub(super) Infallible,
);

impl ServerTls {
    /// Reads the files that the settings name; none if they name none.
    pub fn open(config: &ServerConfig) -> Result<Option<Self>, TlsError> {
        let (setting, missing) = match (&config.tls_certificate, &config.tls_key) {
            (None, None) => return Ok(None),
            #[cfg(feature = "tls")]
            (Some(certificate), Some(key)) => {
                let files = certificate::CertificateFiles {
                    certificate: certificate.clone(),
                    key: key.clone(),
                };
                return acceptor::TlsAcceptor::open(files).map(Self).map(Some);
            }
            (Some(_), _) => ("tls_certificate", "tls_key"),
            (None, Some(_)) => ("tls_key", "tls_certificate"),
        };
        Err(TlsError(if cfg!(feature = "tls") {
            format!("{setting} is set, but {missing} is not; set both, or none for plain HTTP")
        } else {
            format!("{setting} is set, but this program was built without TLS; build it with --features tls")
        }))
    }

    /// Takes up certificates that are renewed on disk; never returns.
    pub(in crate::server) async fn keep_fresh(tls: Option<&Self>) -> Infallible {
        match tls {
            None => std::future::pending().await,
            #[cfg(feature = "tls")]
            Some(Self(acceptor)) => acceptor.keep_fresh().await,
            #[cfg(not(feature = "tls"))]
            Some(Self(never)) => match *never {},
        }
    }
}

#[cfg(all(test, not(feature = "tls")))]
mod tests {
    use super::*;

    #[test]
    fn without_the_feature_a_certificate_is_refused() {
        let config = ServerConfig {
            tls_certificate: Some("certificate.pem".into()),
            ..ServerConfig::default()
        };
        let error = ServerTls::open(&config).err().unwrap().to_string();
        assert_eq!(
            error,
            "tls_certificate is set, but this program was built without TLS; build it with --features tls"
        );
        assert!(ServerTls::open(&ServerConfig::default()).unwrap().is_none());
    }
}
