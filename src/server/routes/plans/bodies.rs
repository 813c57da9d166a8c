//! The bodies of plans.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::server::config::ServerConfig;
use crate::server::http::extract::ResponseFormat;
use crate::server::http::multipart::{WithFrames, check_count};
use crate::server::http::problem::{ApiError, unfit};
use crate::server::images::{self, ImageBytes, ImageFormat, ImageInput};
use crate::server::routes::{picture, predict};
use foreframe_core::frame::Frame;
use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::planning::{
    ActionLimit, CandidateKind, Goal, Obstacles, PlanCandidate, PlanChoice, PlanContext, PlanCost, PlanSettings,
    PlannerInput, SolverSettings, UnsafeReason,
};
use foreframe_core::registry::Manifest;
use foreframe_core::serving::{SessionState, Task};
use foreframe_core::types::{Action, RobotState};

/// The time of a search that names none, in milliseconds.
const BUDGET_MS: u64 = 200;

/// What a plan is to reach, as seen from the robot at the last frame. At least one part is given.
#[derive(Debug, Default, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct PlanGoal {
    /// Where the robot should get: metres ahead and to the left.
    position_m: Option<[f32; 2]>,
    /// Where it should look in the end: radians, counter-clockwise from where it looks now.
    heading_rad: Option<f32>,
    /// What its camera should show in the end.
    image: Option<ImageBytes>,
}

/// How to search, and what counts.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct PlanSearch {
    /// How plans are drawn.
    solver: SolverSettings,
    /// Weights of the costs, by name: `goal_distance` (metres), `goal_heading` (radians), `goal_image`, `clearance` (metres that
    /// are lacking to `margin_m`), `smoothness`, `expected_error`, `novelty`. One that is not named has its default weight, if it can
    /// be computed; 0 leaves it out.
    #[schema(value_type = BTreeMap<String, f32>)]
    costs: BTreeMap<PlanCost, f32>,
    /// Limits of the action channels, in their order. Default: the ranges of the training.
    limits: Option<Vec<ActionLimit>>,
    /// Actions of a plan. Default: the model's horizon.
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

/// A context and a goal.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct PlanRequest {
    /// The images of the context, oldest first; in a form, its parts `frames`.
    #[serde(default)]
    frames: Vec<ImageBytes>,
    /// How the images are encoded, here and in the answer (`jpeg` is answered with `png`).
    #[serde(default)]
    format: ImageFormat,
    /// How an image of another size is resized; without it, another size is an error.
    resize: Option<Resize>,
    /// The robot's state at the last frame.
    state: Option<Vec<f32>>,
    /// The robot's state at each frame, instead of `state`.
    states: Option<Vec<Vec<f32>>>,
    /// The camera that took the images, for a model that estimates depth. Default: the model's.
    camera: Option<CameraModel>,
    /// What to reach.
    goal: PlanGoal,
    /// How to search, and what counts.
    #[serde(default)]
    search: PlanSearch,
    /// The plan that the robot follows now; one of the candidates, and where the search begins. Its last action is held.
    #[serde(default)]
    present: Vec<Vec<f32>>,
    /// The action before the plan, from which `max_change` is counted first.
    action: Option<Vec<f32>>,
    /// Whether the answer has the predicted frames.
    #[serde(default)]
    with_frames: bool,
    /// Whether the answer has what stands in the way, and where movers will be.
    #[serde(default)]
    with_obstacles: bool,
}

/// A goal for the robot of a session.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct SessionPlanRequest {
    /// How the goal's image and those of the answer are encoded.
    #[serde(default)]
    format: ImageFormat,
    /// The robot's state. Default: its state at the session's last frame.
    state: Option<Vec<f32>>,
    /// What to reach.
    goal: PlanGoal,
    /// How to search, and what counts.
    #[serde(default)]
    search: PlanSearch,
    /// The plan that the robot follows now. Default: that of the session's last frame.
    present: Option<Vec<Vec<f32>>>,
    /// The action before the plan, from which `max_change` is counted first.
    action: Option<Vec<f32>>,
    /// Whether the answer has the predicted frames.
    #[serde(default)]
    with_frames: bool,
    /// Whether the answer has what stands in the way, and where movers will be.
    #[serde(default)]
    with_obstacles: bool,
}

/// How an answer is given.
#[derive(Clone, Copy)]
pub(super) struct PlanAnswerForm {
    pub(super) wanted: ResponseFormat,
    format: ImageFormat,
    with_frames: bool,
    with_obstacles: bool,
}

