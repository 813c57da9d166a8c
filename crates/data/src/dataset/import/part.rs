//! An import in parts: what costs is divided, to decode, resize and compress the images. Each part reads the records of the whole
//! source, and saves its share of the shards in a directory of its own. The import then takes these instead of reading the images.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use super::encoder::EpisodeEncoder;
use super::saved_shards::SavedShards;
use super::timing::ImportPlan;
use super::writer::{ImportProgress, description};
use super::{ImportConfig, ImportError};
use crate::dataset::store::writer::shard_ranges;

/// A part of an import.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImportPart {
    /// The directory in which it saves its shards.
    pub dir: PathBuf,
    /// Which of the parts, from 0.
    pub index: usize,
    /// How many parts there are, at least 1.
    pub count: usize,
}

impl ImportPart {
    /// Its share of this number of shards: consecutive ones.
    fn share(&self, shards: usize) -> Range<usize> {
        let count = self.count.max(1);
        let start = |part: usize| shards * part.min(count) / count;
        start(self.index)..start(self.index + 1)
    }
}

/// Saves the shards of a part that are missing. Errors: `Cancelled`, `Image`, `Record`, `Io`, `Dataset`.
pub(super) fn write(
    plan: &ImportPlan,
    config: &ImportConfig,
    part: &ImportPart,
    on_progress: &(dyn Fn(ImportProgress) + Sync),
    cancelled: &AtomicBool,
) -> Result<(), ImportError> {
    let info = description(config, plan);
    let saved = SavedShards::new(config, plan, std::slice::from_ref(&part.dir));
    let ranges = shard_ranges(plan.episodes.iter().map(Vec::len));
    let share = part.share(ranges.len());
    let frames = |episodes: &Range<usize>| plan.episodes[episodes.clone()].iter().map(Vec::len).sum::<usize>() as u64;
    let total = ranges[share.clone()].iter().map(frames).sum();
    let mut done = 0;
    for (shard, episodes) in share.clone().zip(&ranges[share]) {
        if cancelled.load(Ordering::Relaxed) {
            return Err(ImportError::Cancelled { done, total });
        }
        if saved.shard(&info, shard).is_none() {
            let encoder = EpisodeEncoder {
                plan,
                options: &config.options,
                info: &info,
                first: episodes.start,
            };
            let on_frames = |frames: usize| {
                let done = done + frames as u64;
                on_progress(ImportProgress { done, total });
            };
            let made = encoder.encode(episodes.clone(), cancelled, &on_frames);
            let made = made.map_err(|error| match error {
                ImportError::Stopped => ImportError::Cancelled { done, total },
                other => other,
            })?;
            saved.save(&info, shard, made, &part.dir)?;
        }
        done += frames(episodes);
        on_progress(ImportProgress { done, total });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shard_is_in_one_part() {
        for (shards, count) in [(0, 2), (1, 4), (7, 3), (9, 64)] {
            let share = |index| {
                let part = ImportPart {
                    dir: PathBuf::new(),
                    index,
                    count,
                };
                part.share(shards)
            };
            let shares: Vec<usize> = (0..count).flat_map(share).collect();
            assert_eq!(shares, (0..shards).collect::<Vec<_>>());
        }
    }
}
