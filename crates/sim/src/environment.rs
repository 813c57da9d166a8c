//! The Gymnasium interface of a [`World`]: `reset` starts an episode, `step` acts in it.

use super::config::WorldConfig;
use super::error::SimError;
use super::scenario::{Scenario, TrialParameters};
use super::world::{Observation, StepResult, World};
use foreframe_core::types::{Action, Seed};

/// An environment for one scenario. It runs one trial after another.
pub struct Environment {
    scenario: Scenario,
    config: WorldConfig,
    seed: Seed,
    next_trial: u64,
    world: Option<World>,
}

impl Environment {
    /// An environment before its first reset. Errors: as [`WorldConfig::validate`].
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

    /// Starts an episode. With a seed, it is the seed's first trial; without a seed, the next trial of the current seed
    /// (initially 0). Returns the first observation and the trial's parameters (Gymnasium's `info`). Errors: as
    /// [`World::new`].
    pub fn reset(&mut self, seed: Option<Seed>) -> Result<(Observation, TrialParameters), SimError> {
        if let Some(seed) = seed {
            self.seed = seed;
            self.next_trial = 0;
        }
        let world = World::new(self.scenario, &self.config, self.seed, self.next_trial)?;
        self.next_trial += 1;
        let first = (world.observe(), world.parameters().clone());
        self.world = Some(world);
        Ok(first)
    }

    /// Simulates one frame period with this action. Errors: `NotReset` before the first reset, and as [`World::step`].
    pub fn step(&mut self, action: &Action) -> Result<StepResult, SimError> {
        self.world.as_mut().ok_or(SimError::NotReset)?.step(action)
    }

    /// The current trial, for example for the policy's action or the true poses.
    #[must_use]
    pub fn world(&self) -> Option<&World> {
        self.world.as_ref()
    }
}
