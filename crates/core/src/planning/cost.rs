//! What a plan costs: small functions, each with a name, a unit and a weight. The cost of a plan is their weighted sum.

use serde::{Deserialize, Serialize};

use super::goal::Goal;
use super::limits::ActionLimits;
use crate::frame::preprocess::scale;
use crate::frame::quality::mse;
use crate::named_enum;
use crate::serving::Rollout;

/// Added to the clearance that is lacking where the robot would touch something, in metres.
const TOUCH_M: f32 = 1.0;

named_enum! {
    /// One of the costs.
    #[derive(PartialOrd, Ord, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "snake_case")]
    pub enum PlanCost {
        /// Distance from the plan's end to the goal's position, in metres.
        GoalDistance = "goal_distance",
        /// Angle between the heading at the plan's end and the goal's, in radians.
        GoalHeading = "goal_heading",
        /// Root of the mean squared difference between the last predicted frame and the goal's image, intensities 0…1. In the simulator,
        /// pixels pick the right plan as often as a codec's features, and more often than blurred pixels (`tests/it/goal_image.rs`).
        GoalImage = "goal_image",
        /// What is lacking to the wanted clearance where the way is narrowest, in metres; 1 m more if the robot would touch something.
        Clearance = "clearance",
        /// Mean squared change of the actions from step to step, as a share of their range.
        Smoothness = "smoothness",
        /// Mean over the steps of the upper end of the 90 % band of the expected error, intensities 0…1.
        ExpectedError = "expected_error",
        /// How unlike the training data the context is, 0…1. The same for all plans of a context.
        Novelty = "novelty",
    }
}

/// A cost with its weight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CostTerm {
    /// The cost.
    pub cost: PlanCost,
    /// What one unit of it counts.
    pub weight: f32,
}

impl PlanCost {
    /// Its unit; empty where it has none.
    #[must_use]
    pub fn unit(self) -> &'static str {
        match self {
            Self::GoalDistance | Self::Clearance => "m",
            Self::GoalHeading => "rad",
            Self::GoalImage | Self::Smoothness | Self::ExpectedError | Self::Novelty => "",
        }
    }

    /// What one unit of it counts if nothing else is asked for.
    #[must_use]
    pub fn default_weight(self) -> f32 {
        match self {
            Self::GoalDistance | Self::ExpectedError => 1.0,
            Self::GoalHeading => 0.3,
            Self::GoalImage => 10.0,
            Self::Clearance => 5.0,
            Self::Smoothness => 0.05,
            Self::Novelty => 0.1,
        }
    }

    /// Whether it is computed from the predicted frames.
    #[must_use]
    pub fn needs_rollout(self) -> bool {
        matches!(self, Self::GoalImage | Self::ExpectedError | Self::Novelty)
    }

    /// Its value for a plan; `None` while what it is computed from is not known.
    pub(super) fn value(self, future: &PlanFuture<'_>) -> Option<f32> {
        match self {
            Self::GoalDistance => goal_distance(future),
            Self::GoalHeading => goal_heading(future),
            Self::GoalImage => goal_image(future),
            Self::Clearance => clearance(future),
            Self::Smoothness => Some(smoothness(future)),
            Self::ExpectedError => expected_error(future),
            Self::Novelty => future.rollout?.novelty,
        }
    }
}

/// What is expected to happen under a plan, as far as it is known.
pub(super) struct PlanFuture<'a> {
    pub(super) goal: &'a Goal,
    /// The goal's image, intensities 0…1.
    pub(super) goal_pixels: Option<&'a [f32]>,
    pub(super) limits: &'a ActionLimits,
    /// All actions.
    pub(super) plan: &'a [f32],
    /// Yaw, ahead and left after each step.
    pub(super) motion: Option<&'a [[f32; 3]]>,
    /// The least distance to an obstacle on the way, in metres.
    pub(super) clearance_m: Option<f32>,
    /// The distance that is wanted.
    pub(super) margin_m: f32,
    /// Whether the robot would touch something.
    pub(super) touches: bool,
    pub(super) rollout: Option<&'a Rollout>,
}

