//! A certificate with its key, from files.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio_rustls::rustls::client::WebPkiServerVerifier;
use tokio_rustls::rustls::client::danger::ServerCertVerifier as _;
use tokio_rustls::rustls::crypto::CryptoProvider;
use tokio_rustls::rustls::pki_types::pem::{self, PemObject as _};
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use tokio_rustls::rustls::sign::CertifiedKey;
use tokio_rustls::rustls::{CertificateError, Error, InconsistentKeys, RootCertStore};

use super::TlsError;

/// The two files.
#[derive(Clone)]
pub(super) struct CertificateFiles {
    pub(super) certificate: PathBuf,
    pub(super) key: PathBuf,
}

/// Their content.
#[derive(Clone, PartialEq, Eq)]
pub(super) struct CertificateText {
    certificate: Vec<u8>,
    key: Vec<u8>,
}

impl CertificateText {
    /// Errors: a file cannot be read.
    pub(super) fn read(files: &CertificateFiles) -> Result<Self, TlsError> {
        let read = |setting, path: &Path| {
            let unreadable = |error| TlsError(format!("could not read {setting} {}: {error}", path.display()));
            std::fs::read(path).map_err(unreadable)
        };
        Ok(Self {
            certificate: read("tls_certificate", &files.certificate)?,
            key: read("tls_key", &files.key)?,
        })
    }

    /// The certificate chain with its key. `files`: for the errors. Errors: one of them cannot be used, or the key belongs to
    /// another certificate.
    pub(super) fn parse(&self, files: &CertificateFiles, provider: &CryptoProvider) -> Result<CertifiedKey, TlsError> {
        let holds_no = |wanted| format!("holds no {wanted}; name a PEM file with a {wanted}");
        let chain = CertificateDer::pem_slice_iter(&self.certificate).collect::<Result<Vec<_>, _>>();
        let chain = chain.map_err(|error| files.unusable_certificate(cannot_be_used(error)))?;
        if chain.is_empty() {
            return Err(files.unusable_certificate(holds_no("certificate")));
        }
        let key = PrivateKeyDer::from_pem_slice(&self.key).map_err(|error| match error {
            pem::Error::NoItemsFound => files.unusable_key(holds_no("private key")),
            error => files.unusable_key(cannot_be_used(error)),
        })?;
        CertifiedKey::from_der(chain, key, provider).map_err(|error| match error {
            Error::InconsistentKeys(InconsistentKeys::KeyMismatch) => TlsError(format!(
                "the key in tls_key {} does not fit the certificate in tls_certificate {}; name the key that the certificate \
                 was made for",
                files.key.display(),
                files.certificate.display()
            )),
            Error::InvalidCertificate(_) => files.unusable_certificate(cannot_be_used(error)),
            _ => files.unusable_key(cannot_be_used(error)),
        })
    }
}

impl CertificateFiles {
    pub(super) fn unusable_certificate(&self, reason: impl Display) -> TlsError {
        TlsError(format!("tls_certificate {} {reason}", self.certificate.display()))
    }

    fn unusable_key(&self, reason: impl Display) -> TlsError {
        TlsError(format!("tls_key {} {reason}", self.key.display()))
    }
}

pub(super) fn cannot_be_used(error: impl Display) -> String {
    format!("cannot be used: {error}")
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
