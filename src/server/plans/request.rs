//! What a plan is asked for with.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::response::PlanForm;
use crate::server::bounded_list::{list, rows};
use crate::server::config::ServerConfig;
use crate::server::http::multipart::check_count;
use crate::server::http::problem::{ApiError, unfit};
use crate::server::images::{self, ImageBytes, ImageFormat, ImageInput};
use crate::server::request_inputs;
use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::planning::{ActionLimit, Goal, PlanCost, PlanSettings, PlannerInput, SolverSettings};
use foreframe_core::registry::Manifest;
use foreframe_core::serving::SessionState;
use foreframe_core::types::{Action, RobotState};

/// The time of a search that names none, in milliseconds.
const BUDGET_MS: u64 = 200;

/// What a plan is to reach, as seen from the robot at the last frame. At least one part is given.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub(in crate::server) struct PlanGoal {
    /// Where the robot should get: metres ahead and to the left.
    #[schema(min_items = 2, max_items = 2)]
    #[serde(skip_serializing_if = "Option::is_none")]
    position_m: Option<[f32; 2]>,
    /// Where it should look in the end: radians, counter-clockwise from where it looks now.
    #[serde(skip_serializing_if = "Option::is_none")]
    heading_rad: Option<f32>,
    /// What its camera should show in the end.
    #[serde(skip_serializing_if = "Option::is_none")]
    image: Option<ImageBytes>,
}

/// How to search, and what counts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub(in crate::server) struct PlanSearch {
    /// How plans are drawn.
    solver: SolverSettings,
    /// Weights of the costs, by name: `goal_distance` (metres), `goal_heading` (radians), `goal_image`, `clearance` (metres that
    /// are lacking to `margin_m`), `smoothness`, `expected_error`, `novelty`. One that is not named has its default weight, if it can
    /// be computed; 0 leaves it out.
    #[schema(value_type = BTreeMap<String, f32>)]
    costs: BTreeMap<PlanCost, f32>,
    /// Limits of the action channels, in their order. Default: the ranges of the training.
    #[schema(max_items = 4096)]
    #[serde(deserialize_with = "list", skip_serializing_if = "Option::is_none")]
    limits: Option<Vec<ActionLimit>>,
    /// Actions of a plan. Default: the model's horizon.
    #[schema(minimum = 1, maximum = 256)]
    #[serde(skip_serializing_if = "Option::is_none")]
    steps: Option<usize>,
    /// The time for all of it; the best plan so far is the answer.
    #[schema(minimum = 1, maximum = 10_000)]
    budget_ms: u64,
    /// How many of the best plans are predicted and compared at the end.
    #[schema(minimum = 1, maximum = 64)]
    finalists: usize,
    /// Radius of the robot's round footprint, in metres.
    #[schema(minimum = 0, maximum = 5)]
    radius_m: f32,
    /// The distance that the robot should keep, in metres.
    #[schema(minimum = 0, maximum = 5)]
    margin_m: f32,
    /// The robot's height, in metres: under what is higher, it passes.
    #[schema(minimum = 0.15, maximum = 5)]
    robot_height_m: f32,
}

impl Default for PlanSearch {
    fn default() -> Self {
        let settings = PlanSettings::default();
        Self {
            solver: settings.solver,
            costs: settings.costs,
            limits: settings.limits,
            steps: settings.steps,
            budget_ms: BUDGET_MS,
            finalists: settings.finalists,
            radius_m: settings.radius_m,
            margin_m: settings.margin_m,
            robot_height_m: settings.robot_height_m,
        }
    }
}

