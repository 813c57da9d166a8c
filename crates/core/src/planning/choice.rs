//! The answer: the best plan, those after it, and whether it is safe as far as can be told.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::cost::PlanCost;
use super::obstacles::Obstacles;
use crate::serving::Rollout;
use crate::types::Action;

/// Where a plan comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum CandidateKind {
    /// Stopping: every action is 0, or as near to it as the largest changes allow.
    Stop,
    /// The plan that the robot follows now.
    Present,
    /// The solver drew it.
    Drawn,
}

/// A plan with what is expected under it.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanCandidate {
    /// Where it comes from.
    pub kind: CandidateKind,
    /// Its actions.
    pub actions: Vec<Action>,
    /// The weighted sum of its costs.
    pub total: f32,
    /// The value of each cost, not weighted.
    pub costs: Vec<(PlanCost, f32)>,
    /// Yaw, ahead and left since the last frame after each action, in radians and metres; `None` if the actions are no speeds.
    pub motion: Option<Vec<[f32; 3]>>,
    /// The least distance from the robot's footprint to what the last frame shows and to where movers will be, in metres; `None` if
    /// that is not known.
    pub clearance_m: Option<f32>,
    /// What the camera is predicted to show; `None` if there was no time to predict it.
    pub rollout: Option<Rollout>,
    /// How unlike the training data frames, state and actions are, 0…1. Without a prediction, it is the novelty of stopping, which was
    /// predicted, or that of the plan's own actions, whichever is higher; `None` if the model is not calibrated, or nothing was predicted.
    pub novelty: Option<f32>,
}

/// Why no plan is safe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum UnsafeReason {
    /// Under every plan, the robot would touch what the last frame shows, or a mover.
    NoFreeWay,
    /// Frames, state or actions are unlike the training data, so that predictions say nothing.
    UnknownSurroundings,
    /// The time was over before any plan was judged.
    NoTime,
}

impl fmt::Display for UnsafeReason {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::NoFreeWay => "under every plan, the robot would touch what the last frame shows, or a mover",
            Self::UnknownSurroundings => "the frames, the state or the actions are unlike the training data",
            Self::NoTime => "the time was over before any plan was judged",
        })
    }
}

/// The answer of a search.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanChoice {
    /// The plan to follow; stopping if no plan is safe.
    pub best: PlanCandidate,
    /// The next best ones, which differ from it and from each other, best first.
    pub runners_up: Vec<PlanCandidate>,
    /// Why no plan is safe; `None` if the best one is, as far as it was checked.
    pub unsafe_reason: Option<UnsafeReason>,
    /// Whether the way was checked against what the depth network sees.
    pub clearance_checked: bool,
    /// What stands in the way, and where movers will be.
    pub obstacles: Obstacles,
    /// Plans that were judged.
    pub samples: usize,
    /// Plans whose frames were predicted.
    pub predicted: usize,
    /// Iterations of the solver that were judged whole.
    pub iterations: usize,
}
