//! TLS to a robot.

use std::net::TcpStream;
use std::path::Path;
use std::sync::Arc;

use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::{CertificateError, ClientConfig, ClientConnection, Error, RootCertStore, StreamOwned};

pub(super) type TlsStream = StreamOwned<ClientConnection, TcpStream>;

/// The certificates that are trusted.
pub(super) struct TlsClient(Arc<ClientConfig>);

impl TlsClient {
    /// `ca_certificate`: a PEM file with the certificates to trust instead of the system's. Errors: they cannot be read, or there are
    /// none.
    pub(super) fn new(ca_certificate: Option<&Path>) -> Result<Self, String> {
        let roots = match ca_certificate {
            Some(path) => roots_in(path).map_err(|reason| format!("--ca-certificate {} {reason}", path.display()))?,
            None => roots_of_system()?,
        };
        let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
        let config = config.with_safe_default_protocol_versions();
        let config = config.map_err(|error| error.to_string())?.with_root_certificates(roots);
        Ok(Self(Arc::new(config.with_no_client_auth())))
    }

    /// Errors: why it failed, and what would be right.
    pub(super) fn handshake(self, host: String, mut stream: TcpStream) -> Result<TlsStream, String> {
        let name = ServerName::try_from(host).map_err(|error| error.to_string())?;
        let mut connection = ClientConnection::new(self.0, name).map_err(|error| error.to_string())?;
        while connection.is_handshaking() {
            connection.complete_io(&mut stream).map_err(|error| reason(&error))?;
        }
        Ok(StreamOwned::new(connection, stream))
    }
}

fn roots_in(path: &Path) -> Result<RootCertStore, String> {
    let found = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let found = found.map_err(|error| format!("cannot be used: {error}"))?;
    if found.is_empty() {
        return Err("holds no certificate; name a PEM file with one".to_owned());
    }
    let mut roots = RootCertStore::empty();
    for certificate in found {
        let added = roots.add(certificate);
        added.map_err(|error| format!("cannot be used: {error}"))?;
    }
    Ok(roots)
}

fn roots_of_system() -> Result<RootCertStore, String> {
    let mut roots = RootCertStore::empty();
    roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
    if roots.is_empty() {
        return Err("this system trusts no certificates; name those to trust with --ca-certificate FILE".to_owned());
    }
    Ok(roots)
}

fn reason(error: &std::io::Error) -> String {
    let of_tls = error.get_ref().and_then(|inner| inner.downcast_ref::<Error>());
    match of_tls {
        Some(Error::InvalidCertificate(CertificateError::UnknownIssuer)) => {
            "its certificate is not trusted; name the one to trust with --ca-certificate FILE".to_owned()
        }
        // Such as one with the name of a certificate that the system trusts, but not signed by it.
        Some(Error::InvalidCertificate(_)) => {
            format!("{error}; name another certificate to trust with --ca-certificate FILE")
        }
        _ => error.to_string(),
    }
}
