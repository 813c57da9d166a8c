//! What is known of a plan, and what it costs.

use super::choice::{CandidateKind, PlanCandidate};
use super::cost::{CostTerm, PlanCost, PlanFuture};
use super::error::PlanError;
use super::goal::Goal;
use super::limits::ActionLimits;
use super::obstacles::Obstacles;
use super::settings::PlanSettings;
use crate::frame::preprocess::scale;
use crate::frame::warp::CameraModel;
use crate::nn::spec::MAX_STEPS;
use crate::nn::{NnError, Occupancy};
use crate::registry::Model;
use crate::serving::{ConditioningInput, Rollout, check_size};
use crate::types::{Action, RobotState};

/// A robot that stands nearer than this to something, in metres, may still drive away from it.
const DRIVES_AWAY_M: f32 = 0.01;

/// What a search starts from.
#[derive(Clone, Debug, Default)]
pub struct PlannerInput {
    /// What to reach.
    pub goal: Goal,
    /// How to search.
    pub settings: PlanSettings,
    /// The robot's state at the last frame, if the model takes it.
    pub state: Option<RobotState>,
    /// The camera, if it is another than the model's.
    pub camera: Option<CameraModel>,
    /// The plan that the robot follows now; its last action is held if it is shorter. Empty if there is none.
    pub present: Vec<Action>,
    /// The action before the plan, from which the first change is counted.
    pub before: Option<Action>,
}

/// A plan with what is known of it.
#[derive(Clone)]
pub(super) struct Tried {
    pub(super) kind: CandidateKind,
    pub(super) plan: Vec<f32>,
    pub(super) motion: Option<Vec<[f32; 3]>>,
    pub(super) clearance_m: Option<f32>,
    pub(super) touches: bool,
    pub(super) rollout: Option<Rollout>,
    /// The value of each term, in their order; `None` where it is not known.
    pub(super) values: Vec<Option<f32>>,
}

/// Judges the plans of one search.
pub(super) struct Judge {
    model: Model,
    pub(super) input: PlannerInput,
    pub(super) limits: ActionLimits,
    terms: Vec<CostTerm>,
    goal_pixels: Option<Vec<f32>>,
    obstacles: Option<Obstacles>,
    pub(super) steps: usize,
}

impl Judge {
    /// Errors: what of the goal, the settings or the limits is wrong, or does not fit the model.
    pub(super) fn new(model: &Model, input: PlannerInput) -> Result<Self, PlanError> {
        let (manifest, spec) = (&model.manifest, model.spec());
        let name = || manifest.name.clone();
        if spec.action_inputs().is_none() {
            return Err(PlanError::NoActions { model: name() });
        }
        input.goal.check()?;
        input.settings.check()?;
        let steps = input.settings.steps.unwrap_or(spec.horizon);
        if !(1..=MAX_STEPS).contains(&steps) {
            return Err(PlanError::OutOfRange {
                field: "steps".to_owned(),
                value: steps as f64,
                range: format!("1 to {MAX_STEPS}"),
            });
        }
        if let Some(image) = &input.goal.image {
            check_size("goal.image", manifest, (image.width(), image.height()))?;
        }
        let before = input.before.clone().map(Vec::from);
        let limits = ActionLimits::new(input.settings.limits.clone(), before, manifest)?;
        let channels = limits.channels().len();
        if let Some(action) = input.present.iter().find(|action| action.as_slice().len() != channels) {
            return Err(PlanError::Channels {
                field: "present".to_owned(),
                found: action.as_slice().len(),
                model: name(),
                expected: channels,
            });
        }
        let zeros = vec![Action::try_from(vec![0.0; channels]).expect("zeros that are no action is a bug"); steps];
        ConditioningInput::of_plans(vec![zeros], input.state.clone(), Some(steps), manifest)?;
        let has_motion = motion_of(model, &input, &vec![0.0; steps * channels], steps)?.is_some();
        let terms = input.settings.terms(&input.goal, has_motion, manifest)?;
        Ok(Self {
            model: model.clone(),
            goal_pixels: input.goal.image.as_ref().map(|image| scale(image.pixels())),
            input,
            limits,
            terms,
            obstacles: None,
            steps,
        })
    }

    /// Whether the search needs the frames of every plan.
    pub(super) fn needs_frames(&self) -> bool {
        self.terms.iter().any(|term| term.cost == PlanCost::GoalImage)
    }

    /// What stands in the way, if it is known.
    pub(super) fn obstacles(&self) -> Option<&Obstacles> {
        self.obstacles.as_ref()
    }

    /// Takes what stands around the robot.
    pub(super) fn see(&mut self, occupancy: &Occupancy) {
        let flow = self.model.spec().flow();
        let camera = self.input.camera.or(flow.and_then(|flow| flow.camera));
        let height_m = camera.and_then(|camera| camera.height_m);
        self.obstacles = Some(Obstacles::new(occupancy, height_m, self.input.settings.robot_height_m));
    }

