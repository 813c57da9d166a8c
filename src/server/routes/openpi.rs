//! Opens the sockets of openpi's clients: at `/`, where its client connects, and at a path with the model's name.

use std::sync::Arc;

use axum::extract::ws::WebSocketUpgrade;
use axum::http::HeaderMap;
use axum::response::Response;
use tracing::{Instrument, Span, info};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::streams::{self, Messages, Upgrade};
use crate::server::http::extract::Path;
use crate::server::http::keys::Caller;
use crate::server::http::problem::ApiError;
use crate::server::openpi::{OpenpiConnection, best_model};
use crate::server::state::App;
use crate::server::stream::request_socket::answer_all;
use foreframe_core::registry::Model;
use foreframe_jobs::store::KeyScope;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(model_openpi))
}

/// Opens a WebSocket for clients of openpi (`openpi_client.websocket_client_policy`): each observation is answered with the
/// predicted frames. `/asyncapi.yaml` describes the messages. The same protocol is at `/`, with the best model.
#[utoipa::path(
    get, path = "/v1/models/{model}/openpi",
    responses(
        (status = 101, description = "The WebSocket is open"),
        (status = 426, description = "Not a WebSocket handshake"),
        (status = 503, description = "Too many streams"),
    )
)]
async fn model_openpi(
    app: App,
    caller: Caller,
    messages: Messages,
    Path(model): Path<String>,
    upgrade: Upgrade,
) -> Result<Response, ApiError> {
    let model = app.predictor().active(&model)?;
    let upgrade = upgrade.map_err(|_| ApiError::UpgradeRequired)?;
    open(&app, caller, messages, model, upgrade)
}

/// Opens the socket at `/`, which is a page without authentication for everybody else.
pub(super) fn open_at_root(
    app: &App,
    headers: &HeaderMap,
    messages: Messages,
    upgrade: WebSocketUpgrade,
) -> Result<Response, ApiError> {
    let (caller, _) = app.keys.admit(headers, KeyScope::Predict)?;
    let manifests = app.predictor().models();
    let best = best_model(&manifests).ok_or_else(|| ApiError::NotFound(app.no_model_advice().unwrap_or_default()))?;
    let model = app.predictor().active(best.name.as_str())?;
    open(app, caller, messages, model, upgrade)
}

fn open(
    app: &App,
    caller: Caller,
    messages: Messages,
    model: Arc<Model>,
    upgrade: WebSocketUpgrade,
) -> Result<Response, ApiError> {
    let services = Arc::new(streams::services(app, caller, messages));
    let (place, upgrade) = streams::admit(app, &services, upgrade)?;
    info!(model.id = %model.manifest.name, "openpi socket opened");
    let connection = OpenpiConnection::new(Arc::clone(&services), model)?;
    Ok(upgrade.on_upgrade(move |socket| {
        async move {
            answer_all(socket, &services, connection).await;
            drop(place);
        }
        .instrument(Span::current())
    }))
}
