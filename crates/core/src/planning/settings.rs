//! How a plan is searched for.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::cost::{CostTerm, PlanCost};
use super::error::PlanError;
use super::goal::Goal;
use super::limits::ActionLimit;
use super::solver::{Cem, Mppi, NOISE_COLOR, RandomShooting, SearchSpace, Solver};
use crate::named_enum;
use crate::registry::Manifest;
use crate::types::Seed;

named_enum! {
    /// How the next plans are chosen.
    #[derive(Default, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "kebab-case")]
    pub enum SolverKind {
        /// Plans from the whole range, without learning.
        RandomShooting = "random-shooting",
        /// The cross-entropy method, with coloured noise and kept elites (iCEM).
        #[default]
        Cem = "cem",
        /// Model predictive path integral control, from the present plan on.
        Mppi = "mppi",
    }
    else |name| -> String { format!("there is no solver {name:?}; there are: {}", Self::ALL.map(Self::name).join(", ")) }
}

/// How plans are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SolverSettings {
    /// How the next plans are chosen.
    pub kind: SolverKind,
    /// Plans of an iteration.
    #[cfg_attr(feature = "schema", schema(minimum = 1, maximum = 4096))]
    pub samples: usize,
    /// How often the solver learns from the costs and draws again.
    #[cfg_attr(feature = "schema", schema(minimum = 1, maximum = 32))]
    pub iterations: usize,
    /// Everything that is drawn follows from it: the same plans are tried if there is time for them.
    pub seed: u64,
    /// How smooth the drawn actions are: 0 is white noise, 2 and more change slowly.
    #[cfg_attr(feature = "schema", schema(minimum = 0, maximum = 8))]
    pub noise_color: f32,
    /// Of `mppi`: the lower, the more only the best plans count; as a share of the costs' standard deviation.
    #[cfg_attr(feature = "schema", schema(minimum = 0.001, maximum = 100))]
    pub temperature: f32,
}

impl Default for SolverSettings {
    fn default() -> Self {
        Self {
            kind: SolverKind::Cem,
            samples: 256,
            iterations: 4,
            seed: 0,
            noise_color: NOISE_COLOR,
            temperature: 0.3,
        }
    }
}

impl SolverSettings {
    /// A solver that draws in this space.
    #[must_use]
    pub fn solver(&self, space: SearchSpace) -> Box<dyn Solver> {
        match self.kind {
            SolverKind::RandomShooting => Box::new(RandomShooting::new(space)),
            SolverKind::Cem => Box::new(Cem::new(space)),
            SolverKind::Mppi => Box::new(Mppi::new(space, self.temperature)),
        }
    }

    /// The seed of everything that is drawn.
    #[must_use]
    pub fn seed(&self) -> Seed {
        Seed(self.seed)
    }
}

/// How a plan is searched for, and what counts.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanSettings {
    /// How plans are drawn.
    pub solver: SolverSettings,
    /// Weights of the costs; a cost that is not named has its default weight if it can be computed. 0 leaves a cost out.
    pub costs: BTreeMap<PlanCost, f32>,
    /// Limits of the action channels; without them, the ranges of the training.
    pub limits: Option<Vec<ActionLimit>>,
    /// Actions of a plan; without it, the model's horizon.
    pub steps: Option<usize>,
    /// The time for all of it; the best plan so far is the answer.
    pub budget: Option<Duration>,
    /// How many of the best plans are predicted and compared at the end.
    pub finalists: usize,
    /// Whether plans are predicted. If not, only stopping is, which tells what stands around the robot: the fastest search. Plans
    /// are then judged by their ways alone, without expected errors and novelty. A goal image needs predictions in any case.
    #[doc(hidden)]
    pub predicts_plans: bool,
    /// Radius of the robot's round footprint, in metres.
    pub radius_m: f32,
    /// The distance that the robot should keep, in metres.
    pub margin_m: f32,
    /// The robot's height, in metres: under what is higher, it passes.
    pub robot_height_m: f32,
}

