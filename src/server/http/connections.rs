//! Open connections, one task each, so that the server can ask all to end, wait for them, and cut them off.

use std::convert::Infallible;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::http::{Request, StatusCode};
use http_body_util::BodyExt as _;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::debug;

use super::connection_table::ConnectionPlace;
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
    /// `stopping`: becomes true when the server stops. `tls`: none for plain HTTP.
    pub(in crate::server) fn new(
        router: Router,
        config: &ServerConfig,
        stopping: watch::Receiver<bool>,
        tls: Option<ServerTls>,
    ) -> Self {
        let mut http = http1::Builder::new();
        http.timer(TokioTimer::new())
            .header_read_timeout(Duration::from_millis(config.header_read_ms))
            .max_header_size(config.max_header_bytes);
        Self {
            tasks: JoinSet::new(),
            handler: ConnectionHandler {
                http,
                router,
                stopping,
                tls,
                handshake_limit: Duration::from_millis(config.header_read_ms),
            },
        }
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
        let place = Arc::clone(&connection.place);
        match self.tls.clone() {
            None => self.answer(connection, place).await,
            #[cfg(feature = "tls")]
            Some(tls) => {
                if let Some(encrypted) = self.encrypt(&tls, connection, &place).await {
                    self.answer(encrypted, place).await;
                }
            }
            #[cfg(not(feature = "tls"))]
            Some(never) => match never.0 {},
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
        let accepted = tokio::time::timeout(self.handshake_limit, tls.0.accept(connection));
        let accepted = tokio::select! {
            accepted = accepted => accepted,
            () = place.evicted() => return None,
            () = stop_requested(&mut stopping) => return None,
        };
        let accepted = accepted.unwrap_or_else(|late| Err(late.into()));
        accepted
            .inspect_err(|error| debug!(%error, "TLS handshake failed"))
            .ok()
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
        let stream = TokioIo::new(HttpStream {
            inner: stream,
            messages: messages.clone(),
        });
        let router = TowerToHyperService::new(self.router);
        let service = service_fn(move |mut request: Request<Incoming>| {
            let busy = place.begin();
            request.extensions_mut().insert(messages.clone());
            let answered = router.call(request);
            async move {
                let response = answered.await?;
                // The connection of a stream is busy until its end, others until the response was sent.
                let busy = match response.status() {
                    StatusCode::SWITCHING_PROTOCOLS => busy.keep(),
                    _ => Some(busy),
                };
                let held_by_body = move |error| {
                    let _ = &busy;
                    error
                };
                Ok::<_, Infallible>(response.map(|body| body.map_err(held_by_body)))
            }
        });
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
