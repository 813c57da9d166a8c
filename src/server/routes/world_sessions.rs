//! World models as environments, with the sessions of vLLM-Omni's `world_model_env`: a step takes an observation and an action and
//! returns the next observation, with its uncertainty. A session gathers its context from the observations.

mod bodies;

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use tokio::sync::Mutex;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use self::bodies::{
    ClosedSession, NewWorldSession, NextObservation, ResetSession, StepRefusal, WorldSessionStatus, WorldStepAnswer,
    WorldStepMetadata, WorldStepRequest,
};
use crate::server::http::extract::{Json, Path};
use crate::server::http::keys::Caller;
use crate::server::http::problem::{ApiError, RETRY_AFTER_S};
use crate::server::state::App;
use crate::server::stream::protocol::{ErrorCode, ServerMessage};
use crate::server::stream::step::StepError;
use crate::server::world_session::WorldSession;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(create))
        .routes(routes!(step))
        .routes(routes!(reset))
        .routes(routes!(close))
        .routes(routes!(status))
}

/// Opens a session in which a world model is the environment, as vLLM-Omni does. It takes a place among the environments.
#[utoipa::path(
    post, path = "/v1/realtime/sessions",
    request_body = NewWorldSession,
    responses(
        (status = 200, body = bodies::OpenedWorldSession),
        (status = 404, description = "No such model"),
        (status = 503, description = "All environments are in use"),
    )
)]
async fn create(app: App, caller: Caller, Json(request): Json<NewWorldSession>) -> Result<impl IntoResponse, ApiError> {
    let model = app.predictor().active(&request.model)?;
    let session = WorldSession::new(model, caller)?;
    let created_at = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
    let session_id = app.world_sessions.add(Mutex::new(session), caller, Instant::now())?;
    // For load balancers, which learn from it where the session is.
    let location = format!("/v1/realtime/sessions/{session_id}");
    let opened = bodies::OpenedWorldSession {
        session_id,
        mode: request.mode,
        created_at: created_at.as_secs_f64(),
    };
    Ok(([(header::LOCATION, location)], axum::Json(opened)))
}

/// Predicts the observations that follow this one. While the context is not full, there is none.
#[utoipa::path(
    post, path = "/v1/realtime/sessions/{id}/step",
    request_body = WorldStepRequest,
    responses(
        (status = 200, body = WorldStepAnswer),
        (status = 400, description = "Not the next step, or it does not fit the model", body = WorldStepAnswer),
        (status = 404, description = "No such session of this API key", body = WorldStepAnswer),
        (status = 410, description = "The session is closed", body = WorldStepAnswer),
        (status = 503, description = "Too many predictions wait", body = WorldStepAnswer),
    )
)]
async fn step(
    app: App,
    caller: Caller,
    Path(id): Path<String>,
    Json(request): Json<WorldStepRequest>,
) -> Result<Response, ApiError> {
    let (started, step_id) = (Instant::now(), request.step_id);
    let session = match app.world_sessions.get(&id, caller, started) {
        Ok(session) => session,
        Err(ApiError::NotFound(message)) => {
            let refusal = StepRefusal::new("session_not_found", message);
            return Ok(refused(StatusCode::NOT_FOUND, refusal, step_id, 0));
        }
        Err(error) => return Err(error),
    };
    let session = session.lock().await;
    let answered = advance(&app, &session, request).await;
    let next_step = session.next_step();
    Ok(match answered {
        Ok(message) => {
            let next_observation = NextObservation::of(message, session.model().spec());
            let metadata = WorldStepMetadata::new(started.elapsed(), next_step, next_observation.as_ref());
            axum::Json(WorldStepAnswer::new(step_id, next_observation, metadata)).into_response()
        }
        Err((status, refusal)) => refused(status, refusal, step_id, next_step),
    })
}

