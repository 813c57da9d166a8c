//! Connections, each on a task that is known: so that all can be told to end, be waited for, and be cut off.

use std::convert::Infallible;
use std::pin::pin;
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::debug;

use super::listener::{BoundedConnection, BoundedListener};
use super::{App, router, streams};

/// The open connections; dropping them cuts them off. One that became a stream belongs to the stream's task.
pub(super) struct Connections {
    tasks: JoinSet<()>,
    http: http1::Builder,
    router: Router,
    stopping: watch::Receiver<bool>,
}

impl Connections {
    pub(super) fn new(app: &App) -> Self {
        let config = app.config();
        let mut http = http1::Builder::new();
        http.timer(TokioTimer::new())
            .header_read_timeout(Duration::from_millis(config.header_read_ms))
            .max_header_size(config.max_header_bytes);
        Self {
            tasks: JoinSet::new(),
            http,
            router: router(app.clone()),
            stopping: app.streams().stopping(),
        }
    }

    /// Takes connections until it is dropped.
    pub(super) async fn accept(&mut self, listener: &BoundedListener) -> Infallible {
        loop {
            tokio::select! {
                connection = listener.accept() => {
                    self.tasks.spawn(answer(connection, self.http.clone(), self.router.clone(), self.stopping.clone()));
                }
                // Ended tasks are forgotten, so that their number is that of the open connections.
                Some(_) = self.tasks.join_next() => {}
            }
        }
    }

    /// Waits until every connection has ended.
    pub(super) async fn ended(&mut self) {
        while self.tasks.join_next().await.is_some() {}
    }
}

/// Answers a connection's requests; once told to stop, those that have been read.
async fn answer(
    connection: BoundedConnection,
    http: http1::Builder,
    router: Router,
    mut stopping: watch::Receiver<bool>,
) {
    let service = TowerToHyperService::new(router);
    let mut connection = pin!(http.serve_connection(TokioIo::new(connection), service).with_upgrades());
    let result = tokio::select! {
        // First: what has arrived is read before an idle connection is closed.
        biased;
        result = connection.as_mut() => result,
        () = streams::told(&mut stopping) => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = result {
        debug!(%error, "connection failed");
    }
}
