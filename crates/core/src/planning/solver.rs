//! Which plans to try next. A solver draws plans around what it knows, and learns from their costs. Everything it draws follows
//! from its seed.

mod cem;
mod mppi;
mod noise;
mod shooting;

pub(super) use cem::Cem;
pub(super) use mppi::Mppi;
pub(super) use shooting::RandomShooting;

use super::limits::{ActionLimit, ActionLimits};
use crate::types::Seed;

/// How smooth the noise is if nothing else is asked for.
pub(super) const NOISE_COLOR: f32 = 2.0;

/// The plans that a search is about. A plan is a list of numbers: all channels of the first action, then those of the next.
#[derive(Clone, Debug)]
pub struct SearchSpace {
    /// Actions of a plan.
    pub steps: usize,
    /// The limits of each action.
    pub limits: ActionLimits,
    /// The plan around which the search begins: the present one, or the middle of the limits.
    pub start: Vec<f32>,
    /// All that is drawn follows from it.
    pub seed: Seed,
    /// How smooth the noise is: the power of a frequency falls with this exponent. 0 is white noise.
    pub noise_color: f32,
}

/// Draws plans and learns from their costs.
pub trait Solver: Send {
    /// The next `count` plans, within the limits.
    fn propose(&mut self, count: usize) -> Vec<Vec<f32>>;

    /// Takes the costs of plans that were tried since the last call; the lower, the better.
    fn learn(&mut self, scored: &[(Vec<f32>, f32)]);
}

impl SearchSpace {
    /// Plans of `steps` actions within these limits, from the present one on; its last action is held, and without one, the search
    /// begins in the middle of the limits.
    #[must_use]
    pub fn within(channels: &[ActionLimit], steps: usize, present: &[f32], seed: Seed) -> Self {
        let limits = ActionLimits::of_channels(channels.to_vec());
        let held = present.rchunks_exact(channels.len()).next();
        let start = match held {
            None => Self::middle(&limits, steps),
            Some(held) => {
                let numbers = present.iter().chain(held.iter().cycle());
                numbers.take(steps * channels.len()).copied().collect()
            }
        };
        Self {
            steps,
            limits,
            start,
            seed,
            noise_color: NOISE_COLOR,
        }
    }

    /// Numbers of a plan.
    #[must_use]
    pub fn len(&self) -> usize {
        self.steps * self.limits.channels().len()
    }

    /// Whether a plan has no numbers.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Half of the range of each number.
    fn half_ranges(&self) -> Vec<f32> {
        let half = self
            .limits
            .channels()
            .iter()
            .map(|limit| (limit.high - limit.low) / 2.0);
        half.cycle().take(self.len()).collect()
    }

    /// The middle of the range of each number.
    pub(super) fn middle(limits: &ActionLimits, steps: usize) -> Vec<f32> {
        let middle = limits
            .channels()
            .iter()
            .map(|limit| f32::midpoint(limit.low, limit.high));
        middle.cycle().take(steps * limits.channels().len()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serving::test_model;

    const STEPS: usize = 6;

    fn space(seed: u64) -> SearchSpace {
        let limit = ActionLimit {
            low: -1.0,
            high: 1.0,
            max_change: None,
        };
        SearchSpace {
            steps: STEPS,
            limits: ActionLimits::new(Some(vec![limit]), None, &test_model().manifest).unwrap(),
            start: vec![0.0; STEPS],
            seed: Seed(seed),
            noise_color: 1.0,
        }
    }

    /// Lowest, 0, at one plan inside the limits.
    fn cost(plan: &[f32]) -> f32 {
        let best = [0.5, 0.6, 0.4, 0.1, -0.2, -0.5];
        plan.iter().zip(best).map(|(value, best)| (value - best).powi(2)).sum()
    }

    fn lowest(mut solver: impl Solver, iterations: usize) -> f32 {
        let mut lowest = f32::INFINITY;
        for _ in 0..iterations {
            let plans = solver.propose(64);
            assert!(plans.iter().flatten().all(|value| (-1.0..=1.0).contains(value)));
            let scored: Vec<(Vec<f32>, f32)> = plans
                .into_iter()
                .map(|plan| {
                    let cost = cost(&plan);
                    (plan, cost)
                })
                .collect();
            lowest = scored.iter().fold(lowest, |least, (_, cost)| least.min(*cost));
            solver.learn(&scored);
        }
        lowest
    }

    #[test]
    fn each_solver_finds_the_best_plan_of_a_known_cost() {
        let at_start = cost(&[0.0; STEPS]);
        let found = [
            lowest(RandomShooting::new(space(1)), 12),
            lowest(Cem::new(space(1)), 12),
            lowest(Mppi::new(space(1), 0.3), 12),
        ];
        assert!(found[0] < 0.5 * at_start, "{found:?}");
        assert!(found[1] < 0.01 * at_start, "{found:?}");
        assert!(found[2] < 0.1 * at_start, "{found:?}");
    }

    #[test]
    fn the_same_seed_draws_the_same_plans() {
        let drawn = |seed| {
            let mut solvers: [Box<dyn Solver>; 3] = [
                Box::new(RandomShooting::new(space(seed))),
                Box::new(Cem::new(space(seed))),
                Box::new(Mppi::new(space(seed), 0.3)),
            ];
            solvers.each_mut().map(|solver| {
                let first = solver.propose(5);
                let scored: Vec<_> = first.iter().map(|plan| (plan.clone(), cost(plan))).collect();
                solver.learn(&scored);
                (first, solver.propose(5))
            })
        };
        assert_eq!(drawn(3), drawn(3));
        assert_ne!(drawn(3), drawn(4));
    }
}
