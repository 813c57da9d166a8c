//! A listener that holds a bounded number of connections; those over it are told so and closed.

use std::future::poll_fn;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use metrics::{counter, gauge};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Sleep;
use tracing::warn;

use super::ServerConfig;
use super::error::CONNECTIONS_FULL_RESPONSE;
use crate::telemetry::names;

/// Connections that are being refused at a time; more are closed without a word.
const MAX_REFUSING: usize = 64;
/// How long a client may take to hang up after the last that is said to it, so that it has read that.
const LINGER: Duration = Duration::from_secs(1);
/// How long to wait when the system has no descriptors left for a connection.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

pub(super) struct BoundedListener {
    inner: TcpListener,
    places: Arc<Semaphore>,
    refusing: Arc<Semaphore>,
    write_stall: Duration,
}

impl BoundedListener {
    pub(super) fn new(inner: TcpListener, config: &ServerConfig) -> Self {
        Self {
            inner,
            places: Arc::new(Semaphore::new(config.max_connections)),
            refusing: Arc::new(Semaphore::new(MAX_REFUSING)),
            write_stall: Duration::from_millis(config.write_stall_ms),
        }
    }

    /// The next connection that has a place. Nothing is lost when the future is dropped.
    pub(super) async fn accept(&self) -> BoundedConnection {
        loop {
            let stream = match self.inner.accept().await {
                Ok((stream, _)) => stream,
                Err(error) => {
                    pause_after(&error).await;
                    continue;
                }
            };
            // Answers are small and awaited: they must not wait to be joined with others.
            if let Err(error) = stream.set_nodelay(true) {
                warn!(%error, "could not set TCP_NODELAY");
            }
            match Arc::clone(&self.places).try_acquire_owned() {
                Ok(place) => return BoundedConnection::new(stream, place, self.write_stall),
                Err(_) => self.refuse(stream),
            }
        }
    }

    fn refuse(&self, stream: TcpStream) {
        warn!("too many connections; one is refused");
        counter!(names::HTTP_CONNECTIONS_REFUSED).increment(1);
        if let Ok(place) = Arc::clone(&self.refusing).try_acquire_owned() {
            tokio::spawn(async move {
                // A client that is gone or slow has had its chance.
                let _ = tokio::time::timeout(LINGER, tell_and_hang_up(stream)).await;
                drop(place);
            });
        }
    }
}

async fn pause_after(error: &io::Error) {
    let is_of_client = matches!(
        error.kind(),
        io::ErrorKind::ConnectionRefused | io::ErrorKind::ConnectionAborted | io::ErrorKind::ConnectionReset
    );
    if !is_of_client {
        warn!(%error, "no connection could be taken");
        tokio::time::sleep(ACCEPT_PAUSE).await;
    }
}

async fn tell_and_hang_up(stream: TcpStream) -> io::Result<()> {
    stream.writable().await?;
    // Shorter than any socket's send buffer, so it is written at once.
    stream.try_write(CONNECTIONS_FULL_RESPONSE.as_bytes())?;
    hang_up(stream).await
}

/// Says no more, and drops what still comes until the client hangs up too: closing with unread bytes would reset the
/// connection before the client has read what was said.
async fn hang_up(mut stream: TcpStream) -> io::Result<()> {
    poll_fn(|cx| Pin::new(&mut stream).poll_shutdown(cx)).await?;
    let mut unread = [0; 4096];
    loop {
        stream.readable().await?;
        match stream.try_read(&mut unread) {
            Ok(0) => return Ok(()),
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(error),
            _ => {}
        }
    }
}

/// A connection that holds its place until it has ended, and fails when its client reads nothing for too long. Dropped, it
/// gives the client time to read the last that was written.
pub(super) struct BoundedConnection {
    /// None once it is dropped.
    open: Option<(TcpStream, OwnedSemaphorePermit)>,
    write_stall: Duration,
    stalled: Option<Pin<Box<Sleep>>>,
}

impl BoundedConnection {
    fn new(stream: TcpStream, place: OwnedSemaphorePermit, write_stall: Duration) -> Self {
        gauge!(names::HTTP_CONNECTIONS).increment(1.0);
        Self {
            open: Some((stream, place)),
            write_stall,
            stalled: None,
        }
    }

    fn stream(&mut self) -> io::Result<Pin<&mut TcpStream>> {
        let (stream, _) = self.open.as_mut().ok_or(io::ErrorKind::NotConnected)?;
        Ok(Pin::new(stream))
    }

    /// Passes on how a write went; one that cannot go on has until the stall's limit.
    fn watch<T>(&mut self, cx: &mut Context<'_>, written: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        if written.is_ready() {
            self.stalled = None;
            return written;
        }
        let limit = self.write_stall;
        let sleep = self.stalled.get_or_insert_with(|| Box::pin(tokio::time::sleep(limit)));
        sleep
            .as_mut()
            .poll(cx)
            .map(|()| Err(io::Error::new(io::ErrorKind::TimedOut, "the client reads nothing")))
    }
}

impl Drop for BoundedConnection {
    fn drop(&mut self) {
        gauge!(names::HTTP_CONNECTIONS).decrement(1.0);
        // Without a runtime all ends at once.
        if let (Some((stream, place)), Ok(runtime)) = (self.open.take(), Handle::try_current()) {
            runtime.spawn(async move {
                let _ = tokio::time::timeout(LINGER, hang_up(stream)).await;
                drop(place);
            });
        }
    }
}

impl AsyncRead for BoundedConnection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.stream()?.poll_read(cx, buffer)
    }
}

impl AsyncWrite for BoundedConnection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = self.stream()?.poll_write(cx, bytes);
        self.watch(cx, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = self.stream()?.poll_write_vectored(cx, bytes);
        self.watch(cx, written)
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream()?.poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream()?.poll_shutdown(cx)
    }
}
