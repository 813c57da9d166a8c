//! A certificate with its key, from files.

use std::sync::Arc;
use std::time::Duration;

use tokio_rustls::rustls::client::WebPkiServerVerifier;
use tokio_rustls::rustls::client::danger::ServerCertVerifier as _;
use tokio_rustls::rustls::crypto::CryptoProvider;
use tokio_rustls::rustls::pki_types::pem::{self, PemObject as _};
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use tokio_rustls::rustls::sign::CertifiedKey;
use tokio_rustls::rustls::{CertificateError, Error, InconsistentKeys, RootCertStore};

use super::{CertificateFiles, TlsError};

/// The content of the two files.
#[derive(Clone, PartialEq, Eq)]
pub(super) struct CertificateText {
    certificate: Vec<u8>,
    key: Vec<u8>,
}

impl CertificateText {
    /// Errors: `Read`.
    pub(super) fn read(files: &CertificateFiles) -> Result<Self, TlsError> {
        let read = |setting, path: &std::path::PathBuf| {
            std::fs::read(path).map_err(|source| TlsError::Read {
                setting,
                path: path.clone(),
                source,
            })
        };
        Ok(Self {
            certificate: read("tls_certificate", &files.certificate)?,
            key: read("tls_key", &files.key)?,
        })
    }

    /// The certificate chain with its key. `files`: for the errors. Errors: `Empty`, `Malformed`, `KeyMismatch`.
    pub(super) fn parse(&self, files: &CertificateFiles, provider: &CryptoProvider) -> Result<CertifiedKey, TlsError> {
        let of_certificate = |reason: String| TlsError::Malformed {
            setting: "tls_certificate",
            path: files.certificate.clone(),
            reason,
        };
        let of_key = |reason: String| TlsError::Malformed {
            setting: "tls_key",
            path: files.key.clone(),
            reason,
        };
        let chain = CertificateDer::pem_slice_iter(&self.certificate).collect::<Result<Vec<_>, _>>();
        let chain = chain.map_err(|error| of_certificate(error.to_string()))?;
        if chain.is_empty() {
            return Err(TlsError::Empty {
                setting: "tls_certificate",
                path: files.certificate.clone(),
                wanted: "certificate",
            });
        }
        let key = PrivateKeyDer::from_pem_slice(&self.key).map_err(|error| match error {
            pem::Error::NoItemsFound => TlsError::Empty {
                setting: "tls_key",
                path: files.key.clone(),
                wanted: "private key",
            },
            error => of_key(error.to_string()),
        })?;
        CertifiedKey::from_der(chain, key, provider).map_err(|error| match error {
            Error::InconsistentKeys(InconsistentKeys::KeyMismatch) => TlsError::KeyMismatch {
                certificate: files.certificate.clone(),
                key: files.key.clone(),
            },
            error @ Error::InvalidCertificate(_) => of_certificate(error.to_string()),
            error => of_key(error.to_string()),
        })
    }
}

/// Why clients will not accept the certificate in this time from now; `None` if it is valid then.
pub(super) fn out_of_date(key: &CertifiedKey, provider: &Arc<CryptoProvider>, from_now: Duration) -> Option<String> {
    let (end_entity, chain) = key.cert.split_first()?;
    let mut roots = RootCertStore::empty();
    roots.add(key.cert.last()?.clone()).ok()?;
    let verifier = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), Arc::clone(provider));
    let at = UnixTime::since_unix_epoch(Duration::from_secs(UnixTime::now().as_secs()) + from_now);
    let name = ServerName::try_from("localhost").ok()?;
    // The times are checked before the name and the issuer, which are no concern here.
    match verifier
        .build()
        .ok()?
        .verify_server_cert(end_entity, chain, &name, &[], at)
    {
        Err(Error::InvalidCertificate(
            error @ (CertificateError::Expired
            | CertificateError::ExpiredContext { .. }
            | CertificateError::NotValidYet
            | CertificateError::NotValidYetContext { .. }),
        )) => Some(error.to_string()),
        _ => None,
    }
}
