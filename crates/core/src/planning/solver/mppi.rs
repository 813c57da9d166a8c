//! Model predictive path integral control (Williams et al. 2017): the next mean is that of all plans, weighted by their costs. It
//! starts at the present plan.

use super::noise::of_plan;
use super::{SearchSpace, Solver};

/// Spread of the plans, as a share of the half range.
const SPREAD: f32 = 0.5;
/// By how much the spread falls with each iteration.
const NARROWING: f32 = 0.8;

/// Draws around a weighted mean.
pub(in crate::planning) struct Mppi {
    space: SearchSpace,
    mean: Vec<f32>,
    /// As a share of the costs' standard deviation: the lower, the more only the best plans count.
    temperature: f32,
    drawn: u64,
}

impl Mppi {
    pub(in crate::planning) fn new(space: SearchSpace, temperature: f32) -> Self {
        Self {
            mean: space.start.clone(),
            temperature,
            drawn: 0,
            space,
        }
    }
}

impl Solver for Mppi {
    fn propose(&mut self, count: usize) -> Vec<Vec<f32>> {
        let space = &self.space;
        let mut random = space.seed.derive("mppi", self.drawn).rng();
        let spread = SPREAD * NARROWING.powf(self.drawn as f32);
        self.drawn += 1;
        let half = space.half_ranges();
        let shape = [space.steps, space.limits.channels().len()];
        let one = |index: usize| {
            let mut plan = self.mean.clone();
            // The mean itself is one of the plans.
            if index > 0 {
                let noise = of_plan(&mut random, shape, space.noise_color);
                for ((value, noise), half) in plan.iter_mut().zip(noise).zip(&half) {
                    *value += spread * half * noise;
                }
            }
            space.limits.enforce(&mut plan);
            plan
        };
        (0..count).map(one).collect()
    }

    fn learn(&mut self, scored: &[(Vec<f32>, f32)]) {
        let scored: Vec<&(Vec<f32>, f32)> = scored.iter().filter(|(_, cost)| cost.is_finite()).collect();
        let count = scored.len() as f32;
        let mean = scored.iter().map(|(_, cost)| cost).sum::<f32>() / count;
        let variance = scored.iter().map(|(_, cost)| (cost - mean).powi(2)).sum::<f32>() / count;
        let least = scored.iter().map(|(_, cost)| *cost).fold(f32::INFINITY, f32::min);
        let scale = (self.temperature * variance.sqrt()).max(f32::MIN_POSITIVE);
        let weights: Vec<f32> = scored.iter().map(|(_, cost)| (-(cost - least) / scale).exp()).collect();
        let sum: f32 = weights.iter().sum();
        if !(sum > 0.0 && sum.is_finite()) {
            return;
        }
        for (index, value) in self.mean.iter_mut().enumerate() {
            let weighted = scored
                .iter()
                .zip(&weights)
                .map(|((plan, _), weight)| plan[index] * weight);
            *value = weighted.sum::<f32>() / sum;
        }
    }
}
