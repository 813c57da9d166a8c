//! A data set on disk. Opens it; the files below read and write its parts.

pub(super) mod arguments;
pub(super) mod catalog;
pub(super) mod files;
pub(super) mod layout;
pub(super) mod parquet_file;
pub(super) mod preview;
pub(super) mod shard;
pub(super) mod shard_reader;
mod stats;
pub(super) mod tables;
pub(super) mod writer;

use std::path::Path;
use std::sync::Arc;

use rayon::prelude::*;

use self::files::verify;
use self::layout::{DatasetMetadata, EPISODES, ShardEntry};
use self::shard_reader::{FrameTarget, ShardNumbers, ShardSlot, read};
use self::tables::read_episodes;
use super::check::check_numbers;
use super::frame_store::frame_file::{FrameFile, FrameFilePlace};
use super::frame_store::{FrameStore, HeldFrames};
use super::{Dataset, DatasetError, DatasetInfo};

impl Dataset {
    /// Reads a complete data set into memory and verifies the hash of every file.
    /// Errors: `NotADataset`, `Unfinished`, `HashDiffers`, `Corrupt`, `CorruptFrame`, `Io`, `NotFinite`, `TimeOrder`.
    pub fn open(directory: &Path) -> Result<Self, DatasetError> {
        Self::open_within(directory, u64::MAX >> 20)
    }

    /// As [`Dataset::open`], but holds the frames in memory only if they need at most `memory_mib` MiB. Otherwise they are
    /// decoded into a file in the directory `.cache` of the data set, unless an earlier call did so, and are read from there
    /// when they are used. Errors: as [`Dataset::open`], and `FrameFile`.
    pub fn open_within(directory: &Path, memory_mib: u64) -> Result<Self, DatasetError> {
        let metadata = DatasetMetadata::read(directory)?;
        let info = metadata.info_in(directory)?;
        let path = directory.join(EPISODES);
        verify(&path, &metadata.episodes_sha256)?;
        let episodes = read_episodes(&path, &info)?;
        let shards = ShardReader {
            directory,
            info: &info,
            shards: &metadata.shards,
        };
        let (frames, numbers) = if info.decoded_bytes() <= memory_mib << 20 {
            let mut held = HeldFrames::zeroed(&info);
            let numbers = shards.read(held.targets(&info, &metadata.shards))?;
            (FrameStore::Memory(held), numbers)
        } else {
            let (file, numbers) = shards.decode_once()?;
            (FrameStore::File(Arc::new(file)), numbers)
        };
        for episode in &episodes {
            check_numbers(&info, episode.index, &numbers.of_episode(&info, episode))?;
        }
        Ok(Self {
            frames,
            actions: numbers.actions,
            states: numbers.states,
            timestamps_s: numbers.timestamps_s,
            info,
            episodes,
        })
    }
}

/// Reads all shards of a data set.
struct ShardReader<'a> {
    directory: &'a Path,
    info: &'a DatasetInfo,
    shards: &'a [ShardEntry],
}

impl ShardReader<'_> {
    /// Verifies the shards and reads them in parallel; each shard's frames go to one of the targets.
    fn read(&self, targets: Vec<FrameTarget<'_>>) -> Result<ShardNumbers, DatasetError> {
        let mut first_frame = 0;
        let places = self.shards.iter().map(|shard| {
            first_frame += shard.frames;
            first_frame - shard.frames
        });
        let slots: Vec<ShardSlot<'_>> = self
            .shards
            .iter()
            .zip(places)
            .zip(targets)
            .map(|((shard, first_frame), target)| ShardSlot {
                path: self.directory.join(&shard.path),
                frames: shard.frames,
                first_frame,
                target,
            })
            .collect();
        let parts: Result<Vec<ShardNumbers>, DatasetError> = slots
            .into_par_iter()
            .zip(self.shards)
            .map(|(mut slot, entry)| {
                verify(&slot.path, &entry.sha256)?;
                read(self.info, &mut slot)
            })
            .collect();
        Ok(ShardNumbers::joined(self.info, parts?))
    }

    /// Opens the file of decoded frames, which is written first if it does not exist.
    fn decode_once(&self) -> Result<(FrameFile, ShardNumbers), DatasetError> {
        let place = FrameFilePlace::of(self.directory, self.info);
        let without_frames = || self.read(self.shards.iter().map(|_| FrameTarget::Nothing).collect());
        if let Some(file) = place.open()? {
            return Ok((file, without_frames()?));
        }
        let _lock = place.lock()?;
        // Another process may have written it meanwhile.
        if let Some(file) = place.open()? {
            return Ok((file, without_frames()?));
        }
        let writer = place.create()?;
        let targets = self.shards.iter().map(|_| FrameTarget::File(&writer)).collect();
        let numbers = self.read(targets)?;
        Ok((writer.finish()?, numbers))
    }
}

impl HeldFrames {
    /// Divides the memory among the shards.
    fn targets(&mut self, info: &DatasetInfo, shards: &[ShardEntry]) -> Vec<FrameTarget<'_>> {
        let mut pixels = self.pixels.as_mut_slice();
        let mut masks = self.masks.as_deref_mut();
        let mut targets = Vec::with_capacity(shards.len());
        for shard in shards {
            let bytes = shard.frames * info.frame_pixels();
            let (own, rest) = std::mem::take(&mut pixels).split_at_mut(bytes);
            pixels = rest;
            let mask = masks.take().map(|all| all.split_at_mut(bytes));
            let (mask, rest) = mask.map_or((None, None), |(own, rest)| (Some(own), Some(rest)));
            masks = rest;
            targets.push(FrameTarget::Memory {
                pixels: own,
                masks: mask,
            });
        }
        targets
    }
}
