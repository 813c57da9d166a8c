//! The cross-entropy method (Rubinstein 1999), with iCEM's coloured noise and kept elites (Pinneri et al. 2020).

use super::noise::of_plan;
use super::{SearchSpace, Solver};

/// Share of the plans that the next ones are drawn around.
const ELITE_SHARE: f32 = 0.1;
/// Fewest elites.
const FEWEST_ELITES: usize = 4;
/// Share of the elites that are proposed again: their costs may differ if the context does.
const KEPT_SHARE: f32 = 0.3;
/// How much of the old mean and spread stays.
const MOMENTUM: f32 = 0.1;
/// Smallest spread, as a share of the half range.
const LEAST_SPREAD: f32 = 0.01;

/// Draws around the mean of the best plans, as widely as these differ.
pub(in crate::planning) struct Cem {
    space: SearchSpace,
    mean: Vec<f32>,
    spread: Vec<f32>,
    kept: Vec<Vec<f32>>,
    drawn: u64,
}

impl Cem {
    pub(in crate::planning) fn new(space: SearchSpace) -> Self {
        Self {
            mean: space.start.clone(),
            spread: space.half_ranges(),
            kept: Vec::new(),
            drawn: 0,
            space,
        }
    }
}

impl Solver for Cem {
    fn propose(&mut self, count: usize) -> Vec<Vec<f32>> {
        let space = &self.space;
        let mut random = space.seed.derive("cem", self.drawn).rng();
        let mut plans: Vec<Vec<f32>> = std::mem::take(&mut self.kept);
        if self.drawn > 0 {
            plans.push(self.mean.clone());
        }
        self.drawn += 1;
        plans.truncate(count);
        let shape = [space.steps, space.limits.channels().len()];
        while plans.len() < count {
            let noise = of_plan(&mut random, shape, space.noise_color);
            let plan =
                (noise.iter().zip(&self.spread).zip(&self.mean)).map(|((noise, spread), mean)| mean + spread * noise);
            plans.push(plan.collect());
        }
        for plan in &mut plans {
            space.limits.enforce(plan);
        }
        plans
    }

    fn learn(&mut self, scored: &[(Vec<f32>, f32)]) {
        let mut order: Vec<&(Vec<f32>, f32)> = scored.iter().filter(|(_, cost)| cost.is_finite()).collect();
        order.sort_by(|(_, one), (_, two)| one.total_cmp(two));
        let elites = ((scored.len() as f32 * ELITE_SHARE).ceil() as usize).max(FEWEST_ELITES);
        order.truncate(elites);
        if order.is_empty() {
            return;
        }
        let count = order.len() as f32;
        let half = self.space.half_ranges();
        for (index, half) in half.iter().enumerate() {
            let values = || order.iter().map(|(plan, _)| plan[index]);
            let mean = values().sum::<f32>() / count;
            let variance = values().map(|value| (value - mean).powi(2)).sum::<f32>() / count;
            let blend = |old: f32, new: f32| MOMENTUM * old + (1.0 - MOMENTUM) * new;
            self.mean[index] = blend(self.mean[index], mean);
            self.spread[index] = blend(self.spread[index], variance.sqrt()).max(LEAST_SPREAD * half);
        }
        let kept = (count * KEPT_SHARE).ceil() as usize;
        self.kept = order.iter().take(kept).map(|(plan, _)| plan.clone()).collect();
    }
}
