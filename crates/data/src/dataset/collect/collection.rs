//! The directory of a collection: how far it is, and how it is started, resumed and completed.

use std::fs::File;

use serde::Serialize;

use super::config::CollectConfig;
use super::unfinished;
use crate::dataset::store::arguments::{arguments_text, has_arguments, lock};
use crate::dataset::store::layout::{DatasetMetadata, INFO, shard_path};
use crate::dataset::store::shard::EncodedEpisode;
use crate::dataset::store::writer::ShardWriter;
use crate::dataset::{DatasetError, DatasetInfo};
use foreframe_core::types::Seed;
use foreframe_sim::{Scenario, WorldConfig, action_channels, state_channels};

/// The arguments that determine a collection's bytes. They are written to the directory first.
#[derive(Serialize)]
struct Arguments<'a> {
    program_version: &'static str,
    scenario: Scenario,
    trials: u64,
    seed: Seed,
    trials_per_shard: u64,
    world: &'a WorldConfig,
}

impl Arguments<'_> {
    fn text(config: &CollectConfig) -> Result<String, DatasetError> {
        let arguments = Arguments {
            program_version: env!("CARGO_PKG_VERSION"),
            scenario: config.scenario,
            trials: config.trials,
            seed: config.seed,
            trials_per_shard: config.trials_per_shard,
            world: &config.world,
        };
        arguments_text(&arguments)
    }
}

/// How far the collection in a directory is.
#[derive(Clone, Debug, PartialEq)]
pub enum CollectionStatus {
    /// Nothing has been written yet.
    New,
    /// Some trials may be saved, but not all.
    Unfinished {
        /// Saved trials.
        trials: u64,
    },
    /// The data set is complete.
    Finished(Box<DatasetInfo>),
}

impl CollectionStatus {
    /// How far the collection with this configuration is. Changes nothing.
    /// Errors: `OutExists`, `OtherArguments`, as [`collect()`](super::collect()).
    pub fn of(config: &CollectConfig) -> Result<Self, DatasetError> {
        let out = &config.out;
        if !has_arguments(out, &Arguments::text(config)?)? {
            return Ok(Self::New);
        }
        if out.join(INFO).exists() {
            return Ok(Self::Finished(Box::new(DatasetMetadata::read(out)?.info_in(out)?)));
        }
        let shards = config.shard_count();
        let complete = (0..shards)
            .take_while(|&shard| out.join(shard_path(shard)).exists())
            .count();
        let in_shards: u64 = (0..complete)
            .map(|shard| config.shard_trials(shard).count() as u64)
            .sum();
        let beside: u64 = (complete..shards)
            .map(|shard| unfinished::count(out, shard) as u64)
            .sum();
        Ok(Self::Unfinished {
            trials: in_shards + beside,
        })
    }
}

/// A collection that is being written.
pub(crate) struct Collection<'a> {
    config: &'a CollectConfig,
    writer: ShardWriter,
    /// Locks the directory while this process writes.
    _lock: File,
}

impl<'a> Collection<'a> {
    /// Locks a new or unfinished collection's directory and finds its finished shards; a damaged one is simulated again.
    /// Errors: `Busy`, `Io`.
    pub(crate) fn open(config: &'a CollectConfig) -> Result<Self, DatasetError> {
        let lock = lock(&config.out, &Arguments::text(config)?)?;
        let mut writer = ShardWriter::new(&config.out, description(config));
        while writer.shard_count() < config.shard_count()
            && writer.resume(Some(config.shard_trials(writer.shard_count()).count()))
        {}
        Ok(Self {
            config,
            writer,
            _lock: lock,
        })
    }

    /// The description of the data set, without counts and hash.
    pub(crate) fn info(&self) -> &DatasetInfo {
        self.writer.info()
    }

    /// Number of finished shards.
    pub(crate) fn shard_count(&self) -> usize {
        self.writer.shard_count()
    }

    /// Number of saved trials, including those of unfinished shards.
    pub(crate) fn trial_count(&self) -> u64 {
        let unfinished = (self.shard_count()..self.config.shard_count())
            .map(|shard| unfinished::count(&self.config.out, shard))
            .sum::<usize>();
        (self.writer.episode_count() + unfinished) as u64
    }

    /// The saved trials of an unfinished shard.
    pub(crate) fn saved_episodes(config: &CollectConfig, info: &DatasetInfo, shard: usize) -> Vec<EncodedEpisode> {
        let mut episodes = unfinished::load(info, &config.out, shard);
        episodes.truncate(config.shard_trials(shard).count());
        episodes
    }

    /// Whether these are all trials of a shard.
    pub(crate) fn is_complete(&self, shard: usize, episodes: &[EncodedEpisode]) -> bool {
        episodes.len() == self.config.shard_trials(shard).count()
    }

    /// Saves the finished trials of a shard until a later call completes it. Errors: `Io`.
    pub(crate) fn save_unfinished(&self, shard: usize, episodes: &[EncodedEpisode]) -> Result<(), DatasetError> {
        let first = self.config.shard_trials(shard).start;
        unfinished::save(self.info(), &self.config.out, shard, first, episodes)
    }

    /// Writes the next shard.
    pub(crate) fn write(&mut self, episodes: &[EncodedEpisode]) -> Result<(), DatasetError> {
        self.writer.write(episodes)
    }

    /// Writes the tables and metadata after all shards are written.
    pub(crate) fn complete(self) -> Result<DatasetInfo, DatasetError> {
        unfinished::remove_all(&self.config.out)?;
        self.writer.complete()
    }
}

fn description(config: &CollectConfig) -> DatasetInfo {
    DatasetInfo {
        name: format!("{}-{}-seed-{}", config.scenario, config.trials, config.seed.0),
        frame_width_px: config.world.frame_width_px,
        frame_height_px: config.world.frame_height_px,
        frame_period_s: config.world.frame_period_s,
        action_channels: action_channels(),
        state_channels: state_channels(),
        scenario: Some(config.scenario.to_string()),
        seed: Some(config.seed),
        has_masks: true,
        camera: Some(config.world.camera.model()),
        world: Some(config.world.clone()),
        ..DatasetInfo::default()
    }
}