/// A goal for the robot of a session.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SessionPlanRequest {
    /// How the goal's image and those of the answer are encoded.
    #[serde(default)]
    format: ImageFormat,
    /// The robot's state. Default: its state at the session's last frame.
    #[schema(max_items = 4096)]
    #[serde(default, deserialize_with = "list", skip_serializing_if = "Option::is_none")]
    state: Option<Vec<f32>>,
    /// What to reach.
    goal: PlanGoal,
    /// How to search, and what counts.
    #[serde(default)]
    search: PlanSearch,
    /// The plan that the robot follows now. Default: that of the session's last frame.
    #[schema(max_items = 256)]
    #[serde(default, deserialize_with = "rows", skip_serializing_if = "Option::is_none")]
    present: Option<Vec<Vec<f32>>>,
    /// The action before the plan, from which `max_change` is counted first.
    #[schema(max_items = 4096)]
    #[serde(default, deserialize_with = "list", skip_serializing_if = "Option::is_none")]
    action: Option<Vec<f32>>,
    /// Whether the answer has the predicted frames.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    with_frames: bool,
    /// Whether the answer has what stands in the way, and where movers will be.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    with_obstacles: bool,
}

impl SessionPlanRequest {
    /// The bytes of the goal's image, as they came.
    pub(in crate::server) fn image_bytes(&self) -> usize {
        self.goal.image.as_ref().map_or(0, |image| image.0.len())
    }

    /// How the answer is given.
    pub(in crate::server) fn form(&self) -> PlanForm {
        PlanForm {
            format: self.format.answer(),
            with_frames: self.with_frames,
            with_obstacles: self.with_obstacles,
        }
    }

    /// What the search starts from.
    pub(in crate::server) fn into_input(
        self,
        session: &SessionState,
        resize: Option<Resize>,
        manifest: &Manifest,
        config: &ServerConfig,
    ) -> Result<PlannerInput, ApiError> {
        let (_, state) = request_inputs::states(self.state, None, 0)?;
        let images = ImageInput {
            format: self.format,
            resize,
        };
        let present = match self.present {
            Some(present) => present_plan(present, config)?,
            None => session.present_plan().to_vec(),
        };
        let given = GivenToPlanner {
            state: state.or_else(|| session.robot_state().cloned()),
            camera: session.camera(),
            present,
            action: self.action,
        };
        let reading = PlanReading {
            images,
            manifest,
            config,
        };
        given.input(self.goal, self.search, reading)
    }
}

/// The actions in `present` of a request.
pub(in crate::server) fn present_plan(present: Vec<Vec<f32>>, config: &ServerConfig) -> Result<Vec<Action>, ApiError> {
    check_count("present", present.len(), config.max_steps)?;
    request_inputs::actions("present", present)
}

/// What is known of the robot.
pub(in crate::server) struct GivenToPlanner {
    pub(in crate::server) state: Option<RobotState>,
    pub(in crate::server) camera: Option<CameraModel>,
    pub(in crate::server) present: Vec<Action>,
    pub(in crate::server) action: Option<Vec<f32>>,
}

/// How a request for a plan is read.
#[derive(Clone, Copy)]
pub(in crate::server) struct PlanReading<'a> {
    pub(in crate::server) images: ImageInput,
    pub(in crate::server) manifest: &'a Manifest,
    pub(in crate::server) config: &'a ServerConfig,
}

impl GivenToPlanner {
    /// What the search starts from.
    pub(in crate::server) fn input(
        self,
        goal: PlanGoal,
        search: PlanSearch,
        reading: PlanReading<'_>,
    ) -> Result<PlannerInput, ApiError> {
        let PlanReading {
            images,
            manifest,
            config,
        } = reading;
        request_inputs::check_steps(search.steps, manifest, config)?;
        let image = goal
            .image
            .map(|image| images::decode("goal.image", image, images, manifest));
        Ok(PlannerInput {
            goal: Goal {
                position_m: goal.position_m,
                heading_rad: goal.heading_rad,
                image: image.transpose()?,
            },
            settings: PlanSettings {
                solver: search.solver,
                costs: search.costs,
                limits: search.limits,
                steps: search.steps,
                budget: Some(Duration::from_millis(search.budget_ms)),
                finalists: search.finalists,
                predicts_plans: true,
                radius_m: search.radius_m,
                margin_m: search.margin_m,
                robot_height_m: search.robot_height_m,
            },
            state: self.state,
            camera: self.camera,
            present: self.present,
            before: self.action.map(Action::try_from).transpose().map_err(unfit("action"))?,
        })
    }
}
