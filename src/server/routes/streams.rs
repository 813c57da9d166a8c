//! Opens streams: of a session that outlives its stream, or of one that ends with it.

use std::sync::Arc;
use std::time::Instant;

use axum::Extension;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::response::Response;
use tokio::sync::OwnedSemaphorePermit;
use tracing::{Instrument, Span};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::sessions::AuthorizedSession;
use crate::server::http::extract::Path;
use crate::server::http::keys::Caller;
use crate::server::http::message_bytes::{MessageBytes, UNCOUNTED_BYTES};
use crate::server::http::problem::ApiError;
use crate::server::state::App;
use crate::server::stream::connection::StreamConnection;
use crate::server::stream::protocol::{Codec, SessionSettings};
use crate::server::stream::session::Session;
use crate::server::stream::socket::StreamServices;
use foreframe_core::serving::SessionState;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(session_stream))
        .routes(routes!(model_stream))
}

/// The read buffer of a socket. It is zeroed before every read, and a stream keeps it while it is open; it grows with the
/// longest message.
const READ_BYTES: usize = UNCOUNTED_BYTES;

/// Whether the request is a WebSocket handshake.
pub(super) type Upgrade = Result<WebSocketUpgrade, WebSocketUpgradeRejection>;
/// Absent for a request that came over no connection; it cannot be upgraded.
pub(super) type Messages = Option<Extension<MessageBytes>>;

/// Opens the stream of a session: a WebSocket that takes frames with action and state, and answers each with the predicted
/// frames. Sub-protocols: `foreframe.v1.json` and `foreframe.v1.msgpack`; `/asyncapi.yaml` describes the messages. If the
/// session has an open stream, the new stream replaces it.
#[utoipa::path(
    get, path = "/v1/sessions/{id}/stream",
    params(("id" = String, Path), ("token" = Option<String>, Query)),
    responses(
        (status = 101, description = "The WebSocket is open"),
        (status = 400, description = "The server speaks none of the requested sub-protocols"),
        (status = 426, description = "Not a WebSocket handshake"),
        (status = 503, description = "Too many streams"),
    )
)]
async fn session_stream(
    app: App,
    caller: Caller,
    messages: Messages,
    session: AuthorizedSession,
    upgrade: Upgrade,
) -> Result<Response, ApiError> {
    let services = services(&app, caller, messages);
    open(&app, services, session.0, true, upgrade)
}

/// Opens a stream whose session ends with it. Otherwise it is the same as the stream of a session.
#[utoipa::path(
    get, path = "/v1/models/{model}/stream",
    responses(
        (status = 101, description = "The WebSocket is open"),
        (status = 400, description = "The server speaks none of the requested sub-protocols"),
        (status = 426, description = "Not a WebSocket handshake"),
        (status = 503, description = "Too many streams"),
    )
)]
async fn model_stream(
    app: App,
    caller: Caller,
    messages: Messages,
    Path(model): Path<String>,
    upgrade: Upgrade,
) -> Result<Response, ApiError> {
    let model = app.predictor().active(&model)?;
    let session = Session::new(
        model,
        SessionState::default(),
        SessionSettings::default(),
        caller,
        Instant::now(),
    );
    let (session, _) = session.map_err(|error| ApiError::Internal(error.to_string()))?;
    let services = services(&app, caller, messages);
    open(&app, services, Arc::new(session), false, upgrade)
}

pub(super) fn services(app: &App, caller: Caller, messages: Messages) -> StreamServices {
    StreamServices {
        config: Arc::clone(&app.config),
        predictor: app.predictor().clone(),
        blocking: app.predictions.clone(),
        admission: app.admission.clone(),
        streams: app.streams.clone(),
        keys: app.keys.clone(),
        caller,
        messages: messages.map(|Extension(messages)| messages).unwrap_or_default(),
    }
}

fn open(
    app: &App,
    services: StreamServices,
    session: Arc<Session>,
    is_persistent: bool,
    upgrade: Upgrade,
) -> Result<Response, ApiError> {
    let upgrade = upgrade.map_err(|_| ApiError::UpgradeRequired)?.protocols(Codec::NAMES);
    let chosen = upgrade
        .selected_protocol()
        .and_then(|name| name.to_str().ok())
        .map(Codec::of);
    if chosen.is_none() && upgrade.requested_protocols().next().is_some() {
        return Err(ApiError::Malformed(format!(
            "the sub-protocols of this server are {}",
            Codec::NAMES.join(" and ")
        )));
    }
    let (place, upgrade) = admit(app, &services, upgrade)?;
    Ok(upgrade.on_upgrade(move |socket| {
        let connection = StreamConnection::new(services, &session, is_persistent, chosen.unwrap_or_default());
        async move {
            connection.run(socket).await;
            drop(place);
        }
        .instrument(Span::current())
    }))
}

/// A place among the streams, and the handshake with the limits of their messages. Errors: `Unavailable`.
pub(super) fn admit(
    app: &App,
    services: &StreamServices,
    upgrade: WebSocketUpgrade,
) -> Result<(OwnedSemaphorePermit, WebSocketUpgrade), ApiError> {
    let place = app.streams.enter()?;
    let limit = app.config().max_body_bytes;
    services.messages.begin(&app.body_budget);
    let upgrade = upgrade
        .max_message_size(limit)
        .max_frame_size(limit)
        .read_buffer_size(READ_BYTES);
    Ok((place, upgrade))
}
