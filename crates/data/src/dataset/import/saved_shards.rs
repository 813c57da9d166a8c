//! The shards that the parts of an import saved, each with what was left out of it.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::encoder::EncodedShard;
use super::skipped::SkippedList;
use super::timing::ImportPlan;
use super::{ImportConfig, ImportError, ImportOptions};
use crate::dataset::collect::unfinished;
use crate::dataset::info::DatasetInfo;
use crate::dataset::store::files::write_atomically;

/// Instead of a path of the machine that saves a shard: the directory in which a source is unpacked, and the source.
const UNPACKED: &str = "{unpacked}";
const SOURCE: &str = "{source}";

/// What is saved of a shard besides its episodes, and after them.
#[derive(Serialize, Deserialize)]
struct SavedShard {
    /// The hash of the plan to which it belongs.
    plan: String,
    bad: SkippedList,
}

/// The shards that parts saved.
pub(super) struct SavedShards<'a> {
    plan: String,
    dirs: &'a [PathBuf],
    /// The data set's directory and the source on this machine: what was left out is named by paths in them.
    places: [PathBuf; 2],
}

impl<'a> SavedShards<'a> {
    /// Those in these directories that belong to a plan.
    pub(super) fn new(config: &ImportConfig, plan: &ImportPlan, dirs: &'a [PathBuf]) -> Self {
        Self {
            plan: format!(
                "{:x}",
                plan_hash(&config.options, plan, 0..plan.episodes.len()).finalize()
            ),
            dirs,
            places: [config.out.clone(), config.source.clone()],
        }
    }

    /// A shard, unless it is missing, damaged or of another plan.
    pub(super) fn shard(&self, info: &DatasetInfo, shard: usize) -> Option<EncodedShard> {
        let mut found = self.dirs.iter().map(|dir| (dir, saved_shard(dir, shard)));
        let (dir, saved) =
            found.find_map(|(dir, saved)| Some((dir, saved.filter(|saved| saved.plan == self.plan)?)))?;
        let here = [Path::new(UNPACKED), Path::new(SOURCE)].into_iter().zip(&self.places);
        Some(EncodedShard {
            encoded: unfinished::read(info, dir, shard).ok()?,
            bad: here.fold(saved.bad, |bad, (name, place)| bad.moved(name, place)),
        })
    }

    /// Saves a shard in the directory `here`, in which a source is unpacked. Errors: `Io`, `Dataset`.
    pub(super) fn save(
        &self,
        info: &DatasetInfo,
        shard: usize,
        made: EncodedShard,
        here: &Path,
    ) -> Result<(), ImportError> {
        unfinished::save(info, here, shard, 0, &made.encoded)?;
        let saved = SavedShard {
            plan: self.plan.clone(),
            bad: made
                .bad
                .moved(here, Path::new(UNPACKED))
                .moved(&self.places[1], Path::new(SOURCE)),
        };
        let text = serde_json::to_vec(&saved).expect("a list of texts that JSON cannot hold is a bug");
        Ok(write_atomically(&path(here, shard), &text)?)
    }
}

fn path(dir: &Path, shard: usize) -> PathBuf {
    dir.join("shards").join(format!("shard-{shard:06}.json"))
}

/// `None` if it is missing or damaged: the shard is made again.
fn saved_shard(dir: &Path, shard: usize) -> Option<SavedShard> {
    serde_json::from_slice(&fs::read(path(dir, shard)).ok()?).ok()
}

/// How many shards a part has saved.
#[must_use]
pub fn saved_part_shards(dir: &Path) -> usize {
    fs::read_dir(dir.join("shards")).map_or(0, Iterator::count)
}

/// The hash of all that decides the shards with these episodes, but for the images: two machines can have different files in a place.
pub(super) fn plan_hash(options: &ImportOptions, plan: &ImportPlan, episodes: Range<usize>) -> Sha256 {
    let mut hash = Sha256::new();
    let described = (
        env!("CARGO_PKG_VERSION"),
        options,
        plan.frame_period_s,
        &plan.recording.action_channels,
        &plan.recording.state_channels,
    );
    hash.update(serde_json::to_vec(&described).expect("a description that JSON cannot hold is a bug"));
    for episode in &plan.episodes[episodes] {
        hash.update((episode.len() as u64).to_le_bytes());
        for frame in episode {
            let record = &plan.recording.records[frame.record];
            hash.update((frame.record as u64).to_le_bytes());
            hash.update(record.timestamp_s.to_le_bytes());
            for value in frame.action.iter().chain(&record.state) {
                hash.update(value.to_le_bytes());
            }
        }
    }
    hash
}
