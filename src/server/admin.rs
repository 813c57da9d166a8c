//! Health checks and metrics on a listener of their own, whose connections the public cannot use up.

use std::sync::Arc;

use axum::Router;
use axum::extract::State;
use axum::http::header;
use axum::middleware::from_fn_with_state;
use axum::response::IntoResponse;
use axum::routing::get;
use tokio::net::TcpListener;
use tokio::sync::watch;

use super::config::ServerConfig;
use super::http::connections::Connections;
use super::http::keys::Keys;
use super::http::listener::BoundedListener;
use super::http::middleware::{self, RequestTrace};
use super::http::origin::{self, OriginPolicy};
use super::http::problem::ApiError;
use super::routes::{health, metrics};
use super::state::App;
use foreframe_jobs::store::Store;

/// What the handlers of a worker share.
#[derive(Clone)]
struct WorkerHealth {
    store: Store,
    is_stopping: watch::Receiver<bool>,
}

/// The health checks and metrics of a server.
pub(super) fn server_router(app: &App) -> Router {
    let routes = health::routes().merge(metrics::routes());
    let routes = Router::from(routes).with_state(app.clone());
    finish(routes, app.config(), app.keys.clone())
}

/// Answers `/livez`, `/readyz` and `/metrics` of a worker until it is dropped. `is_stopping`: the worker is not ready any
/// more. To be called within a tokio runtime.
pub async fn serve_worker_health(
    listener: TcpListener,
    config: &ServerConfig,
    store: Store,
    is_stopping: watch::Receiver<bool>,
) {
    let routes = Router::new()
        .route("/livez", get(health::livez))
        .route("/readyz", get(worker_readyz))
        .route("/metrics", get(worker_metrics))
        .with_state(WorkerHealth { store, is_stopping });
    answer(listener, finish(routes, config, Keys::none()), config).await;
}

/// Answers on the listener until the future is dropped.
pub(super) async fn answer(listener: TcpListener, router: Router, config: &ServerConfig) {
    let (_running, stopping) = watch::channel(false);
    let places = config.max_admin_connections;
    let listener = BoundedListener::new(listener, config, places, places);
    let mut connections = Connections::new(router, config, stopping, None);
    match connections.accept(&listener).await {}
}

fn finish(router: Router, config: &ServerConfig, keys: Keys) -> Router {
    let origins = OriginPolicy::new(config, keys);
    let trace = RequestTrace::new(config, Arc::default());
    router
        .method_not_allowed_fallback(async || ApiError::MethodNotAllowed)
        .fallback(async || ApiError::NotFound("there are /livez, /readyz and /metrics".to_owned()))
        .layer(from_fn_with_state(origins, origin::check))
        .layer(from_fn_with_state(trace, middleware::trace))
}

async fn worker_readyz(State(worker): State<WorkerHealth>) -> Result<impl IntoResponse, ApiError> {
    if *worker.is_stopping.borrow() {
        return Err(ApiError::unavailable("the worker is stopping"));
    }
    health::worker_ready(&worker.store).await
}

async fn worker_metrics(State(worker): State<WorkerHealth>) -> impl IntoResponse {
    let text = metrics::text(&worker.store).await;
    ([(header::CONTENT_TYPE, metrics::TEXT_FORMAT)], text)
}
