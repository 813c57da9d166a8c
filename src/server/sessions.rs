//! Sessions: a stream's memory, which outlives its socket, and can be taken to another server.

pub(super) mod core;
pub(super) mod session;
pub(super) mod table;
pub(super) mod token;
mod wire;

use std::sync::Arc;
use std::time::Instant;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::IntoResponse;
use serde::Deserialize;

use self::core::Settings;
use self::session::Session;
use self::wire::{CreateSession, CreatedSession, ExportedState, SessionDescription, SessionList};
use super::error::{ApiError, Problem};
use super::extract::{Json, Path, Query};
use super::page::Page;
use super::protocol::StreamLimits;
use super::{App, ServerConfig};
use crate::registry::LoadedModel;
use crate::serving::SessionState;

/// Opens a session, or goes on with one from its exported state.
#[utoipa::path(
    post, path = "/v1/sessions", tag = "sessions", request_body = CreateSession,
    responses(
        (status = 201, description = "Open; the token is said only here", body = CreatedSession),
        (status = 400, description = "Not JSON", body = Problem),
        (status = 404, description = "No such model", body = Problem),
        (status = 409, description = "The state is of a version of the model that is not active here", body = Problem),
        (status = 422, description = "A state that does not fit; names the field", body = Problem),
        (status = 503, description = "Too many sessions", body = Problem),
    )
)]
pub(super) async fn create(
    State(app): State<App>,
    Json(request): Json<CreateSession>,
) -> Result<impl IntoResponse, ApiError> {
    let (model, state, settings) = request.resolve(&app)?;
    let now = Instant::now();
    let (session, token) = new_session(model, state, settings, now)?;
    let session = app.sessions().insert(session, now)?;
    let created = CreatedSession {
        session: SessionDescription::of(&session, app.sessions().grace(), now),
        token,
        limits: limits(app.config(), true),
    };
    let location = format!("/v1/sessions/{}", created.session.id);
    Ok((StatusCode::CREATED, [(header::LOCATION, location)], axum::Json(created)))
}

/// Lists the open sessions.
#[utoipa::path(
    get, path = "/v1/sessions", tag = "sessions", params(Page),
    responses((status = 200, body = SessionList), (status = 422, description = "A limit out of range", body = Problem))
)]
pub(super) async fn list(
    State(app): State<App>,
    Query(page): Query<Page>,
) -> Result<axum::Json<SessionList>, ApiError> {
    let now = Instant::now();
    let found = app.sessions().page(&page.after, page.limit()? + 1, now);
    let (found, next) = page.of(found, |session| session.id())?;
    let grace = app.sessions().grace();
    let describe = |session: &Arc<Session>| SessionDescription::of(session, grace, now);
    Ok(axum::Json(SessionList {
        sessions: found.iter().map(describe).collect(),
        next,
    }))
}

/// Describes a session.
#[utoipa::path(
    get, path = "/v1/sessions/{id}", tag = "sessions",
    params(("id" = String, Path, description = "The session's id")),
    responses(
        (status = 200, body = SessionDescription),
        (status = 404, description = "No such session", body = Problem),
        (status = 410, description = "It has expired", body = Problem),
    )
)]
pub(super) async fn get(
    State(app): State<App>,
    Path(id): Path<String>,
) -> Result<axum::Json<SessionDescription>, ApiError> {
    let now = Instant::now();
    let session = app.sessions().get(&id, now)?;
    Ok(axum::Json(SessionDescription::of(
        &session,
        app.sessions().grace(),
        now,
    )))
}

/// Ends a session and its stream.
#[utoipa::path(
    delete, path = "/v1/sessions/{id}", tag = "sessions",
    params(
        ("id" = String, Path, description = "The session's id"),
        ("x-session-token" = Option<String>, Header, description = "The session's token; or as query parameter `token`"),
    ),
    responses(
        (status = 204, description = "Ended"),
        (status = 403, description = "Not its token", body = Problem),
        (status = 404, description = "No such session", body = Problem),
        (status = 410, description = "It has expired", body = Problem),
    )
)]
pub(super) async fn delete(State(app): State<App>, session: AuthorizedSession) -> StatusCode {
    app.sessions().remove(&session.0);
    StatusCode::NO_CONTENT
}

/// Exports what a session remembers, for `POST /v1/sessions` here or on another server.
#[utoipa::path(
    get, path = "/v1/sessions/{id}/state", tag = "sessions",
    params(
        ("id" = String, Path, description = "The session's id"),
        ("x-session-token" = Option<String>, Header, description = "The session's token; or as query parameter `token`"),
    ),
    responses(
        (status = 200, body = ExportedState),
        (status = 403, description = "Not its token", body = Problem),
        (status = 404, description = "No such session", body = Problem),
        (status = 410, description = "It has expired", body = Problem),
    )
)]
pub(super) async fn state(session: AuthorizedSession) -> axum::Json<ExportedState> {
    let (state, settings) = session.0.state();
    let manifest = &session.0.model().manifest;
    axum::Json(ExportedState {
        model: manifest.name.clone(),
        version: manifest.version,
        weights_sha256: manifest.weights_sha256.clone(),
        on_gap: settings.on_gap,
        on_late: settings.on_late,
        format: settings.format,
        memory: state.memory(),
    })
}

/// The token, where it is no header.
#[derive(Debug, Deserialize)]
pub(super) struct TokenQuery {
    #[serde(default)]
    token: Option<String>,
}

/// The session in the path, for who has its token.
pub(super) struct AuthorizedSession(pub(super) Arc<Session>);

impl axum::extract::FromRequestParts<App> for AuthorizedSession {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut axum::http::request::Parts, app: &App) -> Result<Self, ApiError> {
        let Path(id) = Path::<String>::from_request_parts(parts, app).await?;
        let Query(query) = Query::<TokenQuery>::from_request_parts(parts, app).await?;
        let token = token_of(&parts.headers).or(query.token).unwrap_or_default();
        Ok(Self(app.sessions().open(&id, &token, Instant::now())?))
    }
}

fn token_of(headers: &HeaderMap) -> Option<String> {
    let token = headers.get("x-session-token")?;
    token.to_str().ok().map(str::to_owned)
}

/// A session with its token's text.
pub(super) fn new_session(
    model: Arc<LoadedModel>,
    state: SessionState,
    settings: Settings,
    now: Instant,
) -> Result<(Session, String), ApiError> {
    let (session, token) =
        Session::new(model, state, settings, now).map_err(|error| ApiError::Internal(error.to_string()))?;
    Ok((session, token.text()))
}

/// The bounds of a stream, of a session that outlives it or not.
pub(super) fn limits(config: &ServerConfig, is_kept: bool) -> StreamLimits {
    StreamLimits {
        message_bytes: config.max_body_bytes,
        pipelined_frames: config.max_pipelined_frames,
        buffered_bytes: config.max_stream_buffer_bytes,
        idle_ms: config.stream_idle_ms,
        grace_ms: if is_kept { config.session_grace_ms } else { 0 },
    }
}
