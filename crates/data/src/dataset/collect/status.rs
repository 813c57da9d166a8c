//! How far the collection in a directory is.

use super::config::CollectConfig;
use super::unfinished;
use crate::dataset::store::arguments::{arguments_text, has_arguments};
use crate::dataset::store::layout::{INFO, shard_path};
use crate::dataset::store::preview::describe;
use crate::dataset::{DatasetError, DatasetInfo};

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
        if !has_arguments(out, &arguments_text(config))? {
            return Ok(Self::New);
        }
        if out.join(INFO).exists() {
            return Ok(Self::Finished(Box::new(describe(out)?)));
        }
        let shards = config.shards();
        let complete = (0..shards.count()).take_while(|&shard| out.join(shard_path(shard)).exists());
        let complete = complete.count();
        let in_shards: usize = (0..complete).map(|shard| shards.count_of(shard)).sum();
        let beside = unfinished::count(out, complete..shards.count());
        Ok(Self::Unfinished {
            trials: (in_shards + beside) as u64,
        })
    }
}