impl WithFrames for PlanRequest {
    fn push_frame(&mut self, file: Vec<u8>) {
        self.frames.push(ImageBytes(file));
    }
}

impl PlanRequest {
    pub(super) fn answer_form(&self, wanted: ResponseFormat) -> PlanAnswerForm {
        PlanAnswerForm {
            wanted,
            format: self.format.answer(),
            with_frames: self.with_frames,
            with_obstacles: self.with_obstacles,
        }
    }

    /// The context, also as frames if the answer shows it, and what the search starts from.
    pub(super) fn into_search(
        self,
        wanted: ResponseFormat,
        manifest: &Manifest,
        config: &ServerConfig,
    ) -> Result<(Vec<Frame>, PlanContext, PlannerInput), ApiError> {
        let reading = ImageInput {
            format: self.format,
            resize: self.resize,
        };
        let frames = predict::decode_frames(self.frames, reading, manifest, config.max_frames)?;
        let (past_states, state) = predict::states(self.state, self.states, frames.len())?;
        let seen = picture::context_for(wanted, &frames);
        let task = Task::rollout(frames, past_states, self.camera, Vec::new(), manifest)?;
        let given = GivenToPlanner {
            state,
            camera: self.camera,
            present: actions(self.present, config)?,
            action: self.action,
        };
        let input = given.input(self.goal, self.search, reading, (manifest, config))?;
        Ok((seen, PlanContext::new(task), input))
    }
}

impl SessionPlanRequest {
    pub(super) fn answer_form(&self, wanted: ResponseFormat) -> PlanAnswerForm {
        PlanAnswerForm {
            wanted,
            format: self.format.answer(),
            with_frames: self.with_frames,
            with_obstacles: self.with_obstacles,
        }
    }

    /// What the search starts from.
    pub(super) fn into_input(
        self,
        session: &SessionState,
        resize: Option<Resize>,
        manifest: &Manifest,
        config: &ServerConfig,
    ) -> Result<PlannerInput, ApiError> {
        let (_, state) = predict::states(self.state, None, 0)?;
        let reading = ImageInput {
            format: self.format,
            resize,
        };
        let present = match self.present {
            Some(present) => actions(present, config)?,
            None => session.present_plan().to_vec(),
        };
        let given = GivenToPlanner {
            state: state.or_else(|| session.robot_state().cloned()),
            camera: session.camera(),
            present,
            action: self.action,
        };
        given.input(self.goal, self.search, reading, (manifest, config))
    }
}

fn actions(present: Vec<Vec<f32>>, config: &ServerConfig) -> Result<Vec<Action>, ApiError> {
    check_count("present", present.len(), config.max_steps)?;
    predict::actions("present", present)
}

/// What is known of the robot.
struct GivenToPlanner {
    state: Option<RobotState>,
    camera: Option<CameraModel>,
    present: Vec<Action>,
    action: Option<Vec<f32>>,
}

