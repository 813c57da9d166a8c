//! What is collected, and how far a collection is.

use std::ops::Range;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::dataset::check::check_counts;
use crate::dataset::{DatasetError, DatasetInfo};
use foreframe_core::types::Seed;
use foreframe_sim::{Scenario, WorldConfig, action_channels, state_channels};

/// Default number of trials in a shard.
pub const DEFAULT_TRIALS_PER_SHARD: u64 = 50;

/// Settings of a collection. Those that determine its bytes are written to its directory, in this order.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CollectConfig {
    /// The scenario.
    pub scenario: Scenario,
    /// Number of trials. Trials are numbered from 0.
    pub trials: u64,
    /// The seed from which the seed of every trial is derived.
    pub seed: Seed,
    /// Number of trials in a shard.
    pub trials_per_shard: u64,
    /// Settings of the simulated world.
    pub world: WorldConfig,
    /// The data set's directory.
    #[serde(skip)]
    pub out: PathBuf,
    /// Number of simulation threads; 0 for the number of cores.
    #[serde(skip)]
    pub threads: usize,
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

    /// Checks the settings. Errors: `Usage`, `World`.
    pub fn validate(&self) -> Result<(), DatasetError> {
        check_counts(&[
            ("the number of trials", self.trials),
            ("the number of trials in a shard", self.trials_per_shard),
        ])?;
        self.world.validate().map_err(DatasetError::World)
    }

    /// The trials of each shard.
    pub(super) fn shards(&self) -> ShardTrials {
        ShardTrials {
            trials: self.trials,
            per_shard: self.trials_per_shard,
        }
    }

    pub(super) fn thread_count(&self) -> usize {
        match self.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            threads => threads,
        }
    }

    /// The description of the data set, without counts and hash.
    pub(super) fn info(&self) -> DatasetInfo {
        DatasetInfo {
            name: format!("{}-{}-seed-{}", self.scenario, self.trials, self.seed.0),
            frame_width_px: self.world.frame_width_px,
            frame_height_px: self.world.frame_height_px,
            frame_period_s: self.world.frame_period_s,
            action_channels: action_channels(),
            state_channels: state_channels(),
            scenario: Some(self.scenario.to_string()),
            seed: Some(self.seed),
            has_masks: true,
            // Where trials have their own cameras, no camera model is true of all.
            camera: self.world.rooms.is_none().then(|| self.world.camera.model()),
            world: Some(self.world.clone()),
            ..DatasetInfo::default()
        }
    }
}

/// How the trials of a collection are divided among shards.
#[derive(Clone, Copy)]
pub(super) struct ShardTrials {
    pub(super) trials: u64,
    pub(super) per_shard: u64,
}

impl ShardTrials {
    /// Number of shards.
    pub(super) fn count(self) -> usize {
        self.trials.div_ceil(self.per_shard) as usize
    }

    /// The trials of a shard.
    pub(super) fn of(self, shard: usize) -> Range<u64> {
        let first = shard as u64 * self.per_shard;
        first..(first + self.per_shard).min(self.trials)
    }

    /// Number of trials of a shard.
    pub(super) fn count_of(self, shard: usize) -> usize {
        self.of(shard).count()
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