fn goal_distance(future: &PlanFuture<'_>) -> Option<f32> {
    let [_, ahead, left] = future.motion?.last()?;
    let [goal_ahead, goal_left] = future.goal.position_m?;
    Some((goal_ahead - ahead).hypot(goal_left - left))
}

fn goal_heading(future: &PlanFuture<'_>) -> Option<f32> {
    use std::f32::consts::{PI, TAU};
    let [yaw, _, _] = future.motion?.last()?;
    let difference = future.goal.heading_rad? - yaw;
    Some(((difference + PI).rem_euclid(TAU) - PI).abs())
}

fn goal_image(future: &PlanFuture<'_>) -> Option<f32> {
    let last = scale(future.rollout?.frames.last()?.pixels());
    Some(mse(&last, future.goal_pixels?).sqrt() as f32)
}

fn clearance(future: &PlanFuture<'_>) -> Option<f32> {
    let lacking = (future.margin_m - future.clearance_m?).max(0.0);
    Some(lacking + if future.touches { TOUCH_M } else { 0.0 })
}

fn smoothness(future: &PlanFuture<'_>) -> f32 {
    let channels = future.limits.channels();
    let shares = future.plan.chunks_exact(channels.len());
    let changes = shares.clone().zip(shares.skip(1)).flat_map(|(one, next)| {
        let pairs = one.iter().zip(next).zip(channels);
        pairs.map(|((one, next), limit)| ((next - one) / (limit.high - limit.low).max(f32::MIN_POSITIVE)).powi(2))
    });
    let (sum, count) = changes.fold((0.0, 0u32), |(sum, count), change| (sum + change, count + 1));
    sum / count.max(1) as f32
}

fn expected_error(future: &PlanFuture<'_>) -> Option<f32> {
    let errors = &future.rollout?.errors;
    let sum: f32 = errors.iter().map(|error| error.high).sum();
    (!errors.is_empty()).then(|| sum / errors.len() as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Frame;
    use crate::planning::limits::ActionLimit;
    use crate::serving::test_model;

    #[test]
    fn each_cost_has_the_value_that_its_unit_says() {
        let limit = ActionLimit {
            low: 0.0,
            high: 2.0,
            max_change: None,
        };
        let limits = ActionLimits::new(Some(vec![limit]), None, &test_model().manifest).unwrap();
        let goal = Goal {
            position_m: Some([1.0, 1.0]),
            heading_rad: Some(3.0),
            image: None,
        };
        let frame = Frame::new(6, 4, vec![51; 24]).unwrap();
        let goal_pixels = [0.0; 24];
        let rollout = Rollout {
            frames: vec![frame],
            novelty: Some(0.4),
            ..Rollout::default()
        };
        let future = PlanFuture {
            goal: &goal,
            goal_pixels: Some(&goal_pixels),
            limits: &limits,
            plan: &[0.0, 1.0, 1.0],
            motion: Some(&[[0.0, 0.5, 0.0], [-3.0, 0.4, 0.2]]),
            clearance_m: Some(0.05),
            margin_m: 0.2,
            touches: false,
            rollout: Some(&rollout),
        };
        let value = |cost: PlanCost| cost.value(&future);
        let is = |cost, expected: f32| {
            let found = value(cost).unwrap();
            assert!((found - expected).abs() < 1e-3, "{cost:?} {found}");
        };
        is(PlanCost::GoalDistance, 1.0);
        is(PlanCost::GoalHeading, std::f32::consts::TAU - 6.0);
        is(PlanCost::GoalImage, 0.2);
        is(PlanCost::Clearance, 0.15);
        is(PlanCost::Smoothness, 0.125);
        is(PlanCost::Novelty, 0.4);
        assert_eq!(value(PlanCost::ExpectedError), None, "the model is not calibrated");
        let touching = PlanFuture {
            touches: true,
            ..future
        };
        assert!((PlanCost::Clearance.value(&touching).unwrap() - 1.15).abs() < 1e-6);
    }
}
