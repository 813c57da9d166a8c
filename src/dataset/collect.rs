//! Simulates trials into a data set on disk, on several threads, so that nothing finished is lost when it is stopped.
//!
//! Threads simulate whole shards of consecutive trials; the calling thread writes them in order, each as a whole. If the
//! collection is stopped, the finished trials of the other shards are kept beside them. The finished data set depends on
//! the seed and the trials alone, not on threads or interruptions.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use super::collection::{Collection, CollectionStatus};
use super::shard::EncodedEpisode;
use super::{DatasetError, DatasetInfo, EpisodeData};
use crate::sim::{Observation, Scenario, SimError, World, WorldConfig, action_channels};
use crate::types::Seed;

/// Trials that make one file, unless asked otherwise.
pub const DEFAULT_TRIALS_PER_SHARD: u64 = 50;

/// What to collect, and where to.
#[derive(Clone, Debug, PartialEq)]
pub struct CollectConfig {
    /// The scenario.
    pub scenario: Scenario,
    /// Trials from 0 on.
    pub trials: u64,
    /// The seed that every trial's own is derived from.
    pub seed: Seed,
    /// The data set's directory.
    pub out: PathBuf,
    /// How the world is run and seen.
    pub world: WorldConfig,
    /// Threads that simulate; 0 for as many as there are cores.
    pub threads: usize,
    /// Trials that make one file.
    pub trials_per_shard: u64,
}

impl CollectConfig {
    /// That many trials of a scenario, with the defaults for all else.
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

    /// Errors: `Zero`, and what the world says of its settings.
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

    /// Files that it takes.
    pub(super) fn shard_count(&self) -> usize {
        self.trials.div_ceil(self.trials_per_shard) as usize
    }

    /// The trials of a shard.
    pub(super) fn shard_trials(&self, shard: usize) -> Range<u64> {
        let first = shard as u64 * self.trials_per_shard;
        first..(first + self.trials_per_shard).min(self.trials)
    }

    fn thread_count(&self) -> usize {
        match self.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            threads => threads,
        }
    }
}

/// How far a collection is, in trials.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CollectProgress {
    /// Trials simulated, those of earlier calls included.
    pub done: u64,
    /// Trials asked for.
    pub total: u64,
}

/// Collects a data set, or goes on with one that was begun with the same arguments; returns at once where it is
/// finished already ([`CollectionStatus::of`] tells). Progress is told from several threads.
/// Errors: `Zero`, `World`, `OutExists`, `OtherArguments`, `Busy`, `Cancelled`, `Simulation`, `Io`.
pub fn collect(
    config: &CollectConfig,
    on_progress: &(dyn Fn(CollectProgress) + Sync),
    cancelled: &AtomicBool,
) -> Result<DatasetInfo, DatasetError> {
    config.validate()?;
    if let CollectionStatus::Finished(info) = CollectionStatus::of(config)? {
        return Ok(*info);
    }
    let mut collection = Collection::begin(config)?;
    let crew = CollectWorkers {
        config,
        info: collection.info().clone(),
        next_shard: AtomicUsize::new(collection.shard_count()),
        done: AtomicU64::new(collection.trial_count()),
        on_progress,
        cancelled,
        failed: AtomicBool::new(false),
    };
    crew.report(0);
    let written = std::thread::scope(|scope| {
        let threads = config.thread_count();
        let (sender, receiver) = sync_channel(threads);
        for _ in 0..threads {
            let (crew, sender) = (&crew, sender.clone());
            scope.spawn(move || crew.work(&sender));
        }
        drop(sender);
        let written = write_in_order(&mut collection, receiver);
        crew.failed.store(written.is_err(), Ordering::Relaxed);
        written
    });
    let unwritten = written?;
    if collection.shard_count() < config.shard_count() {
        for (shard, episodes) in unwritten.iter().filter(|(_, episodes)| !episodes.is_empty()) {
            collection.keep(*shard, episodes)?;
        }
        return Err(DatasetError::Cancelled {
            done: collection.trial_count(),
            total: config.trials,
        });
    }
    collection.complete()
}