impl Default for PlanSettings {
    fn default() -> Self {
        Self {
            solver: SolverSettings::default(),
            costs: BTreeMap::new(),
            limits: None,
            steps: None,
            budget: None,
            finalists: 4,
            predicts_plans: true,
            radius_m: 0.18,
            margin_m: 0.15,
            robot_height_m: 0.6,
        }
    }
}

impl PlanSettings {
    /// Errors: `OutOfRange`.
    pub(super) fn check(&self) -> Result<(), PlanError> {
        let solver = &self.solver;
        let budget = self.budget.map_or(1.0, |budget| budget.as_secs_f64() * 1000.0);
        let ranges = [
            ("solver.samples", solver.samples as f64, [1.0, 4096.0]),
            ("solver.iterations", solver.iterations as f64, [1.0, 32.0]),
            ("solver.noise_color", f64::from(solver.noise_color), [0.0, 8.0]),
            ("solver.temperature", f64::from(solver.temperature), [1e-3, 100.0]),
            ("budget_ms", budget, [1.0, 10_000.0]),
            ("finalists", self.finalists as f64, [1.0, 64.0]),
            ("radius_m", f64::from(self.radius_m), [0.0, 5.0]),
            ("margin_m", f64::from(self.margin_m), [0.0, 5.0]),
            ("robot_height_m", f64::from(self.robot_height_m), [0.15, 5.0]),
        ];
        let of_costs = self
            .costs
            .iter()
            .map(|(cost, weight)| (cost.name(), f64::from(*weight), [0.0, 1e6]));
        let outside = |(_, value, [least, most]): &(&str, f64, [f64; 2])| !(least..=most).contains(&value);
        match ranges.into_iter().chain(of_costs).find(outside) {
            None => Ok(()),
            Some((field, value, [least, most])) => Err(PlanError::OutOfRange {
                field: field.to_owned(),
                value,
                range: format!("{least} to {most}"),
            }),
        }
    }

    /// The costs that count. `has_motion`: the model's actions are speeds. Errors: `CostUnavailable` if one that is asked for cannot
    /// be computed, `NoMotion`.
    pub(super) fn terms(&self, goal: &Goal, has_motion: bool, manifest: &Manifest) -> Result<Vec<CostTerm>, PlanError> {
        let parts = [
            ("position_m", goal.position_m.is_some()),
            ("heading_rad", goal.heading_rad.is_some()),
        ];
        if let Some((field, _)) = parts.into_iter().find(|(_, is_given)| *is_given && !has_motion) {
            return Err(PlanError::NoMotion {
                field,
                model: manifest.name.clone(),
            });
        }
        let sees_depth = manifest.spec.flow().is_some_and(|flow| flow.layers.depth);
        let missing = |cost| match cost {
            PlanCost::GoalDistance if goal.position_m.is_none() => Some("the goal has no position_m"),
            PlanCost::GoalHeading if goal.heading_rad.is_none() => Some("the goal has no heading_rad"),
            PlanCost::GoalImage if goal.image.is_none() => Some("the goal has no image"),
            PlanCost::Clearance if !sees_depth => Some("the model estimates no depth"),
            PlanCost::Clearance if !has_motion => Some("the model's actions are not speeds"),
            PlanCost::ExpectedError | PlanCost::Novelty if manifest.calibration.is_none() => {
                Some("the model is not calibrated")
            }
            _ => None,
        };
        let mut terms = Vec::new();
        for cost in PlanCost::ALL {
            let asked = self.costs.get(&cost).copied();
            match missing(cost) {
                Some(reason) if asked.is_some_and(|weight| weight > 0.0) => {
                    return Err(PlanError::CostUnavailable {
                        cost: cost.name(),
                        reason,
                    });
                }
                Some(_) => {}
                None => {
                    let weight = asked.unwrap_or_else(|| cost.default_weight());
                    if weight > 0.0 {
                        terms.push(CostTerm { cost, weight });
                    }
                }
            }
        }
        Ok(terms)
    }
}