async fn advance(
    app: &App,
    session: &WorldSession,
    request: WorldStepRequest,
) -> Result<ServerMessage, (StatusCode, StepRefusal)> {
    let (next_step, step_id) = (session.next_step(), request.step_id);
    let refuse = |status, code, message| Err((status, StepRefusal::new(code, message)));
    if session.is_closed {
        let message = "the session is closed; open another one".to_owned();
        return refuse(StatusCode::GONE, "session_closed", message);
    }
    if !request.use_session_context {
        let context = session.model().spec().context;
        let message = format!("without the session's context there is one frame; the model predicts from {context}");
        return refuse(StatusCode::BAD_REQUEST, "invalid_request", message);
    }
    if step_id != next_step {
        let is_old = step_id < next_step;
        let code = if is_old {
            "step_already_committed"
        } else {
            "step_out_of_order"
        };
        let message = format!("step_id is {step_id}; step {next_step} is next");
        return refuse(StatusCode::BAD_REQUEST, code, message);
    }
    let stepped = async {
        let manifest = Arc::clone(&session.model().manifest);
        let max_steps = app.config.max_steps;
        let read = move || request.into_step(&manifest, max_steps);
        let step = app.predictions.run(read).await??;
        session.ownership.step(app.predictor(), &app.predictions, step).await
    };
    stepped.await.map_err(|error: StepError| {
        let (status, code) = match error.code() {
            ErrorCode::Overloaded => (StatusCode::SERVICE_UNAVAILABLE, "inference_error"),
            ErrorCode::Internal => (StatusCode::INTERNAL_SERVER_ERROR, "inference_error"),
            _ => (StatusCode::BAD_REQUEST, "invalid_request"),
        };
        (status, StepRefusal::new(code, error.to_string()))
    })
}

fn refused(status: StatusCode, refusal: StepRefusal, step_id: u64, next_step: u64) -> Response {
    let answer = axum::Json(WorldStepAnswer::refused(step_id, next_step, refusal));
    let mut response = (status, answer).into_response();
    if status == StatusCode::SERVICE_UNAVAILABLE {
        response.headers_mut().insert(header::RETRY_AFTER, RETRY_AFTER_S.into());
    }
    response
}

/// Begins a new context: the next step is 0.
#[utoipa::path(
    post, path = "/v1/realtime/sessions/{id}/reset",
    responses(
        (status = 200, body = ResetSession),
        (status = 404, description = "No such session of this API key"),
        (status = 410, description = "The session is closed"),
    )
)]
async fn reset(app: App, caller: Caller, Path(id): Path<String>) -> Result<axum::Json<ResetSession>, ApiError> {
    let session = app.world_sessions.get(&id, caller, Instant::now())?;
    let mut session = session.lock().await;
    if session.is_closed {
        return Err(ApiError::Gone("the session is closed; open another one".to_owned()));
    }
    let model = Arc::clone(session.model());
    *session = WorldSession::new(model, caller)?;
    Ok(axum::Json(ResetSession {
        session_id: id,
        committed_step_id: bodies::committed(session.next_step()),
    }))
}

/// Closes a session. Its status can be asked for until another session or time takes its place.
#[utoipa::path(
    post, path = "/v1/realtime/sessions/{id}/close",
    responses((status = 200, body = ClosedSession), (status = 404, description = "No such session of this API key"))
)]
async fn close(app: App, caller: Caller, Path(id): Path<String>) -> Result<axum::Json<ClosedSession>, ApiError> {
    let session = app.world_sessions.get(&id, caller, Instant::now())?;
    session.lock().await.is_closed = true;
    app.world_sessions.give_up_place(&id, Instant::now());
    Ok(axum::Json(ClosedSession {
        session_id: id,
        closed: true,
    }))
}

/// Which step was the last one.
#[utoipa::path(
    get, path = "/v1/realtime/sessions/{id}/status",
    responses((status = 200, body = WorldSessionStatus), (status = 404, description = "No such session of this API key"))
)]
async fn status(app: App, caller: Caller, Path(id): Path<String>) -> Result<axum::Json<WorldSessionStatus>, ApiError> {
    let session = app.world_sessions.get(&id, caller, Instant::now())?;
    let session = session.lock().await;
    Ok(axum::Json(WorldSessionStatus::of(&session, id)))
}
