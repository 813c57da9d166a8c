//! The simulator over HTTP with Gymnasium's reset and step, for training policies and for the page at `/`.

mod table;

use axum::extract::State;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::error::{ApiError, Problem};
use super::extract::{Json, Path};
use super::images::{self, ImageBytes, ImageFormat};
use super::{App, blocking};
use crate::nn::spec::MAX_MODEL_SIDE_PX;
use crate::sim::{self, Environment, Observation, Scenario, SimError, StepResult, TrialParameters, World, WorldConfig};
use crate::types::{Action, Channel, Seed, ValueError};

pub(super) use table::Environments;

/// What to simulate.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct NewEnvironment {
    /// `static-observer`, `moving-observer` or `crowded`.
    scenario: Scenario,
    /// The seed of the sequence of trials; the same seed and actions give the same frames.
    #[serde(default)]
    seed: u64,
    /// Frame size and period, the camera, how long a trial lasts.
    #[serde(default)]
    world: WorldConfig,
}

/// Where an episode begins.
#[derive(Debug, Default, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct ResetRequest {
    /// Begins the sequence of this seed; without it the next trial of the present one begins.
    #[serde(default)]
    seed: Option<u64>,
}

/// What the robot does until the next frame.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct StepRequest {
    /// In the order and units of the environment's `action`; cut to what the robot's base can do: ±0.7 m/s, ±1.92 rad/s.
    action: Vec<f32>,
}

/// What the robot perceives.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct ObservationBody {
    /// The camera's frame: PNG, base64.
    frame: ImageBytes,
    /// In the order and units of the environment's `state`.
    state: Vec<f32>,
}

/// What is known beside the observation.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Info {
    /// Since the episode began, in seconds.
    time_s: f64,
    /// What the simulator's own driver would do next.
    policy_action: Vec<f32>,
    /// All that was drawn for the episode; only when it begins.
    #[serde(skip_serializing_if = "Option::is_none")]
    trial: Option<TrialParameters>,
}

/// An environment at the beginning of an episode.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct EnvironmentBody {
    /// Its id.
    id: String,
    /// Who moves.
    scenario: Scenario,
    /// Components of an action, in their order.
    action: Vec<Channel>,
    /// Components of a state, in their order.
    state: Vec<Channel>,
    /// The settings of the world.
    world: WorldConfig,
    /// What the robot perceives.
    observation: ObservationBody,
    /// What is known beside.
    info: Info,
}

/// The beginning of an episode.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct ResetBody {
    /// What the robot perceives.
    observation: ObservationBody,
    /// What is known beside.
    info: Info,
}

/// What a step brought.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct StepBody {
    /// What the robot perceives after it.
    observation: ObservationBody,
    /// 1 with the other robot in the middle of the view, 0 where it is out of it, less 1 for a collision.
    reward: f32,
    /// The other robot has reached its goal.
    terminated: bool,
    /// The episode's time is over.
    truncated: bool,
    /// What is known beside.
    info: Info,
}

/// Why an environment could not do what was asked.
#[derive(Debug, thiserror::Error)]
pub(super) enum EnvironmentError {
    #[error("world: a frame of {width}×{height} px; up to {MAX_MODEL_SIDE_PX}×{MAX_MODEL_SIDE_PX} px can be had")]
    FrameSize { width: u32, height: u32 },
    #[error("world: {0}")]
    World(SimError),
    #[error("action: {0}")]
    Value(#[from] ValueError),
    #[error("action: {0}")]
    StepResult(SimError),
    #[error("the episode is over; reset the environment to begin the next")]
    Ended,
    #[error(transparent)]
    Image(#[from] images::ImageError),
}

/// Begins the simulation of a robot that others can drive.
#[utoipa::path(
    post, path = "/v1/environments", tag = "environments", request_body = NewEnvironment,
    responses(
        (status = 201, description = "Simulated; the header Location names it", body = EnvironmentBody),
        (status = 422, description = "Not a world that can be simulated; names the field", body = Problem),
        (status = 503, description = "Too many environments", body = Problem),
    )
)]
pub(super) async fn create(State(app): State<App>, Json(asked): Json<NewEnvironment>) -> Result<Response, ApiError> {
    let (environment, body) = blocking(move || begin(&asked)).await??;
    let id = app.environments().add(environment)?;
    let location = HeaderValue::from_str(&format!("/v1/environments/{id}"));
    let mut response = (StatusCode::CREATED, axum::Json(EnvironmentBody { id, ..body })).into_response();
    if let Ok(location) = location {
        response.headers_mut().insert(header::LOCATION, location);
    }
    Ok(response)
}

