//! A listener with a bounded number of connections. A connection over the bound takes the place of one that is idle. If there
//! is none, it gets a 503 response and is closed.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use axum::http::StatusCode;
use metrics::{counter, gauge};
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt as _, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio::time::Sleep;
use tracing::warn;

use super::connection_table::{ConnectionLimits, ConnectionPlace, ConnectionTable};
use super::problem::last_response;
use crate::server::config::ServerConfig;
use foreframe_core::metric_names;

/// How many connections can be refused with a response at the same time; more are closed without one.
const MAX_REFUSING: usize = 64;
/// How long a client may take to close its side after the last response, so that it can read it.
const LINGER: Duration = Duration::from_secs(1);
/// How long to wait if the system has no file descriptor left for a connection.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

pub(in crate::server) struct BoundedListener {
    inner: TcpListener,
    table: Arc<ConnectionTable>,
    refusing: Arc<Semaphore>,
    write_stall: Duration,
}

impl BoundedListener {
    /// `total` and `per_address`: how many connections have a place at the same time.
    pub(in crate::server) fn new(inner: TcpListener, config: &ServerConfig, total: usize, per_address: usize) -> Self {
        let limits = ConnectionLimits {
            total,
            per_address,
            evict_after: Duration::from_millis(config.connection_evict_ms),
        };
        Self {
            inner,
            table: Arc::new(ConnectionTable::new(limits)),
            refusing: Arc::new(Semaphore::new(MAX_REFUSING)),
            write_stall: Duration::from_millis(config.write_stall_ms),
        }
    }

    /// The next connection that has a place. Nothing is lost when the future is dropped.
    pub(in crate::server) async fn accept(&self) -> BoundedConnection {
        loop {
            let (stream, peer) = match self.inner.accept().await {
                Ok(accepted) => accepted,
                Err(error) => {
                    pause_after(&error).await;
                    continue;
                }
            };
            // Responses are small and clients wait for them: do not delay them to fill a packet.
            if let Err(error) = stream.set_nodelay(true) {
                warn!(%error, "could not set TCP_NODELAY");
            }
            match self.table.admit(peer.ip(), Instant::now()) {
                Some(place) => return BoundedConnection::new(stream, place, self.write_stall),
                None => self.refuse(stream),
            }
        }
    }

    fn refuse(&self, stream: TcpStream) {
        warn!("too many connections: refused one");
        counter!(metric_names::HTTP_CONNECTIONS_REFUSED).increment(1);
        if let Ok(place) = Arc::clone(&self.refusing).try_acquire_owned() {
            tokio::spawn(async move {
                // A client that is gone or slow gets no more time.
                let _ = tokio::time::timeout(LINGER, refuse_and_close(stream)).await;
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
        warn!(%error, "could not accept a connection");
        tokio::time::sleep(ACCEPT_PAUSE).await;
    }
}

async fn refuse_and_close(mut stream: TcpStream) -> io::Result<()> {
    let (status, detail) = (StatusCode::SERVICE_UNAVAILABLE, "too many connections; try again later");
    stream.write_all(&last_response(status, "unavailable", detail)).await?;
    close_gently(stream).await
}

/// Closes the writing side, and discards input until the client closes too. Closing with unread input would reset the
/// connection before the client has read the response.
async fn close_gently(mut stream: TcpStream) -> io::Result<()> {
    stream.shutdown().await?;
    tokio::io::copy(&mut stream, &mut tokio::io::sink()).await.map(drop)
}

/// A connection that holds its place until it has ended, and fails if its client reads nothing for too long. After it is
/// dropped, the client still has time to read the last response.
pub(in crate::server) struct BoundedConnection {
    /// `None` after the drop.
    stream: Option<TcpStream>,
    pub(super) place: Arc<ConnectionPlace>,
    write_stall: Duration,
    stalled: Option<Pin<Box<Sleep>>>,
}

impl BoundedConnection {
    fn new(stream: TcpStream, place: Arc<ConnectionPlace>, write_stall: Duration) -> Self {
        gauge!(metric_names::HTTP_CONNECTIONS).increment(1.0);
        Self {
            stream: Some(stream),
            place,
            write_stall,
            stalled: None,
        }
    }

    /// The first byte that has arrived and is still to be read; `None` at the end.
    #[cfg(feature = "tls")]
    pub(super) async fn peek(&self) -> io::Result<Option<u8>> {
        let stream = self.stream.as_ref().ok_or(io::ErrorKind::NotConnected)?;
        let mut byte = [0];
        Ok((stream.peek(&mut byte).await? > 0).then_some(byte[0]))
    }

    fn stream(&mut self) -> io::Result<Pin<&mut TcpStream>> {
        Ok(Pin::new(self.stream.as_mut().ok_or(io::ErrorKind::NotConnected)?))
    }

    /// Passes on the result of a write. A write that makes no progress fails after the limit.
    fn limit_stall<T>(&mut self, cx: &mut Context<'_>, written: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        if written.is_ready() {
            self.stalled = None;
            return written;
        }
        let limit = self.write_stall;
        let sleep = self.stalled.get_or_insert_with(|| Box::pin(tokio::time::sleep(limit)));
        let late = || io::Error::new(io::ErrorKind::TimedOut, "the client does not read");
        sleep.as_mut().poll(cx).map(|()| Err(late()))
    }
}

impl Drop for BoundedConnection {
    fn drop(&mut self) {
        gauge!(metric_names::HTTP_CONNECTIONS).decrement(1.0);
        let place = Arc::clone(&self.place);
        // Without a runtime, the connection is closed at once.
        if !place.is_evicted()
            && let (Some(stream), Ok(runtime)) = (self.stream.take(), Handle::try_current())
        {
            runtime.spawn(async move {
                let _ = tokio::time::timeout(LINGER, close_gently(stream)).await;
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
        self.limit_stall(cx, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = self.stream()?.poll_write_vectored(cx, bytes);
        self.limit_stall(cx, written)
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
