//! Gymnasium's face of a [`World`]: `reset` begins an episode, `step` acts in it.

use super::{Observation, Scenario, SimError, StepResult, TrialParameters, World, WorldConfig};
use crate::types::{Action, Seed};

/// An environment with one scenario, which runs one trial after another.
pub struct Environment {
    scenario: Scenario,
    config: WorldConfig,
    seed: Seed,
    next_trial: u64,
    world: Option<World>,
}

impl Environment {
    /// An environment that waits for its first reset. Errors: as [`WorldConfig::validate`].
    pub fn new(scenario: Scenario, config: WorldConfig) -> Result<Self, SimError> {
        config.validate()?;
        Ok(Self {
            scenario,
            config,
            seed: Seed(0),
            next_trial: 0,
            world: None,
        })
    }

    /// Begins an episode: with a seed the first of its sequence, without one the next of the present sequence (of seed 0
    /// at first). Returns what Tb1 sees and what was drawn, Gymnasium's `info`.
    pub fn reset(&mut self, seed: Option<Seed>) -> Result<(Observation, TrialParameters), SimError> {
        if let Some(seed) = seed {
            self.seed = seed;
            self.next_trial = 0;
        }
        let world = World::new(self.scenario, &self.config, self.seed, self.next_trial)?;
        self.next_trial += 1;
        let begun = (world.observe(), world.parameters().clone());
        self.world = Some(world);
        Ok(begun)
    }

    /// Acts for one frame period. Errors: `NotReset` before the first reset, and as [`World::step`].
    pub fn step(&mut self, action: &Action) -> Result<StepResult, SimError> {
        self.world.as_mut().ok_or(SimError::NotReset)?.step(action)
    }

    /// The trial that runs, for its own driver's action or its true poses.
    #[must_use]
    pub fn world(&self) -> Option<&World> {
        self.world.as_ref()
    }
}
