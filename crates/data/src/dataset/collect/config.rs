//! What is collected, and how far a collection is.

use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::dataset::error::DatasetError;
use foreframe_core::types::Seed;
use foreframe_sim::{Scenario, WorldConfig};

/// Default number of trials in a shard.
pub const DEFAULT_TRIALS_PER_SHARD: u64 = 50;

/// Settings of a collection.
#[derive(Clone, Debug, PartialEq)]
pub struct CollectConfig {
    /// The scenario.
    pub scenario: Scenario,
    /// Number of trials. Trials are numbered from 0.
    pub trials: u64,
    /// The seed from which the seed of every trial is derived.
    pub seed: Seed,
    /// The data set's directory.
    pub out: PathBuf,
    /// Settings of the simulated world.
    pub world: WorldConfig,
    /// Number of simulation threads; 0 for the number of cores.
    pub threads: usize,
    /// Number of trials in a shard.
    pub trials_per_shard: u64,
}

impl CollectConfig {
    /// A collection of this many trials of a scenario, with default values for all other settings.
    #[must_use]
    pub fn new(scenario: Scenario, trials: u64, seed: Seed, out: &Path) -> Self {
        Self {
            scenario,
            trials,
            seed,
            out: out.to_owned(),
            world: WorldConfig::default(),
            threads: 0,
            trials_per_shard: DEFAULT_TRIALS_PER_SHARD,
        }
    }

    /// Checks the settings. Errors: `Zero`, `World`.
    pub fn validate(&self) -> Result<(), DatasetError> {
        for (what, value) in [
            ("the number of trials", self.trials),
            ("the number of trials in a shard", self.trials_per_shard),
        ] {
            if value == 0 {
                return Err(DatasetError::Zero { what });
            }
        }
        self.world.validate().map_err(DatasetError::World)
    }

    /// Number of shards.
    pub(crate) fn shard_count(&self) -> usize {
        self.trials.div_ceil(self.trials_per_shard) as usize
    }

    /// The trials of a shard.
    pub(crate) fn shard_trials(&self, shard: usize) -> Range<u64> {
        let first = shard as u64 * self.trials_per_shard;
        first..(first + self.trials_per_shard).min(self.trials)
    }

    pub(crate) fn thread_count(&self) -> usize {
        match self.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            threads => threads,
        }
    }
}

/// How far a collection is, in trials.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CollectProgress {
    /// Simulated trials, including those found on disk when the collection was resumed.
    pub done: u64,
    /// Requested trials.
    pub total: u64,
}
