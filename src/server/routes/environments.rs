//! The simulator over HTTP, with reset and step as in Gymnasium; for training policies and for the page at `/`.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::bounds::ChannelBounds;
use crate::server::environments::SharedEnvironment;
use crate::server::http::extract::{Json, Path};
use crate::server::http::keys::Caller;
use crate::server::http::problem::{ApiError, unfit};
use crate::server::images::{self, ImageBytes, ImageFormat};
use crate::server::state::App;
use foreframe_core::nn::spec::MAX_MODEL_SIDE_PX;
use foreframe_core::types::{Action, Channel, Seed};
use foreframe_sim::robot::{MAX_ANGULAR_RAD_S, MAX_LINEAR_M_S};
use foreframe_sim::{
    Environment, Observation, PlanarPose, Scenario, SimError, StepResult, TrialParameters, World, WorldConfig,
    action_channels, state_channels,
};

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(create))
        .routes(routes!(reset))
        .routes(routes!(step))
        .routes(routes!(delete))
}

/// The environment to create.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct NewEnvironment {
    /// `static-observer`, `moving-observer`, `crowded` or `crossing`.
    scenario: Scenario,
    /// The seed of the sequence of trials; the same seed and actions give the same frames.
    #[serde(default)]
    seed: u64,
    /// Frame size and period, the camera, how long a trial lasts.
    #[serde(default)]
    world: WorldConfig,
}

/// How the next episode begins.
#[derive(Debug, Default, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct ResetRequest {
    /// Begins the sequence of this seed. Without it, the next trial of the current sequence begins.
    seed: Option<u64>,
}

/// The action until the next frame.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct StepRequest {
    /// In the order and units of the environment's `action`; limited to what the robot can do: ±0.7 m/s, ±1.92 rad/s.
    #[schema(min_items = 2, max_items = 2)]
    action: Vec<f32>,
}

/// An observation.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct ObservationBody {
    /// The camera's frame: PNG, base64.
    frame: ImageBytes,
    /// In the order and units of the environment's `state`.
    state: Vec<f32>,
}

/// Information beside the observation.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Info {
    /// Time since the start of the episode, in seconds.
    time_s: f64,
    /// The next action of the simulator's own driver.
    policy_action: Vec<f32>,
    /// The true poses of all robots, first that of the robot with the camera.
    poses: Vec<PlanarPose>,
    /// The random parameters of the episode; only at its start.
    #[serde(skip_serializing_if = "Option::is_none")]
    trial: Option<TrialParameters>,
}

/// An environment at the start of an episode.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct EnvironmentBody {
    /// Its id.
    id: String,
    /// The scenario.
    scenario: Scenario,
    /// Components of an action, in their order.
    action: Vec<Channel>,
    /// Lowest and highest value of each component of an action: what the robot can do.
    action_bounds: [ChannelBounds; 2],
    /// Components of a state, in their order.
    state: Vec<Channel>,
    /// The settings of the world.
    world: WorldConfig,
    /// The observation.
    observation: ObservationBody,
    /// Information beside the observation.
    info: Info,
}

/// The start of an episode.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct ResetBody {
    /// The observation.
    pub(super) observation: ObservationBody,
    /// Information beside the observation.
    pub(super) info: Info,
}

/// The result of a step.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct StepBody {
    /// The observation after the step.
    pub(super) observation: ObservationBody,
    /// 1 if the other robot is in the middle of the view, 0 if it is out of view; minus 1 for a collision.
    pub(super) reward: f32,
    /// The other robot has reached its goal.
    pub(super) terminated: bool,
    /// The time of the episode is over.
    pub(super) truncated: bool,
    /// Information beside the observation.
    pub(super) info: Info,
}

/// Creates a simulated robot that you can drive. If all environments are in use, it replaces the one that was idle the
/// longest, if that was idle for some seconds.
#[utoipa::path(
    post, path = "/v1/environments",
    responses(
        (status = 201, description = "Created; the header Location names it", body = EnvironmentBody),
        (status = 422, description = "Not a valid world; the answer names the field"),
        (status = 503, description = "All environments are in use"),
    )
)]
async fn create(app: App, caller: Caller, Json(request): Json<NewEnvironment>) -> Result<impl IntoResponse, ApiError> {
    let (environment, body) = app.blocking.run(move || begin(&request)).await??;
    let id = app.environments.add(Mutex::new(environment), caller, Instant::now())?;
    let location = format!("/v1/environments/{id}");
    let created = axum::Json(EnvironmentBody { id, ..body });
    Ok((StatusCode::CREATED, [(header::LOCATION, location)], created))
}