impl GivenToPlanner {
    fn input(
        self,
        goal: PlanGoal,
        search: PlanSearch,
        reading: ImageInput,
        (manifest, config): (&Manifest, &ServerConfig),
    ) -> Result<PlannerInput, ApiError> {
        predict::check_steps(search.steps, manifest, config)?;
        let image = goal
            .image
            .map(|image| images::decode("goal.image", image, reading, manifest));
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

/// A plan with what is expected under it.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct PlannedActions {
    /// Where it comes from.
    kind: CandidateKind,
    /// The first acts from the last frame on.
    actions: Vec<Vec<f32>>,
    /// The weighted sum of its costs.
    cost: f32,
    /// The value of each cost, not weighted.
    #[schema(value_type = BTreeMap<String, f32>)]
    costs: BTreeMap<PlanCost, f32>,
    /// Where the robot will be after each action, as seen from it at the last frame: metres ahead, metres to the left, and radians
    /// counter-clockwise. Absent if the actions are no speeds.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    way: Vec<[f32; 3]>,
    /// The least distance from the robot's footprint to what the last frame shows, in metres; below 0, it would touch it. Absent if
    /// that is not known, or nothing is seen.
    #[serde(skip_serializing_if = "Option::is_none")]
    clearance_m: Option<f32>,
    /// The predicted frames t+1, t+2, …, if they were asked for and there was time.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    frames: Vec<ImageBytes>,
    /// The mean squared error to expect of each frame up to the model's horizon; absent if it was not predicted, or the model is not
    /// calibrated.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    expected_mse: Vec<f32>,
}

impl PlannedActions {
    fn new(candidate: PlanCandidate, form: PlanAnswerForm) -> Result<Self, ApiError> {
        let rollout = candidate.rollout.unwrap_or_default();
        let motion = candidate.motion.unwrap_or_default();
        Ok(Self {
            kind: candidate.kind,
            actions: candidate.actions.into_iter().map(Vec::from).collect(),
            cost: candidate.total,
            costs: candidate.costs.into_iter().collect(),
            way: motion
                .into_iter()
                .map(|[yaw, ahead, left]| [ahead, left, yaw])
                .collect(),
            clearance_m: candidate.clearance_m.filter(|clearance| clearance.is_finite()),
            expected_mse: rollout.expected_mse(),
            frames: if form.with_frames {
                images::encode_owned(rollout.frames, form.format)?
            } else {
                Vec::new()
            },
        })
    }
}

/// The best plan.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct PlanResponse {
    /// The model's name.
    model: String,
    /// The model's version.
    version: u32,
    /// The plan to follow: the best one, or stopping if no plan is safe.
    plan: PlannedActions,
    /// The next best plans, which differ, best first.
    runners_up: Vec<PlannedActions>,
    /// Whether the plan is safe, as far as it was checked.
    safe: bool,
    /// Why no plan is safe; absent if the plan is.
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<UnsafeReason>,
    /// The same in words.
    #[serde(skip_serializing_if = "Option::is_none")]
    detail: Option<String>,
    /// Whether the way was checked against what the depth network sees in the last frame, and, if the model finds movers, against
    /// where they will be. It knows nothing of what is beside or behind the camera.
    clearance_checked: bool,
    /// What stands in the way; absent unless it was asked for and checked.
    #[serde(skip_serializing_if = "Option::is_none")]
    obstacles: Option<ObstaclesBody>,
    /// How unlike the training data frames, state and the plan are, 0…1; absent if the model is not calibrated, or nothing was predicted.
    #[serde(skip_serializing_if = "Option::is_none")]
    novelty: Option<f32>,
    /// Plans that were judged.
    samples: usize,
    /// Plans whose frames were predicted.
    predicted: usize,
    /// Iterations of the solver that were judged whole.
    iterations: usize,
    /// How the images are encoded.
    format: ImageFormat,
    /// How long the search took, in milliseconds.
    time_ms: f64,
}

/// What a robot would touch: places in metres ahead and to the left of the robot now, in cells of 5 cm.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = PlanObstacles)]
struct ObstaclesBody {
    /// What stands.
    fixed_m: Vec<[f32; 2]>,
    /// Movers now, then after each step that is predicted; empty if the model does not find movers.
    movers_m: Vec<Vec<[f32; 2]>>,
}

impl From<&Obstacles> for ObstaclesBody {
    fn from(obstacles: &Obstacles) -> Self {
        Self {
            fixed_m: obstacles.fixed_m().to_vec(),
            movers_m: obstacles.movers_m().to_vec(),
        }
    }
}

impl PlanResponse {
    pub(super) fn new(
        form: PlanAnswerForm,
        manifest: &Manifest,
        choice: PlanChoice,
        took: Duration,
    ) -> Result<Self, ApiError> {
        let mut all = std::iter::once(&choice.best).chain(&choice.runners_up);
        let novelty = all.find_map(|candidate| candidate.rollout.as_ref()?.novelty);
        let others = choice.runners_up.into_iter();
        Ok(Self {
            model: manifest.name.to_string(),
            version: manifest.version,
            plan: PlannedActions::new(choice.best, form)?,
            runners_up: others
                .map(|other| PlannedActions::new(other, form))
                .collect::<Result<_, _>>()?,
            safe: choice.unsafe_reason.is_none(),
            reason: choice.unsafe_reason,
            detail: choice.unsafe_reason.map(|reason| reason.to_string()),
            clearance_checked: choice.clearance_checked,
            obstacles: (form.with_obstacles && choice.clearance_checked).then(|| (&choice.obstacles).into()),
            novelty,
            samples: choice.samples,
            predicted: choice.predicted,
            iterations: choice.iterations,
            format: form.format,
            time_ms: took.as_secs_f64() * 1000.0,
        })
    }
}
