//! What HTTP reads from and writes to a connection, with or without TLS.
//!
//! hyper itself answers what it cannot parse, without a body, and lets nobody else do it: the bytes that it writes are the only
//! place where such a 400 can become problem details like all other errors.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use super::message_bytes::MessageBytes;
use super::problem;

/// Counts what is read, and replaces the responses that hyper writes itself by problem details.
pub(super) struct HttpStream<S> {
    pub(super) inner: S,
    pub(super) messages: MessageBytes,
}

impl<S: AsyncRead + Unpin> AsyncRead for HttpStream<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let filled = buffer.filled().len();
        ready!(Pin::new(&mut self.inner).poll_read(cx, buffer))?;
        Poll::Ready(self.messages.add(buffer.filled().len() - filled))
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for HttpStream<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let Some(refusal) = problem::unreadable_request(bytes) else {
            return Pin::new(&mut self.inner).poll_write(cx, bytes);
        };
        // It is short and the last response, so one write is enough.
        let written = Pin::new(&mut self.inner).poll_write(cx, &refusal);
        written.map_ok(|_| bytes.len())
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        if let [bytes] = bytes {
            return self.poll_write(cx, bytes);
        }
        Pin::new(&mut self.inner).poll_write_vectored(cx, bytes)
    }

    fn is_write_vectored(&self) -> bool {
        self.inner.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_shutdown(cx)
    }
}
