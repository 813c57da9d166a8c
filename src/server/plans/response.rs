//! What a search for a plan answers.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::server::http::problem::ApiError;
use crate::server::images::{self, ImageBytes, ImageFormat};
use foreframe_core::planning::{CandidateKind, Obstacles, PlanCandidate, PlanChoice, PlanCost, UnsafeReason};
use foreframe_core::registry::Manifest;

/// How an answer is given.
#[derive(Clone, Copy)]
pub(in crate::server) struct PlanForm {
    pub(in crate::server) format: ImageFormat,
    pub(in crate::server) with_frames: bool,
    pub(in crate::server) with_obstacles: bool,
}

/// A plan with what is expected under it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
struct PlannedActions {
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
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    way: Vec<[f32; 3]>,
    /// The least distance from the robot's footprint to what the last frame shows, in metres; below 0, it would touch it. Absent if
    /// that is not known, or nothing is seen.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    clearance_m: Option<f32>,
    /// The predicted frames t+1, t+2, …, if they were asked for and there was time.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    frames: Vec<ImageBytes>,
    /// The mean squared error to expect of each frame up to the model's horizon; in a session, it follows the session's own errors so
    /// far. Absent if it was not predicted, or the model is not calibrated.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    expected_mse: Vec<f32>,
}

impl PlannedActions {
    fn new(candidate: PlanCandidate, form: PlanForm) -> Result<Self, ApiError> {
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct PlanResponse {
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
    #[serde(default, skip_serializing_if = "Option::is_none")]
    reason: Option<UnsafeReason>,
    /// The same in words.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    detail: Option<String>,
    /// Whether the way was checked against what the depth network sees in the last frame, and, if the model finds movers, against
    /// where they will be. It knows nothing of what is beside or behind the camera.
    clearance_checked: bool,
    /// What stands in the way; absent unless it was asked for and checked.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    obstacles: Option<ObstaclesBody>,
    /// How unlike the training data frames, state and the plan to follow are, 0…1; absent if the model is not calibrated, or nothing was predicted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
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
    /// How long the search took.
    #[must_use]
    pub fn time(&self) -> Duration {
        Duration::from_secs_f64(self.time_ms / 1000.0)
    }

    /// About how large it is, in bytes.
    pub(in crate::server) fn bytes(&self) -> usize {
        let places = self.obstacles.as_ref().map_or(0, |obstacles| {
            obstacles.fixed_m.len() + obstacles.movers_m.iter().map(Vec::len).sum::<usize>()
        });
        let plans = std::iter::once(&self.plan).chain(&self.runners_up);
        let of_plans = plans.map(|plan| {
            let images: usize = plan.frames.iter().map(|frame| frame.0.len()).sum();
            images + plan.actions.iter().map(|action| 24 + 4 * action.len()).sum::<usize>() + 12 * plan.way.len()
        });
        of_plans.sum::<usize>() + 8 * places
    }

    pub(in crate::server) fn new(
        form: PlanForm,
        manifest: &Manifest,
        choice: PlanChoice,
        took: Duration,
    ) -> Result<Self, ApiError> {
        let novelty = choice.best.novelty;
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
