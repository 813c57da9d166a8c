//! The directory of a collection: how far it is, and how it is started, resumed and completed.

use std::fs::{self, File, TryLockError};
use std::path::Path;

use serde::Serialize;
use serde_json::{Map, Value};

use super::collect::CollectConfig;
use super::files::{is_unused, write_atomically};
use super::layout::{ARGUMENTS, DatasetMetadata, INFO, shard_path};
use super::shard::{EncodedEpisode, ShardStart, build};
use super::store::{FinishedShard, complete};
use super::{DatasetError, DatasetInfo, unfinished};
use foreframe_core::files::{remove_stale_partials, try_lock};
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
    /// Errors: `OutExists`, `OtherArguments`, as [`super::collect()`].
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

/// The arguments that determine a data set's bytes, as they are written to its directory. Errors: `Description`.
pub(super) fn arguments_text(arguments: &impl Serialize) -> Result<String, DatasetError> {
    let text = serde_json::to_string_pretty(arguments);
    text.map(|text| text + "\n")
        .map_err(|error| DatasetError::Description(error.to_string()))
}

/// Whether a directory was begun with these arguments; false for an unused one. Errors: `OutExists`, `OtherArguments`, `Io`.
pub(super) fn has_arguments(out: &Path, wanted: &str) -> Result<bool, DatasetError> {
    match read_arguments(out)? {
        Some(found) if found == wanted => Ok(true),
        Some(found) => Err(DatasetError::OtherArguments {
            path: out.to_owned(),
            differences: differences(&found, wanted),
        }),
        None if is_unused(out, ARGUMENTS)? => Ok(false),
        None => Err(DatasetError::OutExists { path: out.to_owned() }),
    }
}

/// Writes the arguments to a new directory, and locks it while this process writes the data set. Errors: `Busy`, `Io`.
pub(super) fn lock(out: &Path, arguments: &str) -> Result<File, DatasetError> {
    let path = out.join(ARGUMENTS);
    if !path.exists() {
        write_atomically(&path, arguments.as_bytes())?;
    }
    let lock = lock_file(&path, out)?;
    remove_stale_partials(out);
    Ok(lock)
}

/// Locks the file of the arguments of the data set in `out`. Errors: `Busy`, `Io`.
pub(super) fn lock_file(path: &Path, out: &Path) -> Result<File, DatasetError> {
    let file = File::open(path).map_err(DatasetError::io("read", path))?;
    match try_lock(&file) {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(DatasetError::Busy { path: out.to_owned() }),
        Err(TryLockError::Error(source)) => Err(DatasetError::io("lock", path)(source)),
    }
}

/// A shard that an earlier call wrote, with this number of trials; none if it is missing or damaged.
pub(super) fn finished_shard(out: &Path, shard: usize, trials: usize) -> Option<FinishedShard> {
    FinishedShard::read(&out.join(shard_path(shard))).filter(|finished| finished.records.len() == trials)
}

fn read_arguments(out: &Path) -> Result<Option<String>, DatasetError> {
    let path = out.join(ARGUMENTS);
    match fs::read_to_string(&path) {
        Ok(text) => Ok(Some(text)),
        // If `out` is a file, `is_unused` reports it.
        Err(error)
            if matches!(
                error.kind(),
                std::io::ErrorKind::NotFound | std::io::ErrorKind::NotADirectory
            ) =>
        {
            Ok(None)
        }
        Err(error) => Err(DatasetError::io("read", &path)(error)),
    }
}

/// Every argument that differs, for example `trials: 5 in the directory, 6 requested`.
fn differences(found: &str, wanted: &str) -> String {
    // A damaged file has no arguments; then all of them differ.
    let object = |text: &str| serde_json::from_str::<Map<String, Value>>(text).unwrap_or_default();
    let (found, wanted) = (object(found), object(wanted));
    let text = |value: Option<&Value>| value.map_or_else(|| "none".to_owned(), Value::to_string);
    let differing: Vec<_> = wanted
        .iter()
        .filter(|(key, value)| found.get(*key) != Some(value))
        .map(|(key, value)| {
            format!(
                "{key}: {} in the directory, {} requested",
                text(found.get(key)),
                text(Some(value))
            )
        })
        .collect();
    differing.join("; ")
}