/// Begins the next episode.
#[utoipa::path(post, path = "/v1/environments/{id}/reset", responses((status = 200, body = ResetBody)))]
async fn reset(
    app: App,
    caller: Caller,
    Path(id): Path<String>,
    Json(request): Json<ResetRequest>,
) -> Result<axum::Json<ResetBody>, ApiError> {
    let environment = app.environments.get(&id, caller, Instant::now())?;
    let work = move || restart(&mut lock(&environment), request.seed.map(Seed));
    Ok(axum::Json(app.blocking.run(work).await??))
}

/// Applies an action for one frame period.
#[utoipa::path(
    post, path = "/v1/environments/{id}/step",
    responses(
        (status = 200, body = StepBody),
        (status = 409, description = "The episode is over"),
        (status = 422, description = "Not an action of this environment"),
    )
)]
async fn step(
    app: App,
    caller: Caller,
    Path(id): Path<String>,
    Json(request): Json<StepRequest>,
) -> Result<axum::Json<StepBody>, ApiError> {
    let environment = app.environments.get(&id, caller, Instant::now())?;
    let work = move || advance(&mut lock(&environment), request.action);
    Ok(axum::Json(app.blocking.run(work).await??))
}

/// Deletes an environment.
#[utoipa::path(
    delete, path = "/v1/environments/{id}",
    responses(
        (status = 204, description = "Deleted"),
        (status = 404, description = "No such environment of this API key"),
    )
)]
async fn delete(app: App, caller: Caller, Path(id): Path<String>) -> Result<StatusCode, ApiError> {
    app.environments.remove(&id, caller, Instant::now())?;
    Ok(StatusCode::NO_CONTENT)
}

fn begin(request: &NewEnvironment) -> Result<(Environment, EnvironmentBody), ApiError> {
    let (width, height) = (request.world.frame_width_px, request.world.frame_height_px);
    if width.max(height) > MAX_MODEL_SIDE_PX {
        return Err(ApiError::Unprocessable(format!(
            "world: a frame of {width}×{height} px; the maximum is {MAX_MODEL_SIDE_PX}×{MAX_MODEL_SIDE_PX} px"
        )));
    }
    let mut environment = Environment::new(request.scenario, request.world.clone()).map_err(unfit("world"))?;
    let ResetBody { observation, info } = restart(&mut environment, Some(Seed(request.seed)))?;
    let body = EnvironmentBody {
        id: String::new(),
        scenario: request.scenario,
        action: action_channels(),
        action_bounds: [MAX_LINEAR_M_S, MAX_ANGULAR_RAD_S].map(ChannelBounds::symmetric),
        state: state_channels(),
        world: request.world.clone(),
        observation,
        info,
    };
    Ok((environment, body))
}

pub(super) fn restart(environment: &mut Environment, seed: Option<Seed>) -> Result<ResetBody, ApiError> {
    let (observation, trial) = environment.reset(seed).map_err(unfit("world"))?;
    Ok(ResetBody {
        info: info(environment.world(), &observation, Some(trial)),
        observation: body(observation)?,
    })
}

pub(super) fn advance(environment: &mut Environment, action: Vec<f32>) -> Result<StepBody, ApiError> {
    let action = Action::try_from(action).map_err(unfit("action"))?;
    let StepResult {
        observation,
        reward,
        terminated,
        truncated,
    } = environment.step(&action).map_err(|error| match error {
        SimError::Ended => {
            ApiError::Conflict("the episode is over; reset the environment to begin the next".to_owned())
        }
        other => unfit("action")(other),
    })?;
    Ok(StepBody {
        info: info(environment.world(), &observation, None),
        observation: body(observation)?,
        reward,
        terminated,
        truncated,
    })
}

fn body(observation: Observation) -> Result<ObservationBody, ApiError> {
    Ok(ObservationBody {
        frame: images::encode_one(&observation.frame, ImageFormat::Png)?,
        state: observation.state.into(),
    })
}

fn info(world: Option<&World>, observation: &Observation, trial: Option<TrialParameters>) -> Info {
    Info {
        time_s: observation.time_s,
        policy_action: world.map_or_else(Vec::new, |world| world.policy_action().into()),
        poses: world.map_or_else(Vec::new, poses),
        trial,
    }
}

fn poses(world: &World) -> Vec<PlanarPose> {
    std::iter::once(world.observer_pose())
        .chain(world.other_robot_poses())
        .collect()
}

pub(super) fn lock(environment: &SharedEnvironment) -> MutexGuard<'_, Environment> {
    environment.lock().unwrap_or_else(PoisonError::into_inner)
}
