//! The simulator with `OpenEnv`'s interface, for clients of its package `openenv-core`: an environment for each scenario below
//! `/openenv`. Its specification is the contract, so these routes are not in the `OpenAPI` document.

mod description;
mod messages;
mod socket;

use std::str::FromStr as _;

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use axum::response::Response;
use axum::routing::{get, post};
use tracing::{Instrument, Span, info};
use utoipa_axum::router::OpenApiRouter;

use self::messages::{EpisodeAnswer, EpisodeState, EpisodeStepRequest, ResetData, StepData};
use self::socket::EnvironmentSocket;
use super::environments::{advance, restart};
use super::streams::{self, Messages, Upgrade};
use crate::server::http::extract::{Json, Path};
use crate::server::http::keys::Caller;
use crate::server::http::problem::{ApiError, unfit};
use crate::server::state::App;
use crate::server::stream::request_socket::answer_all;
use foreframe_core::types::Seed;
use foreframe_sim::{Environment, Scenario, WorldConfig};

/// The routes of requests. A request has an environment of its own: only a socket keeps one.
pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .route("/openenv/{scenario}/reset", post(reset))
        .route("/openenv/{scenario}/step", post(step))
        .route("/openenv/{scenario}/state", get(state))
        .route("/openenv/{scenario}/schema", get(schema))
        .route("/openenv/{scenario}/metadata", get(metadata))
        .route("/openenv/{scenario}/health", get(health))
        .route("/openenv/{scenario}/openapi.json", get(openapi))
        .route("/openenv/{scenario}/mcp", post(description::mcp))
}

/// The route of the socket.
pub(in crate::server) fn stream_routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().route("/openenv/{scenario}/ws", get(socket))
}

/// The scenario in the path.
struct NamedScenario(Scenario);

impl FromRequestParts<App> for NamedScenario {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self, ApiError> {
        let Path(name) = Path::<String>::from_request_parts(parts, app).await?;
        let scenario = Scenario::from_str(&name).map_err(|error| ApiError::NotFound(error.to_string()))?;
        Ok(Self(scenario))
    }
}

async fn reset(
    app: App,
    NamedScenario(scenario): NamedScenario,
    Json(request): Json<ResetData>,
) -> Result<axum::Json<EpisodeAnswer>, ApiError> {
    let seed = request.seed.map(Seed);
    let begin = move || Ok::<_, ApiError>(EpisodeAnswer::of_reset(restart(&mut new(scenario)?, seed)?));
    Ok(axum::Json(app.blocking.run(begin).await??))
}

async fn step(
    app: App,
    NamedScenario(scenario): NamedScenario,
    Json(request): Json<EpisodeStepRequest>,
) -> Result<axum::Json<EpisodeAnswer>, ApiError> {
    let StepData { action } = request.action;
    let work = move || {
        let mut environment = new(scenario)?;
        restart(&mut environment, None)?;
        Ok::<_, ApiError>(EpisodeAnswer::of_step(advance(&mut environment, action)?))
    };
    Ok(axum::Json(app.blocking.run(work).await??))
}

async fn state(NamedScenario(scenario): NamedScenario) -> axum::Json<EpisodeState> {
    axum::Json(EpisodeState::new(scenario))
}

async fn schema(_: NamedScenario) -> axum::Json<serde_json::Value> {
    axum::Json(description::schema())
}

async fn metadata(NamedScenario(scenario): NamedScenario) -> axum::Json<serde_json::Value> {
    axum::Json(description::metadata(scenario))
}

async fn health(_: NamedScenario) -> axum::Json<serde_json::Value> {
    axum::Json(serde_json::json!({"status": "healthy"}))
}

async fn openapi(NamedScenario(scenario): NamedScenario) -> axum::Json<serde_json::Value> {
    axum::Json(description::openapi(scenario))
}

async fn socket(
    app: App,
    caller: Caller,
    messages: Messages,
    NamedScenario(scenario): NamedScenario,
    upgrade: Upgrade,
) -> Result<Response, ApiError> {
    let upgrade = upgrade.map_err(|_| ApiError::UpgradeRequired)?;
    let services = streams::services(&app, caller, messages);
    let (place, upgrade) = streams::admit(&app, &services, upgrade)?;
    info!(%scenario, "OpenEnv socket opened");
    let environment = EnvironmentSocket::new(app, caller, scenario);
    Ok(upgrade.on_upgrade(move |socket| {
        async move {
            answer_all(socket, &services, environment).await;
            drop(place);
        }
        .instrument(Span::current())
    }))
}

/// An environment before its first episode.
fn new(scenario: Scenario) -> Result<Environment, ApiError> {
    Environment::new(scenario, WorldConfig::default()).map_err(unfit("world"))
}
