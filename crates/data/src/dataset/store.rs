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

use rayon::prelude::*;

use self::files::verify;
use self::layout::{DatasetMetadata, EPISODES};
use self::shard_reader::{ImageTarget, Shard};
use self::tables::read_episodes;
use super::check::check_numbers;
use super::frame_store::FrameContent;
use super::frame_store::frame_file::{FrameFile, FrameFilePlace};
use super::{Dataset, DatasetError, DatasetInfo};

impl Dataset {
    /// Reads a complete data set into memory and verifies the hash of every file.
    /// Errors: `NotFound`, `Unfinished`, `HashDiffers`, `Corrupt`, `CorruptFrame`, `Io`, `Invalid`, `TimeOrder`.
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
        let shards = Shard::all(directory, &metadata);
        let (content, file) = if info.decoded_bytes() <= memory_mib << 20 {
            (read(&info, &shards, ImageTarget::Memory)?, None)
        } else {
            let (content, file) = decode_once(directory, &info, &shards)?;
            (content, Some(file))
        };
        for episode in &episodes {
            let frames = episode.frames();
            let rows = |size: usize| frames.start * size..frames.end * size;
            let actions = &content.actions[rows(info.action_channels.len())];
            let states = &content.states[rows(info.state_channels.len())];
            check_numbers(&info, episode.index, actions, states, &content.timestamps_s[rows(1)])?;
        }
        Ok(Self::new(info, episodes, content, file))
    }
}

/// Reads shards in parallel, in their order.
fn read(info: &DatasetInfo, shards: &[Shard], target: ImageTarget<'_>) -> Result<FrameContent, DatasetError> {
    let parts: Result<Vec<_>, _> = shards.par_iter().map(|shard| shard.read(info, target)).collect();
    let mut all = FrameContent::default();
    parts?.into_iter().for_each(|part| all.append(part));
    Ok(all)
}

/// Reads the numbers, and opens the file of decoded frames, which is written first if it does not exist.
fn decode_once(
    directory: &Path,
    info: &DatasetInfo,
    shards: &[Shard],
) -> Result<(FrameContent, FrameFile), DatasetError> {
    let place = FrameFilePlace::of(directory, info);
    if let Some(file) = place.open()? {
        return Ok((read(info, shards, ImageTarget::Nothing)?, file));
    }
    let _lock = place.lock()?;
    // Another process may have written it meanwhile.
    if let Some(file) = place.open()? {
        return Ok((read(info, shards, ImageTarget::Nothing)?, file));
    }
    let writer = place.create()?;
    let content = read(info, shards, ImageTarget::File(&writer))?;
    Ok((content, writer.finish()?))
}
