//! Simulates trials on several threads and writes them as a data set. Finished shards stay on disk if it is stopped.
//!
//! Each thread simulates a complete shard of consecutive trials; the calling thread writes the shards in order, each
//! atomically. If the collection is stopped, the finished trials of the other shards are saved beside them. The finished
//! data set depends only on seed and trial numbers, not on threads or interruptions.

mod config;
mod digits;
mod extend;
pub mod moving_mnist;
mod part;
mod status;
pub(crate) mod unfinished;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use self::config::ShardTrials;
pub use self::config::{CollectConfig, CollectProgress, DEFAULT_TRIALS_PER_SHARD};
pub use self::part::{collect_part, take_parts};
pub use self::status::CollectionStatus;
use super::store::arguments::{arguments_text, lock};
use super::store::shard::EncodedEpisode;
use super::store::writer::ShardWriter;
use super::{DatasetError, DatasetInfo, EpisodeData};
use foreframe_sim::{Observation, SimError, World, action_channels};

/// Collects a data set, or resumes an unfinished one with the same arguments. A directory that holds the same collection with
/// fewer trials gets the others. Returns at once if it is already finished ([`CollectionStatus::of`] tells). Several threads call `on_progress`.
/// Errors: `Usage`, `World`, `OutExists`, `OtherArguments`, `Busy`, `Cancelled`, `Simulation`, `Io`.
pub fn collect(
    config: &CollectConfig,
    on_progress: &(dyn Fn(CollectProgress) + Sync),
    cancelled: &AtomicBool,
) -> Result<DatasetInfo, DatasetError> {
    config.validate()?;
    extend::extend(config)?;
    if let CollectionStatus::Finished(info) = CollectionStatus::of(config)? {
        return Ok(*info);
    }
    let _lock = lock(&config.out, &arguments_text(config))?;
    let (mut writer, shards) = (ShardWriter::new(&config.out, config.info()), config.shards());
    // A damaged shard is simulated again.
    while writer.shard_count() < shards.count() && writer.resume(Some(shards.count_of(writer.shard_count()))) {}
    let saved = |writer: &ShardWriter| {
        let beside = unfinished::count(&config.out, writer.shard_count()..shards.count());
        (writer.episode_count() + beside) as u64
    };
    let workers = CollectWorkers {
        config,
        info: writer.info().clone(),
        next_shard: AtomicUsize::new(writer.shard_count()),
        end: shards.count(),
        done: AtomicU64::new(saved(&writer)),
        total: config.trials,
        on_progress,
        cancelled,
        failed: AtomicBool::new(false),
    };
    workers.report(0);
    let written = std::thread::scope(|scope| {
        let threads = config.thread_count();
        let (sender, receiver) = sync_channel(threads);
        for _ in 0..threads {
            let (workers, sender) = (&workers, sender.clone());
            scope.spawn(move || workers.work(&sender));
        }
        drop(sender);
        let written = write_in_order(&mut writer, shards, receiver);
        if written.is_err() {
            workers.fail();
        }
        written
    });
    let unwritten = written?;
    if writer.shard_count() == shards.count() {
        unfinished::remove_all(&config.out)?;
        return writer.complete();
    }
    for (shard, episodes) in unwritten.iter().filter(|(_, episodes)| !episodes.is_empty()) {
        unfinished::save(writer.info(), &config.out, *shard, shards.of(*shard).start, episodes)?;
    }
    Err(DatasetError::Cancelled {
        done: saved(&writer),
        total: config.trials,
    })
}

/// A shard's number and its finished episodes (all of them, unless the collection was stopped), or the error.
type ShardResult = (usize, Result<Vec<EncodedEpisode>, DatasetError>);

/// Writes complete shards in order. A shard that arrives early waits for the shards before it. Returns the episodes that
/// could not be written: those of incomplete shards, and of shards after an incomplete one.
fn write_in_order(
    writer: &mut ShardWriter,
    shards: ShardTrials,
    results: Receiver<ShardResult>,
) -> Result<BTreeMap<usize, Vec<EncodedEpisode>>, DatasetError> {
    let mut waiting = BTreeMap::new();
    for (shard, episodes) in results {
        waiting.insert(shard, episodes?);
        while let Some(entry) = waiting.first_entry()
            && *entry.key() == writer.shard_count()
            && entry.get().len() == shards.count_of(*entry.key())
        {
            writer.write(&entry.remove())?;
        }
    }
    Ok(waiting)
}

/// State shared by the simulation threads.
struct CollectWorkers<'a> {
    config: &'a CollectConfig,
    info: DatasetInfo,
    next_shard: AtomicUsize,
    /// The end of the shards to simulate.
    end: usize,
    done: AtomicU64,
    total: u64,
    on_progress: &'a (dyn Fn(CollectProgress) + Sync),
    cancelled: &'a AtomicBool,
    failed: AtomicBool,
}

impl CollectWorkers<'_> {
    /// The next shard that no thread has begun.
    fn next_shard(&self) -> Option<usize> {
        let shard = self.next_shard.fetch_add(1, Ordering::Relaxed);
        (shard < self.end).then_some(shard)
    }

    /// Stops all threads.
    fn fail(&self) {
        self.failed.store(true, Ordering::Relaxed);
    }

    fn report(&self, trials: u64) {
        (self.on_progress)(CollectProgress {
            done: self.done.fetch_add(trials, Ordering::Relaxed) + trials,
            total: self.total,
        });
    }

    fn is_stopped(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed) || self.failed.load(Ordering::Relaxed)
    }

    /// Simulates shards until none is left, the collection is stopped, or the receiver is gone.
    fn work(&self, sender: &SyncSender<ShardResult>) {
        while let Some(shard) = self.next_shard() {
            if sender.send((shard, self.simulate_shard(shard))).is_err() || self.is_stopped() {
                return;
            }
        }
    }

    /// Simulates the trials of a shard that are not saved yet; stops early if the collection was stopped.
    fn simulate_shard(&self, shard: usize) -> Result<Vec<EncodedEpisode>, DatasetError> {
        let shards = self.config.shards();
        let mut episodes = unfinished::load(&self.info, &self.config.out, shard);
        episodes.truncate(shards.count_of(shard));
        for trial in shards.of(shard).skip(episodes.len()) {
            let simulated = self.simulate(trial);
            let Some(data) = simulated.map_err(|error| DatasetError::Simulation(trial, error))? else {
                break;
            };
            episodes.push(EncodedEpisode::new(&self.info, trial as usize, data)?);
            self.report(1);
        }
        Ok(episodes)
    }

    /// Simulates a trial; none if the collection was stopped.
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
                // There is no action after the last frame.
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
