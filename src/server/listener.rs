//! A listener that holds a bounded number of connections; those over it are told so and closed.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tracing::warn;

use super::error::CONNECTIONS_FULL_RESPONSE;

/// Connections that are being refused at a time; more are closed without a word.
const MAX_REFUSING: usize = 64;
/// How long a refused client may take to hang up, so that it has read why.
const REFUSAL_LIMIT: Duration = Duration::from_secs(1);

pub(super) struct BoundedListener {
    inner: TcpListener,
    places: Arc<Semaphore>,
    refusing: Arc<Semaphore>,
}

impl BoundedListener {
    pub(super) fn new(inner: TcpListener, limit: usize) -> Self {
        Self {
            inner,
            places: Arc::new(Semaphore::new(limit)),
            refusing: Arc::new(Semaphore::new(MAX_REFUSING)),
        }
    }
}

impl BoundedListener {
    fn refuse(&self, stream: TcpStream) {
        warn!("too many connections; one is refused");
        if let Ok(place) = Arc::clone(&self.refusing).try_acquire_owned() {
            tokio::spawn(async move {
                // A client that is gone or slow has had its chance.
                let _ = tokio::time::timeout(REFUSAL_LIMIT, tell_and_drain(stream)).await;
                drop(place);
            });
        }
    }
}

impl Listener for BoundedListener {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        loop {
            let (stream, address) = Listener::accept(&mut self.inner).await;
            // Answers are small and awaited: they must not wait to be joined with others.
            if let Err(error) = stream.set_nodelay(true) {
                warn!(%error, "could not set TCP_NODELAY");
            }
            match Arc::clone(&self.places).try_acquire_owned() {
                Ok(place) => {
                    let connection = Connection { stream, _place: place };
                    return (connection, address);
                }
                Err(_) => self.refuse(stream),
            }
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.inner.local_addr()
    }
}

async fn tell_and_drain(stream: TcpStream) -> io::Result<()> {
    stream.writable().await?;
    // Shorter than any socket's send buffer, so it is written at once.
    stream.try_write(CONNECTIONS_FULL_RESPONSE.as_bytes())?;
    let stream = stream.into_std()?;
    stream.shutdown(std::net::Shutdown::Write)?;
    let stream = TcpStream::from_std(stream)?;
    let mut unread = [0; 1024];
    // Closing with unread bytes would reset the connection before the client has read why.
    loop {
        stream.readable().await?;
        match stream.try_read(&mut unread) {
            Ok(0) => return Ok(()),
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(error),
            _ => {}
        }
    }
}

/// A connection that holds its place until it is dropped.
pub(super) struct Connection {
    stream: TcpStream,
    _place: OwnedSemaphorePermit,
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(cx, bytes)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}
