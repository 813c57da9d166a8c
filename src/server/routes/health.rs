//! Whether the server is alive and whether it is ready.

use std::sync::atomic::Ordering;

use serde::Serialize;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::server::http::problem::ApiError;
use crate::server::state::App;
use foreframe_jobs::store::Store;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(livez)).routes(routes!(readyz))
}

/// The state of the server.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(in crate::server) struct Health {
    /// `alive` or `ready`.
    status: &'static str,
}

/// Tells whether the server is alive.
#[utoipa::path(get, path = "/livez", tag = "health", responses((status = 200, body = Health)))]
pub(in crate::server) async fn livez() -> axum::Json<Health> {
    axum::Json(Health { status: "alive" })
}

/// Tells whether the server is ready: every model has made its first prediction, and the server is not stopping.
#[utoipa::path(
    get, path = "/readyz", tag = "health",
    responses((status = 200, body = Health), (status = 503, description = "Not ready"))
)]
async fn readyz(app: App) -> Result<axum::Json<Health>, ApiError> {
    check_predicts(&app)?;
    // Load balancers ask this. The store does not count: predictions and streams go on without it.
    Ok(axum::Json(Health { status: "ready" }))
}

/// Errors: `Unavailable` if the server is stopping, or a model has not made its first prediction yet.
pub(super) fn check_predicts(app: &App) -> Result<(), ApiError> {
    if app.draining.load(Ordering::Acquire) {
        return Err(ApiError::unavailable("the server is stopping"));
    }
    if !app.predictor().is_ready() {
        return Err(ApiError::unavailable("the models are warming up"));
    }
    Ok(())
}

/// Whether the store can be written: then a worker is ready.
pub(in crate::server) async fn worker_ready(store: &Store) -> Result<axum::Json<Health>, ApiError> {
    if let Err(error) = store.check_writable().await {
        return Err(ApiError::unavailable(format!("the store cannot be written: {error}")));
    }
    Ok(axum::Json(Health { status: "ready" }))
}
