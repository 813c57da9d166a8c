//! TLS by certificate files (Cargo feature `tls`): what the settings name, and what is wrong with it.

#[cfg(feature = "tls")]
mod acceptor;
#[cfg(feature = "tls")]
mod certificate;

use std::convert::Infallible;
use std::path::PathBuf;

use crate::server::config::ServerConfig;

/// Why TLS could not be set up.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TlsError {
    /// The program was built without TLS.
    #[error("{setting} is set, but this program was built without TLS; build it with --features tls")]
    Unsupported {
        /// `tls_certificate` or `tls_key`.
        setting: &'static str,
    },
    /// Only one of the two files is named.
    #[error("{setting} is set, but {missing} is not; set both, or none for plain HTTP")]
    Incomplete {
        /// The setting that is there.
        setting: &'static str,
        /// The other one.
        missing: &'static str,
    },
    /// A file could not be read.
    #[error("could not read {setting} {}: {source}", path.display())]
    Read {
        /// `tls_certificate` or `tls_key`.
        setting: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file holds nothing of the kind.
    #[error("{setting} {} holds no {wanted}; name a PEM file with a {wanted}", path.display())]
    Empty {
        /// `tls_certificate` or `tls_key`.
        setting: &'static str,
        /// The file.
        path: PathBuf,
        /// What it should hold.
        wanted: &'static str,
    },
    /// A file is damaged, or its key is of a kind that is not supported.
    #[error("{setting} {} cannot be used: {reason}", path.display())]
    Malformed {
        /// `tls_certificate` or `tls_key`.
        setting: &'static str,
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The key belongs to another certificate.
    #[error(
        "the key in tls_key {} does not fit the certificate in tls_certificate {}; name the key that the certificate was \
         made for",
        key.display(),
        certificate.display()
    )]
    KeyMismatch {
        /// The certificate's file.
        certificate: PathBuf,
        /// The key's file.
        key: PathBuf,
    },
}

/// The two files.
#[derive(Clone)]
#[cfg_attr(not(feature = "tls"), expect(dead_code, reason = "only TLS reads them"))]
struct CertificateFiles {
    certificate: PathBuf,
    key: PathBuf,
}

/// TLS for the public address. Clones share the certificate.
#[derive(Clone)]
pub struct ServerTls {
    #[cfg(feature = "tls")]
    inner: acceptor::TlsAcceptor,
    #[cfg(not(feature = "tls"))]
    never: Infallible,
}

impl ServerTls {
    /// Reads the files that the settings name; none if they name none. Errors: see [`TlsError`].
    pub fn open(config: &ServerConfig) -> Result<Option<Self>, TlsError> {
        let (certificate, key) = match (config.tls_certificate.clone(), config.tls_key.clone()) {
            (None, None) => return Ok(None),
            (Some(certificate), Some(key)) => (certificate, key),
            (Some(_), None) => return Err(incomplete("tls_certificate", "tls_key")),
            (None, Some(_)) => return Err(incomplete("tls_key", "tls_certificate")),
        };
        Self::of(CertificateFiles { certificate, key }).map(Some)
    }

    #[cfg(feature = "tls")]
    fn of(files: CertificateFiles) -> Result<Self, TlsError> {
        let inner = acceptor::TlsAcceptor::open(files)?;
        Ok(Self { inner })
    }

    #[cfg(not(feature = "tls"))]
    fn of(_: CertificateFiles) -> Result<Self, TlsError> {
        let setting = "tls_certificate";
        Err(TlsError::Unsupported { setting })
    }

    #[cfg(feature = "tls")]
    pub(super) fn acceptor(&self) -> &acceptor::TlsAcceptor {
        &self.inner
    }

    /// There is none without the feature.
    #[cfg(not(feature = "tls"))]
    pub(super) fn never(&self) -> Infallible {
        self.never
    }

    /// Takes up certificates that are renewed on disk; never returns.
    pub(in crate::server) async fn keep_fresh(tls: Option<&Self>) -> Infallible {
        #[cfg(feature = "tls")]
        if let Some(tls) = tls {
            return tls.inner.keep_fresh().await;
        }
        #[cfg(not(feature = "tls"))]
        if let Some(tls) = tls {
            return tls.never;
        }
        std::future::pending().await
    }
}

fn incomplete(setting: &'static str, missing: &'static str) -> TlsError {
    if cfg!(feature = "tls") {
        TlsError::Incomplete { setting, missing }
    } else {
        TlsError::Unsupported { setting }
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