/// Begins the next episode.
#[utoipa::path(
    post, path = "/v1/environments/{id}/reset", tag = "environments", request_body = ResetRequest,
    params(("id" = String, Path, description = "The environment's id")),
    responses(
        (status = 200, body = ResetBody),
        (status = 404, description = "No such environment; those nobody steps are dropped", body = Problem),
    )
)]
pub(super) async fn reset(
    State(app): State<App>,
    Path(id): Path<String>,
    Json(asked): Json<ResetRequest>,
) -> Result<axum::Json<ResetBody>, ApiError> {
    let environment = app.environments().get(&id)?;
    let work = move || restart(&mut table::lock(&environment), asked.seed.map(Seed));
    Ok(axum::Json(blocking(work).await??))
}

/// Acts for one frame period.
#[utoipa::path(
    post, path = "/v1/environments/{id}/step", tag = "environments", request_body = StepRequest,
    params(("id" = String, Path, description = "The environment's id")),
    responses(
        (status = 200, body = StepBody),
        (status = 404, description = "No such environment; those nobody steps are dropped", body = Problem),
        (status = 409, description = "The episode is over", body = Problem),
        (status = 422, description = "Not an action of this environment", body = Problem),
    )
)]
pub(super) async fn step(
    State(app): State<App>,
    Path(id): Path<String>,
    Json(asked): Json<StepRequest>,
) -> Result<axum::Json<StepBody>, ApiError> {
    let environment = app.environments().get(&id)?;
    let work = move || advance(&mut table::lock(&environment), asked.action);
    Ok(axum::Json(blocking(work).await??))
}

/// Ends an environment.
#[utoipa::path(
    delete, path = "/v1/environments/{id}", tag = "environments",
    params(("id" = String, Path, description = "The environment's id")),
    responses(
        (status = 204, description = "It is gone"),
        (status = 404, description = "No such environment", body = Problem),
    )
)]
pub(super) async fn delete(State(app): State<App>, Path(id): Path<String>) -> Result<StatusCode, ApiError> {
    app.environments().remove(&id)?;
    Ok(StatusCode::NO_CONTENT)
}

fn begin(asked: &NewEnvironment) -> Result<(Environment, EnvironmentBody), EnvironmentError> {
    let (width, height) = (asked.world.frame_width_px, asked.world.frame_height_px);
    if width.max(height) > MAX_MODEL_SIDE_PX {
        return Err(EnvironmentError::FrameSize { width, height });
    }
    let mut environment = Environment::new(asked.scenario, asked.world.clone()).map_err(EnvironmentError::World)?;
    let ResetBody { observation, info } = restart(&mut environment, Some(Seed(asked.seed)))?;
    let body = EnvironmentBody {
        id: String::new(),
        scenario: asked.scenario,
        action: sim::action_channels(),
        state: sim::state_channels(),
        world: asked.world.clone(),
        observation,
        info,
    };
    Ok((environment, body))
}

fn restart(environment: &mut Environment, seed: Option<Seed>) -> Result<ResetBody, EnvironmentError> {
    let (observation, trial) = environment.reset(seed).map_err(EnvironmentError::World)?;
    Ok(ResetBody {
        info: info(environment.world(), &observation, Some(trial)),
        observation: body(observation)?,
    })
}

fn advance(environment: &mut Environment, action: Vec<f32>) -> Result<StepBody, EnvironmentError> {
    let action = Action::try_from(action)?;
    let StepResult {
        observation,
        reward,
        terminated,
        truncated,
    } = environment.step(&action).map_err(|error| match error {
        SimError::Ended => EnvironmentError::Ended,
        other => EnvironmentError::StepResult(other),
    })?;
    Ok(StepBody {
        info: info(environment.world(), &observation, None),
        observation: body(observation)?,
        reward,
        terminated,
        truncated,
    })
}

fn body(observation: Observation) -> Result<ObservationBody, EnvironmentError> {
    Ok(ObservationBody {
        frame: images::encode_one(&observation.frame, ImageFormat::Png)?,
        state: observation.state.into(),
    })
}

fn info(world: Option<&World>, observation: &Observation, trial: Option<TrialParameters>) -> Info {
    Info {
        time_s: observation.time_s,
        policy_action: world.map_or_else(Vec::new, |world| world.policy_action().into()),
        trial,
    }
}
