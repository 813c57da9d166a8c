//! A part of a collection: some of its shards, which another process can simulate. It saves the trials in a directory of its
//! own, as a stopped collection saves them. The collection then takes them over instead of simulating them.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize};

use super::config::{CollectConfig, CollectProgress};
use super::status::CollectionStatus;
use super::{CollectWorkers, unfinished};
use crate::dataset::DatasetError;
use crate::dataset::store::arguments::{arguments_text, has_arguments, lock};

/// Simulates the trials of some shards of a collection into the directory `config.out`, or continues. Several threads call
/// `on_progress`, and `on_saved` with the number of trials on disk. Errors: `Usage`, `World`, `OutExists`, `OtherArguments`,
/// `Busy`, `Cancelled`, `Simulation`, `Io`.
pub fn collect_part(
    config: &CollectConfig,
    shards: Range<usize>,
    on_progress: &(dyn Fn(CollectProgress) + Sync),
    on_saved: &(dyn Fn(u64) + Sync),
    cancelled: &AtomicBool,
) -> Result<(), DatasetError> {
    config.validate()?;
    CollectionStatus::of(config)?;
    let _lock = lock(&config.out, &arguments_text(config))?;
    let info = config.info();
    let of_shard = config.shards();
    let saved = || unfinished::count(&config.out, shards.clone()) as u64;
    let total: usize = shards.clone().map(|shard| of_shard.count_of(shard)).sum();
    let workers = CollectWorkers {
        config,
        info: info.clone(),
        next_shard: AtomicUsize::new(shards.start),
        end: shards.end,
        done: AtomicU64::new(saved()),
        total: total as u64,
        on_progress,
        cancelled,
        failed: AtomicBool::new(false),
    };
    on_saved(saved());
    workers.report(0);
    let results = std::thread::scope(|scope| {
        let work = || -> Result<(), DatasetError> {
            while let Some(shard) = workers.next_shard() {
                let before = unfinished::count(&config.out, shard..shard + 1);
                if before < of_shard.count_of(shard) {
                    let episodes = workers.simulate_shard(shard).inspect_err(|_| workers.fail())?;
                    if episodes.len() > before {
                        unfinished::save(&info, &config.out, shard, of_shard.of(shard).start, &episodes)
                            .inspect_err(|_| workers.fail())?;
                        on_saved(saved());
                    }
                }
                if workers.is_stopped() {
                    break;
                }
            }
            Ok(())
        };
        let threads: Vec<_> = (0..config.thread_count()).map(|_| scope.spawn(work)).collect();
        threads
            .into_iter()
            .map(std::thread::ScopedJoinHandle::join)
            .collect::<Vec<_>>()
    });
    for result in results {
        result.unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
    }
    let (done, total) = (saved(), total as u64);
    if done < total {
        return Err(DatasetError::Cancelled { done, total });
    }
    Ok(())
}

/// Moves the trials that parts saved in these directories into the directory of the collection, which then need not simulate
/// them. Directories without trials, and those of other arguments or another version of the program, are skipped. Errors: `OutExists`,
/// `OtherArguments`, `Busy`, `Io`.
pub fn take_parts(config: &CollectConfig, parts: &[PathBuf]) -> Result<(), DatasetError> {
    if matches!(CollectionStatus::of(config)?, CollectionStatus::Finished(_)) {
        return Ok(());
    }
    let _lock = lock(&config.out, &arguments_text(config))?;
    for part in parts {
        if !matches!(has_arguments(part, &arguments_text(config)), Ok(true)) {
            continue;
        }
        let files = unfinished::files(part)?;
        for (from, to) in files.iter().map(|from| (from, unfinished::moved(from, &config.out))) {
            move_file(from, &to)?;
        }
    }
    Ok(())
}

fn move_file(from: &Path, to: &Path) -> Result<(), DatasetError> {
    if let Some(dir) = to.parent() {
        fs::create_dir_all(dir).map_err(DatasetError::io("make", dir))?;
    }
    fs::rename(from, to).map_err(DatasetError::io("move", from))
}