/// A collection that is being written. Its finished shards are the first ones, without gaps.
pub(super) struct Collection<'a> {
    config: &'a CollectConfig,
    info: DatasetInfo,
    shards: Vec<FinishedShard>,
    start: ShardStart,
    /// Locks the directory while this process writes.
    _lock: File,
}

impl<'a> Collection<'a> {
    /// Locks a new or unfinished collection's directory and finds its finished shards. Errors: `Busy`, `Io`.
    pub(super) fn open(config: &'a CollectConfig) -> Result<Self, DatasetError> {
        let lock = lock(&config.out, &Arguments::text(config)?)?;
        let mut collection = Self {
            info: description(config),
            config,
            shards: Vec::new(),
            start: ShardStart { episode: 0, frame: 0 },
            _lock: lock,
        };
        while let Some(shard) = collection.finished_on_disk() {
            collection.push(shard);
        }
        Ok(collection)
    }

    /// The description of the data set, without counts and hash.
    pub(super) fn info(&self) -> &DatasetInfo {
        &self.info
    }

    /// Number of finished shards.
    pub(super) fn shard_count(&self) -> usize {
        self.shards.len()
    }

    /// Number of saved trials, including those of unfinished shards.
    pub(super) fn trial_count(&self) -> u64 {
        let unfinished = (self.shards.len()..self.config.shard_count())
            .map(|shard| unfinished::count(&self.config.out, shard))
            .sum::<usize>();
        (self.start.episode + unfinished) as u64
    }

    /// The saved trials of an unfinished shard.
    pub(super) fn saved_episodes(config: &CollectConfig, info: &DatasetInfo, shard: usize) -> Vec<EncodedEpisode> {
        let mut episodes = unfinished::load(info, &config.out, shard);
        episodes.truncate(config.shard_trials(shard).count());
        episodes
    }

    /// Whether these are all trials of a shard.
    pub(super) fn is_complete(&self, shard: usize, episodes: &[EncodedEpisode]) -> bool {
        episodes.len() == self.config.shard_trials(shard).count()
    }

    /// Saves the finished trials of a shard until a later call completes it. Errors: `Io`.
    pub(super) fn save_unfinished(&self, shard: usize, episodes: &[EncodedEpisode]) -> Result<(), DatasetError> {
        let first = self.config.shard_trials(shard).start;
        unfinished::save(&self.info, &self.config.out, (shard, first), episodes)
    }

    /// The next shard, if it is on disk and complete. A damaged shard is simulated again.
    fn finished_on_disk(&self) -> Option<FinishedShard> {
        let shard = self.shards.len();
        if shard >= self.config.shard_count() {
            return None;
        }
        finished_shard(&self.config.out, shard, self.config.shard_trials(shard).count())
    }

    fn push(&mut self, shard: FinishedShard) {
        self.start = ShardStart {
            episode: self.start.episode + shard.records.len(),
            frame: self.start.frame + shard.frames(),
        };
        self.shards.push(shard);
    }

    /// Writes the next shard.
    pub(super) fn write(&mut self, episodes: &[EncodedEpisode]) -> Result<(), DatasetError> {
        let path = self.config.out.join(shard_path(self.shards.len()));
        self.push(FinishedShard::write(&path, &build(&self.info, self.start, episodes)?)?);
        Ok(())
    }

    /// Writes the tables and metadata after all shards are written.
    pub(super) fn complete(self) -> Result<DatasetInfo, DatasetError> {
        unfinished::remove_all(&self.config.out)?;
        complete(&self.config.out, self.info, &self.shards)
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
        content_hash: String::new(),
        scenario: Some(config.scenario.to_string()),
        seed: Some(config.seed),
        frame_count: 0,
        episode_count: 0,
        has_masks: true,
        camera: Some(config.world.camera.model()),
        world: Some(config.world.clone()),
    }
}
