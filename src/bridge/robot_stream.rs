//! The bytes to and from a robot: plain, or with TLS (Cargo feature `tls`).

#[cfg(feature = "tls")]
mod tls;

#[cfg(not(feature = "tls"))]
use std::convert::Infallible;
use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::Instant;

use super::BridgeError;

/// How a robot is known to be the right one. Without the feature there is none.
pub(super) struct RobotTls(
    #[cfg(feature = "tls")] tls::TlsClient,
    #[cfg(not(feature = "tls"))] Infallible,
);

impl RobotTls {
    /// `ca_certificate`: a PEM file with the certificates to trust instead of the system's. Errors: `Tls`.
    #[cfg(feature = "tls")]
    pub(super) fn new(ca_certificate: Option<&Path>) -> Result<Self, BridgeError> {
        tls::TlsClient::new(ca_certificate).map(Self).map_err(BridgeError::Tls)
    }

    /// Errors: `Tls`.
    #[cfg(not(feature = "tls"))]
    pub(super) fn new(_: Option<&Path>) -> Result<Self, BridgeError> {
        let right = "use ws://, or build it with --features tls";
        Err(BridgeError::Tls(format!(
            "this program was built without TLS, which wss:// needs; {right}"
        )))
    }

    /// Errors: why it failed, and what would be right.
    #[cfg(feature = "tls")]
    pub(super) fn handshake(self, host: String, stream: TcpStream) -> Result<RobotStream, String> {
        let secure = self.0.handshake(host, stream)?;
        Ok(RobotStream::new(RobotBytes::Tls(Box::new(secure))))
    }

    /// Never called.
    #[cfg(not(feature = "tls"))]
    pub(super) fn handshake(self, _: String, _: TcpStream) -> Result<RobotStream, String> {
        match self.0 {}
    }
}

/// A connection to a robot. Knows when bytes came last.
pub(super) struct RobotStream {
    bytes: RobotBytes,
    heard_at: Instant,
}

enum RobotBytes {
    Plain(TcpStream),
    #[cfg(feature = "tls")]
    Tls(Box<tls::TlsStream>),
}

impl RobotStream {
    pub(super) fn plain(stream: TcpStream) -> Self {
        Self::new(RobotBytes::Plain(stream))
    }

    fn new(bytes: RobotBytes) -> Self {
        let heard_at = Instant::now();
        Self { bytes, heard_at }
    }

    /// When the last bytes came; at first, when it was opened.
    pub(super) fn heard_at(&self) -> Instant {
        self.heard_at
    }

    /// The connection below.
    pub(super) fn tcp(&self) -> &TcpStream {
        match &self.bytes {
            RobotBytes::Plain(stream) => stream,
            #[cfg(feature = "tls")]
            RobotBytes::Tls(stream) => stream.get_ref(),
        }
    }
}

impl Read for RobotStream {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let count = match &mut self.bytes {
            RobotBytes::Plain(stream) => stream.read(bytes),
            #[cfg(feature = "tls")]
            RobotBytes::Tls(stream) => stream.read(bytes),
        }?;
        self.heard_at = Instant::now();
        Ok(count)
    }
}

impl Write for RobotStream {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match &mut self.bytes {
            RobotBytes::Plain(stream) => stream.write(bytes),
            #[cfg(feature = "tls")]
            RobotBytes::Tls(stream) => stream.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match &mut self.bytes {
            RobotBytes::Plain(stream) => stream.flush(),
            #[cfg(feature = "tls")]
            RobotBytes::Tls(stream) => stream.flush(),
        }
    }
}