    /// Stopping, which only the largest changes limit, and the present plan if there is one, within the limits.
    pub(super) fn fixed_plans(&self) -> Vec<Tried> {
        let channels = self.limits.channels().len();
        let mut stop = vec![0.0; self.steps * channels];
        self.limits.with_zero().enforce(&mut stop);
        let mut fixed = vec![Tried::new(CandidateKind::Stop, stop)];
        if let Some(held) = self.input.present.last() {
            let present = self.input.present.iter();
            let actions = present.chain(std::iter::repeat(held)).take(self.steps);
            let mut plan: Vec<f32> = actions.flat_map(Action::as_slice).copied().collect();
            self.limits.enforce(&mut plan);
            fixed.push(Tried::new(CandidateKind::Present, plan));
        }
        fixed
    }

    /// Computes what is known of plans and of their costs. Errors: `Motion`.
    pub(super) fn judge(&self, tried: &mut [Tried]) -> Result<(), PlanError> {
        let plans: Vec<f32> = tried.iter().flat_map(|tried| &tried.plan).copied().collect();
        if let Some(motions) = motion_of(&self.model, &self.input, &plans, self.steps)? {
            for (tried, motion) in tried.iter_mut().zip(motions.chunks_exact(self.steps)) {
                tried.motion = Some(motion.to_vec());
            }
        }
        for tried in tried {
            self.judge_one(tried);
        }
        Ok(())
    }

    fn judge_one(&self, tried: &mut Tried) {
        let settings = &self.input.settings;
        if let (Some(obstacles), Some(motion)) = (&self.obstacles, &tried.motion) {
            let least = obstacles.least_clearance_m(motion, settings.radius_m);
            let standing = obstacles.clearance_m([0.0; 2], 0, settings.radius_m);
            tried.touches = least < 0.0 && least < standing - DRIVES_AWAY_M;
            tried.clearance_m = Some(least);
        }
        let future = PlanFuture {
            goal: &self.input.goal,
            goal_pixels: self.goal_pixels.as_deref(),
            limits: &self.limits,
            plan: &tried.plan,
            motion: tried.motion.as_deref(),
            clearance_m: tried.clearance_m,
            margin_m: settings.margin_m,
            touches: tried.touches,
            rollout: tried.rollout.as_ref(),
        };
        tried.values = self.terms.iter().map(|term| term.cost.value(&future)).collect();
    }

    /// The weighted sum of the costs that are known; without those of predicted frames unless `has_rollouts`.
    pub(super) fn total(&self, tried: &Tried, has_rollouts: bool) -> f32 {
        let counts = |term: &CostTerm| has_rollouts || !term.cost.needs_rollout();
        let terms = self.terms.iter().zip(&tried.values).filter(|(term, _)| counts(term));
        let known = terms.filter_map(|(term, value)| Some(term.weight * (*value)?));
        // An empty sum would be -0.
        0.0 + known.sum::<f32>()
    }

    /// Root mean square of the differences, as a share of the ranges.
    pub(super) fn difference(&self, one: &[f32], two: &[f32]) -> f32 {
        let channels = self.limits.channels().iter().cycle();
        let ranges = channels.map(|limit| (limit.high - limit.low).max(f32::MIN_POSITIVE));
        let squares = one
            .iter()
            .zip(two)
            .zip(ranges)
            .map(|((one, two), range)| ((one - two) / range).powi(2));
        (squares.sum::<f32>() / one.len() as f32).sqrt()
    }

    /// How unlike the training data a plan is, if `others`, of other plans from the same context, tell it where it was not predicted.
    pub(super) fn novelty(&self, tried: &Tried, others: Option<f32>) -> Option<f32> {
        let calibration = self.model.manifest.calibration.as_ref();
        let of_actions = || calibration.map_or(0.0, |known| known.novelty_of_actions(&tried.plan));
        tried.novelty().or_else(|| Some(others?.max(of_actions())))
    }

    pub(super) fn candidate(&self, tried: &Tried, has_rollouts: bool, novelty: Option<f32>) -> PlanCandidate {
        let values = self.terms.iter().zip(&tried.values);
        PlanCandidate {
            kind: tried.kind,
            actions: self.actions(&tried.plan),
            total: self.total(tried, has_rollouts),
            costs: values
                .filter_map(|(term, value)| Some((term.cost, (*value)?)))
                .collect(),
            motion: tried.motion.clone(),
            clearance_m: tried.clearance_m,
            rollout: tried.rollout.clone(),
            novelty,
        }
    }

    pub(super) fn actions(&self, plan: &[f32]) -> Vec<Action> {
        let action = |values: &[f32]| Action::try_from(values.to_vec()).expect("an action outside its limits is a bug");
        plan.chunks_exact(self.limits.channels().len()).map(action).collect()
    }
}

impl Tried {
    /// How unlike the training data it is; `None` if that is not known.
    pub(super) fn novelty(&self) -> Option<f32> {
        self.rollout.as_ref()?.novelty
    }

    pub(super) fn new(kind: CandidateKind, plan: Vec<f32>) -> Self {
        Self {
            kind,
            plan,
            motion: None,
            clearance_m: None,
            touches: false,
            rollout: None,
            values: Vec::new(),
        }
    }
}

/// Where plans lead; `None` if their actions are no speeds.
fn motion_of(
    model: &Model,
    input: &PlannerInput,
    plans: &[f32],
    steps: usize,
) -> Result<Option<Vec<[f32; 3]>>, NnError> {
    let state = input.state.as_ref().filter(|_| model.spec().state_inputs().is_some());
    let state = state.map_or(&[][..], RobotState::as_slice);
    model.network.commanded_motion(state, plans, steps)
}