/// A shard's number and its finished trials: all of them, unless the collection was stopped.
type ShardResult = (usize, Result<Vec<EncodedEpisode>, DatasetError>);

/// Writes whole shards as they come, each once those before it are written. Returns the trials that could not be written:
/// those of shards that are not whole, and of shards after one that is not.
fn write_in_order(
    collection: &mut Collection<'_>,
    deliveries: Receiver<ShardResult>,
) -> Result<BTreeMap<usize, Vec<EncodedEpisode>>, DatasetError> {
    let mut waiting = BTreeMap::new();
    for (shard, episodes) in deliveries {
        waiting.insert(shard, episodes?);
        while let Some(entry) = waiting.first_entry()
            && *entry.key() == collection.shard_count()
            && collection.is_whole(*entry.key(), entry.get())
        {
            collection.write(&entry.remove())?;
        }
    }
    Ok(waiting)
}

/// What the simulating threads share.
struct CollectWorkers<'a> {
    config: &'a CollectConfig,
    info: DatasetInfo,
    next_shard: AtomicUsize,
    done: AtomicU64,
    on_progress: &'a (dyn Fn(CollectProgress) + Sync),
    cancelled: &'a AtomicBool,
    failed: AtomicBool,
}

impl CollectWorkers<'_> {
    fn report(&self, trials: u64) {
        (self.on_progress)(CollectProgress {
            done: self.done.fetch_add(trials, Ordering::Relaxed) + trials,
            total: self.config.trials,
        });
    }

    fn is_stopped(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed) || self.failed.load(Ordering::Relaxed)
    }

    /// Takes shard after shard until none is left, the collection is stopped or nobody takes the results.
    fn work(&self, sender: &SyncSender<ShardResult>) {
        loop {
            let shard = self.next_shard.fetch_add(1, Ordering::Relaxed);
            if shard >= self.config.shard_count() {
                return;
            }
            if sender.send((shard, self.simulate_shard(shard))).is_err() || self.is_stopped() {
                return;
            }
        }
    }

    /// The trials of a shard; only those finished so far when stopped.
    fn simulate_shard(&self, shard: usize) -> Result<Vec<EncodedEpisode>, DatasetError> {
        let mut episodes = Collection::kept_episodes(self.config, &self.info, shard);
        for trial in self.config.shard_trials(shard).skip(episodes.len()) {
            let simulated = self.simulate(trial);
            let Some(data) = simulated.map_err(|source| DatasetError::Simulation { trial, source })? else {
                break;
            };
            episodes.push(EncodedEpisode::new(&self.info, trial as usize, data)?);
            self.report(1);
        }
        Ok(episodes)
    }

    /// A trial from its start to its end; none when stopped.
    fn simulate(&self, trial: u64) -> Result<Option<EpisodeData>, SimError> {
        let config = self.config;
        let mut world = World::new(config.scenario, &config.world, config.seed, trial)?;
        let mut data = EpisodeData {
            masks: Some(Vec::new()),
            trial: Some(world.parameters().clone()),
            ..EpisodeData::default()
        };
        let mut observation = world.observe();
        loop {
            if self.is_stopped() {
                return Ok(None);
            }
            let action = world.policy_action();
            let step = world.step(&action)?;
            record(&mut data, &observation, action.as_slice());
            observation = step.observation;
            if step.terminated || step.truncated {
                // Nothing acts after the last frame.
                record(&mut data, &observation, &vec![0.0; action_channels().len()]);
                return Ok(Some(data));
            }
        }
    }
}

fn record(data: &mut EpisodeData, observation: &Observation, action: &[f32]) {
    data.timestamps_s.push(observation.time_s);
    data.pixels.extend_from_slice(observation.frame.pixels());
    if let Some(masks) = &mut data.masks {
        masks.extend_from_slice(&observation.mask);
    }
    data.actions.extend_from_slice(action);
    data.states.extend_from_slice(observation.state.as_slice());
}
