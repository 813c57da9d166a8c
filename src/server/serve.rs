//! The life of a server: it accepts connections, drains, and stops within a deadline.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use tokio::net::TcpListener;
use tokio::time::{timeout, timeout_at};
use tracing::{info, warn};

use super::admin;
use super::http::connections::Connections;
use super::http::listener::BoundedListener;
use super::http::tls::ServerTls;
use super::router::router;
use super::routes::metrics;
use super::state::App;

/// How long [`serve`] may take past the deadline to report what did not end.
const GRACE: Duration = Duration::from_millis(200);

/// Where a server listens.
#[derive(Debug)]
pub struct ServerListeners {
    /// For everything.
    pub public: TcpListener,
    /// For `/livez`, `/readyz` and `/metrics`, with connections of its own.
    pub admin: Option<TcpListener>,
}

impl From<TcpListener> for ServerListeners {
    fn from(public: TcpListener) -> Self {
        Self { public, admin: None }
    }
}

/// Answers on the listeners until `shutdown` completes. Then it reports that it is not ready, but accepts requests for
/// another `drain_ms`. After that it accepts no connections, answers the requests it has, closes every stream with code
/// 1001, lets the running job write its checkpoint, and returns when all have ended or the deadline has passed.
pub async fn serve(listeners: impl Into<ServerListeners>, app: App, shutdown: impl Future<Output = ()>) {
    let ServerListeners { public, admin } = listeners.into();
    // Until the end, also while the server stops.
    let admin = admin.map(|listener| {
        let app = app.clone();
        tokio::spawn(async move { admin::answer(listener, admin::server_router(&app), app.config()).await })
    });
    serve_public(public, app, shutdown).await;
    if let Some(admin) = admin {
        admin.abort();
    }
}

async fn serve_public(listener: TcpListener, app: App, shutdown: impl Future<Output = ()>) {
    let config = app.config();
    let limit = Duration::from_millis(config.shutdown_deadline_ms);
    let drain = Duration::from_millis(config.drain_ms);
    let (total, per_address) = (config.max_connections, config.max_connections_per_address);
    let listener = BoundedListener::new(listener, config, total, per_address);
    let stopping = app.streams.stopping();
    let mut connections = Connections::new(router(app.clone()), config, stopping, app.tls.clone());
    tokio::select! {
        never = connections.accept(&listener) => match never {},
        never = metrics::keep_folded() => match never {},
        never = ServerTls::keep_fresh(app.tls.as_ref()) => match never {},
        never = app.keys.keep_fresh(Duration::from_millis(config.key_refresh_ms)) => match never {},
        () = shutdown => {}
    }
    info!("stopping");
    let deadline = Instant::now() + limit;
    app.draining.store(true, Ordering::Release);
    app.jobs().begin_stop();
    // Even without time to drain, established connections are accepted: their clients wait for an answer.
    let Err(_) = timeout(drain, connections.accept(&listener)).await;
    drop(listener);
    app.streams.stop();
    app.event_streams.stop();
    let answered = async {
        connections.ended().await;
        tokio::join!(app.requests.ended(), app.streams.ended(), app.event_streams.ended())
    };
    if timeout_at(deadline.into(), answered).await.is_err() {
        warn!("some requests or streams did not end within the deadline");
    }
    let ended = async {
        let jobs_ended = app.jobs().finish_stop(deadline).await;
        let predictor = app.predictor().clone();
        jobs_ended && app.blocking.run(move || predictor.stop()).await.is_ok()
    };
    if timeout_at((deadline + GRACE).into(), ended).await == Ok(true) {
        info!("stopped");
    } else {
        warn!("a computation did not end within the deadline");
    }
}
