//! Sessions: the state of a stream, which outlives its socket and can move to another server.

mod bodies;

use std::sync::Arc;
use std::time::Instant;

use axum::http::{HeaderMap, StatusCode, header};
use axum::response::IntoResponse;
use serde::Deserialize;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use self::bodies::{CreateSession, CreatedSession, ExportedState, SessionDescription, SessionList};
use crate::server::http::extract::{Json, Path, Query};
use crate::server::http::keys::Caller;
use crate::server::http::page::Page;
use crate::server::http::problem::ApiError;
use crate::server::state::App;
use crate::server::stream::protocol::StreamLimits;
use crate::server::stream::session::Session;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(create, list))
        .routes(routes!(get, delete))
        .routes(routes!(state))
}

/// Opens a session, or continues one from its exported state.
#[utoipa::path(
    post, path = "/v1/sessions",
    responses(
        (status = 201, description = "Open; only this answer contains the token", body = CreatedSession),
        (status = 400, description = "Not JSON"),
        (status = 404, description = "No such model"),
        (status = 409, description = "The state belongs to a version of the model that is not active here"),
        (status = 422, description = "A state that does not fit; the answer names the field"),
        (status = 503, description = "Too many sessions"),
    )
)]
async fn create(app: App, caller: Caller, Json(request): Json<CreateSession>) -> Result<impl IntoResponse, ApiError> {
    let (model, state, settings) = request.resolve(&app)?;
    let now = Instant::now();
    let created = Session::new(model, state, settings, caller, now);
    let (session, token) = created.map_err(|error| ApiError::Internal(error.to_string()))?;
    let session = app.sessions.insert(session, now)?;
    let created = CreatedSession {
        session: SessionDescription::of(&session, app.sessions.grace, now),
        token,
        limits: StreamLimits::new(app.config(), true),
    };
    let location = format!("/v1/sessions/{}", created.session.id);
    Ok((StatusCode::CREATED, [(header::LOCATION, location)], axum::Json(created)))
}

/// Lists the open sessions that this key opened; with the scope `admin`, those of all keys.
#[utoipa::path(
    get, path = "/v1/sessions", params(Page),
    responses((status = 200, body = SessionList), (status = 422, description = "A limit out of range"))
)]
async fn list(app: App, caller: Caller, Query(page): Query<Page>) -> Result<axum::Json<SessionList>, ApiError> {
    let now = Instant::now();
    let found = app.sessions.page(&page.after, page.limit()? + 1, caller, now);
    let (found, next) = page.of(found, |session| session.id.as_str())?;
    let grace = app.sessions.grace;
    let describe = |session: &Arc<Session>| SessionDescription::of(session, grace, now);
    Ok(axum::Json(SessionList {
        sessions: found.iter().map(describe).collect(),
        next,
    }))
}

/// Describes a session that this key opened; with the scope `admin`, any session.
#[utoipa::path(get, path = "/v1/sessions/{id}", responses((status = 200, body = SessionDescription)))]
async fn get(app: App, caller: Caller, Path(id): Path<String>) -> Result<axum::Json<SessionDescription>, ApiError> {
    let now = Instant::now();
    let session = app.sessions.find(&id, caller, now)?;
    Ok(axum::Json(SessionDescription::of(&session, app.sessions.grace, now)))
}

/// Deletes a session and ends its stream.
#[utoipa::path(
    delete, path = "/v1/sessions/{id}",
    params(("id" = String, Path), ("x-session-token" = Option<String>, Header)),
    responses((status = 204, description = "Deleted"))
)]
async fn delete(app: App, session: AuthorizedSession) -> StatusCode {
    app.sessions.remove(&session.0);
    StatusCode::NO_CONTENT
}

/// Exports the session state, for `POST /v1/sessions` on this or another server.
#[utoipa::path(
    get, path = "/v1/sessions/{id}/state",
    params(("id" = String, Path), ("x-session-token" = Option<String>, Header)),
    responses((status = 200, body = ExportedState))
)]
async fn state(session: AuthorizedSession) -> axum::Json<ExportedState> {
    let (state, settings) = session.0.state();
    let manifest = &session.0.model.manifest;
    axum::Json(ExportedState {
        model: manifest.name.to_string(),
        version: manifest.version,
        weights_sha256: manifest.weights_sha256.clone(),
        on_gap: settings.on_gap,
        on_late: settings.on_late,
        format: settings.format,
        resize: settings.resize,
        snapshot: state.snapshot(),
    })
}

/// The token, if it is not in the header.
#[derive(Debug, Deserialize)]
struct TokenQuery {
    token: Option<String>,
}

/// The session in the path, if the request has its token.
pub(super) struct AuthorizedSession(pub(super) Arc<Session>);

impl axum::extract::FromRequestParts<App> for AuthorizedSession {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut axum::http::request::Parts, app: &App) -> Result<Self, ApiError> {
        let Path(id) = Path::<String>::from_request_parts(parts, app).await?;
        let Query(query) = Query::<TokenQuery>::from_request_parts(parts, app).await?;
        let token = token_of(&parts.headers).or(query.token).unwrap_or_default();
        Ok(Self(app.sessions.open(&id, &token, Instant::now())?))
    }
}

fn token_of(headers: &HeaderMap) -> Option<String> {
    let token = headers.get("x-session-token")?;
    token.to_str().ok().map(str::to_owned)
}
