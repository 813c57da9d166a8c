//! Opens streams: of a session that outlives its socket, or of one that ends with it.

mod connection;
mod outbox;

use std::sync::Arc;
use std::time::Instant;

use axum::extract::State;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::response::Response;
use tracing::{Instrument, Span};

use super::App;
use super::error::{ApiError, Problem};
use super::extract::Path;
use super::protocol::Codec;
use super::sessions::core::Settings;
use super::sessions::session::Session;
use super::sessions::{self, AuthorizedSession};
use crate::serving::SessionState;
use connection::StreamConnection;

/// What is read of a socket at once, in bytes. Before every read as much is zeroed, and a stream holds it as long as it is
/// open; a longer message has its own room.
const READ_BYTES: usize = 16 << 10;

type Upgrade = Result<WebSocketUpgrade, WebSocketUpgradeRejection>;

/// Opens the stream of a session: a WebSocket that takes frames with action and state and answers each with the frames to
/// come. Sub-protocols `foreframe.v1.json` and `foreframe.v1.msgpack`; `/asyncapi.yaml` has the messages. A stream
/// that is open already is closed: the newer one holds the session.
#[utoipa::path(
    get, path = "/v1/sessions/{id}/stream", tag = "sessions",
    params(
        ("id" = String, Path, description = "The session's id"),
        ("token" = Option<String>, Query, description = "The session's token; or as header `x-session-token`"),
    ),
    responses(
        (status = 101, description = "The WebSocket is open"),
        (status = 400, description = "None of the sub-protocols asked for is spoken here", body = Problem),
        (status = 403, description = "Not its token", body = Problem),
        (status = 404, description = "No such session", body = Problem),
        (status = 410, description = "It has expired", body = Problem),
        (status = 426, description = "Not a WebSocket handshake", body = Problem),
        (status = 503, description = "Too many streams", body = Problem),
    )
)]
pub(super) async fn of_session(
    State(app): State<App>,
    session: AuthorizedSession,
    upgrade: Upgrade,
) -> Result<Response, ApiError> {
    open(app, session.0, true, upgrade)
}

/// Opens a stream of a session that ends with it, as of a session's stream otherwise.
#[utoipa::path(
    get, path = "/v1/models/{model}/stream", tag = "models",
    params(("model" = String, Path, description = "The model's name")),
    responses(
        (status = 101, description = "The WebSocket is open"),
        (status = 400, description = "None of the sub-protocols asked for is spoken here", body = Problem),
        (status = 404, description = "No such model", body = Problem),
        (status = 426, description = "Not a WebSocket handshake", body = Problem),
        (status = 503, description = "Too many streams", body = Problem),
    )
)]
pub(super) async fn of_model(
    State(app): State<App>,
    Path(model): Path<String>,
    upgrade: Upgrade,
) -> Result<Response, ApiError> {
    let model = app.predictor().active(&model)?;
    let (session, _) = sessions::new_session(model, SessionState::default(), Settings::default(), Instant::now())?;
    open(app, Arc::new(session), false, upgrade)
}

fn open(app: App, session: Arc<Session>, is_kept: bool, upgrade: Upgrade) -> Result<Response, ApiError> {
    let upgrade = upgrade.map_err(|_| ApiError::UpgradeRequired)?.protocols(Codec::NAMES);
    let chosen = upgrade
        .selected_protocol()
        .and_then(|name| name.to_str().ok())
        .map(Codec::of);
    if chosen.is_none() && upgrade.requested_protocols().next().is_some() {
        return Err(ApiError::Malformed(format!(
            "the sub-protocols spoken here are {}",
            Codec::NAMES.join(" and ")
        )));
    }
    let place = app.streams().enter()?;
    let limit = app.config().max_body_bytes;
    let upgrade = upgrade
        .max_message_size(limit)
        .max_frame_size(limit)
        .read_buffer_size(READ_BYTES);
    Ok(upgrade.on_upgrade(move |socket| {
        let connection = StreamConnection::new(app, &session, is_kept, chosen.unwrap_or_default());
        async move {
            connection.run(socket).await;
            drop(place);
        }
        .instrument(Span::current())
    }))
}
