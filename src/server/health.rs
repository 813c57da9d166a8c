//! Whether the server lives and whether it is ready.

use axum::extract::State;
use serde::Serialize;

use super::App;
use super::error::{ApiError, Problem};

/// A sign of life.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Health {
    /// `alive` or `ready`.
    status: &'static str,
}

/// Says that the server lives.
#[utoipa::path(get, path = "/livez", tag = "health", responses((status = 200, body = Health)))]
pub(super) async fn livez() -> axum::Json<Health> {
    axum::Json(Health { status: "alive" })
}

/// Says whether every model has made its first prediction and the server is not stopping.
#[utoipa::path(
    get, path = "/readyz", tag = "health",
    responses((status = 200, body = Health), (status = 503, description = "Not ready", body = Problem))
)]
pub(super) async fn readyz(State(app): State<App>) -> Result<axum::Json<Health>, ApiError> {
    if app.is_draining() {
        return Err(ApiError::unavailable("the server is stopping"));
    }
    if let Err(error) = app.store().check_writable().await {
        return Err(ApiError::unavailable(format!("the store cannot be written: {error}")));
    }
    if !app.predictor().is_ready() {
        return Err(ApiError::unavailable("the models are warming up"));
    }
    Ok(axum::Json(Health { status: "ready" }))
}
