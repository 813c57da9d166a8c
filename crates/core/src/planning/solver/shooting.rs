//! Random shooting: plans from the whole range, without learning.

use super::noise::of_plan;
use super::{SearchSpace, Solver};

/// Draws around the middle of the limits, as widely as they allow.
pub(in crate::planning) struct RandomShooting {
    space: SearchSpace,
    drawn: u64,
}

impl RandomShooting {
    pub(in crate::planning) fn new(space: SearchSpace) -> Self {
        Self { space, drawn: 0 }
    }
}

impl Solver for RandomShooting {
    fn propose(&mut self, count: usize) -> Vec<Vec<f32>> {
        let space = &self.space;
        let mut random = space.seed.derive("shooting", self.drawn).rng();
        self.drawn += 1;
        let (middle, half) = (SearchSpace::middle(&space.limits, space.steps), space.half_ranges());
        let shape = [space.steps, space.limits.channels().len()];
        let one = |_| {
            let noise = of_plan(&mut random, shape, space.noise_color);
            let mut plan: Vec<f32> = (noise.iter().zip(&half).zip(&middle))
                .map(|((noise, half), middle)| middle + half * noise)
                .collect();
            space.limits.enforce(&mut plan);
            plan
        };
        (0..count).map(one).collect()
    }

    fn learn(&mut self, _scored: &[(Vec<f32>, f32)]) {}
}
