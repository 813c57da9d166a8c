//! The finished trials of shards that a stopped collection could not complete. They are saved beside the data, one file for
//! each shard, until the same command resumes the collection and writes the complete shard.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use arrow_array::types::Float32Type;

use crate::dataset::store::files;
use crate::dataset::store::layout::{ACTION, IMAGE, MASK, STATE, TIMESTAMP};
use crate::dataset::store::shard::{EncodedEpisode, ShardStart, build};
use crate::dataset::store::shard_reader::{Column, batches, records};
use crate::dataset::{DatasetError, DatasetInfo};

/// Their directory in the data set's.
const DIRECTORY: &str = "unfinished";

fn path(out: &Path, shard: usize) -> PathBuf {
    out.join(DIRECTORY).join(format!("shard-{shard:06}.parquet"))
}

/// Saves the first trials of a shard; `first` is the number of its first trial. Errors: `Io`.
pub(crate) fn save(
    info: &DatasetInfo,
    out: &Path,
    shard: usize,
    first: u64,
    episodes: &[EncodedEpisode],
) -> Result<(), DatasetError> {
    let start = ShardStart {
        episode: first as usize,
        frame: 0,
    };
    let (bytes, _) = build(info, start, episodes)?;
    files::write_atomically(&path(out, shard), &bytes)
}

/// The saved trials of a shard. None if the file is missing or damaged: they are simulated again.
pub(crate) fn load(info: &DatasetInfo, out: &Path, shard: usize) -> Vec<EncodedEpisode> {
    read(info, out, shard).unwrap_or_default()
}

/// How many trials of these shards are saved.
pub(crate) fn count(out: &Path, shards: Range<usize>) -> usize {
    let saved = shards.filter_map(|shard| records(&path(out, shard)).ok());
    saved.map(|records| records.len()).sum()
}

/// The files of the saved trials in a directory. Errors: `Io`.
pub(crate) fn files(out: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    let dir = out.join(DIRECTORY);
    let entries = match fs::read_dir(&dir) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(DatasetError::io("read", &dir))?,
    };
    let paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
    Ok(paths
        .filter(|path| path.extension().is_some_and(|extension| extension == "parquet"))
        .collect())
}

/// The place of such a file in another directory.
pub(crate) fn moved(file: &Path, out: &Path) -> PathBuf {
    out.join(DIRECTORY).join(file.file_name().unwrap_or_default())
}

/// Deletes the saved trials of all shards, after every shard is complete. Errors: `Io`.
pub(crate) fn remove_all(out: &Path) -> Result<(), DatasetError> {
    let dir = out.join(DIRECTORY);
    match fs::remove_dir_all(&dir) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(DatasetError::io("delete", &dir)(error)),
        _ => Ok(()),
    }
}

/// The saved episodes of a shard. Errors: `Io`, `Corrupt`.
pub(crate) fn read(info: &DatasetInfo, out: &Path, shard: usize) -> Result<Vec<EncodedEpisode>, DatasetError> {
    let path = &path(out, shard);
    let mut rows = Rows::default();
    for batch in &batches(path)? {
        let column = Column { batch, path };
        rows.images.extend(column.images(IMAGE)?.map(<[u8]>::to_vec));
        if info.has_masks {
            rows.masks.extend(column.images(MASK)?.map(<[u8]>::to_vec));
        }
        rows.states.extend(column.vectors(STATE, info.state_channels.len())?);
        rows.actions.extend(column.vectors(ACTION, info.action_channels.len())?);
        rows.timestamps_s.extend(column.numbers::<Float32Type>(TIMESTAMP)?);
    }
    let records = records(path)?;
    if records.iter().map(|record| record.frames).sum::<usize>() != rows.images.len() {
        return Err(DatasetError::corrupt(path, &"its records do not count its rows"));
    }
    let episodes = records.into_iter().map(|record| {
        let frames = record.frames;
        EncodedEpisode {
            images: rows.images.drain(..frames).collect(),
            masks: info.has_masks.then(|| rows.masks.drain(..frames).collect()),
            states: rows.states.drain(..frames * info.state_channels.len()).collect(),
            actions: rows.actions.drain(..frames * info.action_channels.len()).collect(),
            timestamps_s: rows.timestamps_s.drain(..frames).collect(),
            record,
        }
    });
    Ok(episodes.collect())
}

/// All frames of a file, column by column.
#[derive(Default)]
struct Rows {
    images: Vec<Vec<u8>>,
    masks: Vec<Vec<u8>>,
    states: Vec<f32>,
    actions: Vec<f32>,
    timestamps_s: Vec<f32>,
}
