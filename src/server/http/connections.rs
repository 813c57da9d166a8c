//! Open connections, one task each, so that the server can ask all to end, wait for them, and cut them off.

use std::convert::Infallible;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes, HttpBody};
use axum::http::{Request, StatusCode};
use axum::response::Response;
use hyper::body::{Frame, Incoming, SizeHint};
use hyper::server::conn::http1;
use hyper::service::Service;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::debug;

use super::connection_table::{BusyConnection, ConnectionPlace};
use super::http_stream::HttpStream;
use super::listener::{BoundedConnection, BoundedListener};
use super::message_bytes::MessageBytes;
use super::task_limit::stop_requested;
use super::tls::ServerTls;
use crate::server::config::ServerConfig;

/// The open connections. Dropping this cuts them off. After an upgrade, a connection belongs to its stream's task.
pub(in crate::server) struct Connections {
    tasks: JoinSet<()>,
    handler: ConnectionHandler,
}

impl Connections {
    pub(in crate::server) fn new(router: Router, config: &ServerConfig, stopping: watch::Receiver<bool>) -> Self {
        let mut http = http1::Builder::new();
        http.timer(TokioTimer::new())
            .header_read_timeout(Duration::from_millis(config.header_read_ms))
            .max_header_size(config.max_header_bytes);
        let handler = ConnectionHandler {
            http,
            router,
            stopping,
            tls: None,
            handshake_limit: Duration::from_millis(config.header_read_ms),
        };
        Self {
            tasks: JoinSet::new(),
            handler,
        }
    }

    /// The same with TLS, if there is one.
    pub(in crate::server) fn with_tls(mut self, tls: Option<ServerTls>) -> Self {
        self.handler.tls = tls;
        self
    }

    /// Accepts connections until the future is dropped.
    pub(in crate::server) async fn accept(&mut self, listener: &BoundedListener) -> Infallible {
        loop {
            tokio::select! {
                connection = listener.accept() => {
                    self.tasks.spawn(self.handler.clone().run(connection));
                }
                // Removes tasks that have ended, so that the set holds only the open connections.
                Some(_) = self.tasks.join_next() => {}
            }
        }
    }

    /// Waits until every connection has ended.
    pub(in crate::server) async fn ended(&mut self) {
        while self.tasks.join_next().await.is_some() {}
    }
}

/// What a connection is answered with.
#[derive(Clone)]
struct ConnectionHandler {
    http: http1::Builder,
    router: Router,
    stopping: watch::Receiver<bool>,
    tls: Option<ServerTls>,
    #[cfg_attr(not(feature = "tls"), expect(dead_code, reason = "only TLS has handshakes"))]
    handshake_limit: Duration,
}

impl ConnectionHandler {
    async fn run(self, connection: BoundedConnection) {
        let Some(place) = connection.place() else { return };
        match self.tls.clone() {
            None => self.answer(connection, place).await,
            #[cfg(feature = "tls")]
            Some(tls) => {
                if let Some(encrypted) = self.encrypt(&tls, connection, &place).await {
                    self.answer(encrypted, place).await;
                }
            }
            #[cfg(not(feature = "tls"))]
            Some(tls) => match tls.never() {},
        }
    }

    /// The connection after its TLS handshake, unless that fails, takes too long, or the server stops.
    #[cfg(feature = "tls")]
    async fn encrypt(
        &self,
        tls: &ServerTls,
        connection: BoundedConnection,
        place: &ConnectionPlace,
    ) -> Option<impl AsyncRead + AsyncWrite + Send + Unpin + 'static> {
        let mut stopping = self.stopping.clone();
        let accepted = tokio::time::timeout(self.handshake_limit, tls.acceptor().accept(connection));
        let accepted = tokio::select! {
            accepted = accepted => accepted,
            () = place.evicted() => return None,
            () = stop_requested(&mut stopping) => return None,
        };
        match accepted {
            Ok(Ok(encrypted)) => Some(encrypted),
            Ok(Err(error)) => {
                debug!(%error, "TLS handshake failed");
                None
            }
            Err(_) => {
                debug!("TLS handshake took too long");
                None
            }
        }
    }

    /// Answers a connection's requests. After the stop signal, it answers only requests that have arrived.
    ///
    /// `hyper_util`'s `GracefulShutdown` does not serve here: it does not support upgrades of HTTP/1 connections, and it
    /// closes an idle connection before it reads a request that has already arrived.
    async fn answer<S>(mut self, stream: S, place: Arc<ConnectionPlace>)
    where
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        let (evicted, messages) = (place.evicted(), MessageBytes::default());
        let stream = TokioIo::new(HttpStream::new(stream, messages.clone()));
        let router = TowerToHyperService::new(self.router);
        let service = BusyService {
            router,
            place,
            messages,
        };
        let mut connection = pin!(self.http.serve_connection(stream, service).with_upgrades());
        let result = tokio::select! {
            // The connection first: it reads what has arrived before an idle connection is closed.
            biased;
            result = connection.as_mut() => result,
            // Another connection has its place now.
            () = evicted => return,
            () = stop_requested(&mut self.stopping) => {
                connection.as_mut().graceful_shutdown();
                connection.await
            }
        };
        if let Err(error) = result {
            debug!(%error, "connection failed");
        }
    }
}

/// Answers requests, and marks the connection as busy until the response was sent.
struct BusyService {
    router: TowerToHyperService<Router>,
    place: Arc<ConnectionPlace>,
    messages: MessageBytes,
}

impl Service<Request<Incoming>> for BusyService {
    type Response = Response;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<Response, Infallible>> + Send>>;

    fn call(&self, mut request: Request<Incoming>) -> Self::Future {
        let busy = self.place.begin();
        request.extensions_mut().insert(self.messages.clone());
        let answered = self.router.call(request);
        Box::pin(async move {
            let response = answered.await?;
            if response.status() == StatusCode::SWITCHING_PROTOCOLS {
                busy.keep();
                return Ok(response);
            }
            Ok(response.map(|body| Body::new(BusyBody { body, _busy: busy })))
        })
    }
}

/// A response body; the connection is busy as long as it exists.
struct BusyBody {
    body: Body,
    _busy: BusyConnection,
}

impl HttpBody for BusyBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(cx)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
