//! Reads one episode of a data set on disk. Only the shard with this episode is read and verified.

use std::path::Path;

use super::files::verify;
use super::layout::{DatasetMetadata, EPISODES};
use super::shard_reader::{ImageTarget, Shard};
use super::tables::read_episodes;
use crate::dataset::{Dataset, DatasetError, DatasetInfo};
use foreframe_core::frame::Frame;

/// The description of the finished data set in a directory, without reading its frames.
/// Errors: `NotFound`, `Unfinished`, `Corrupt`, `Io`.
pub fn describe(directory: &Path) -> Result<DatasetInfo, DatasetError> {
    DatasetMetadata::read(directory)?.info_in(directory)
}

/// The description of a data set from the text of its metadata file ([`METADATA`](super::layout::METADATA)). Errors: `Corrupt`; they name
/// `path`.
pub fn describe_metadata(path: &Path, text: &[u8]) -> Result<DatasetInfo, DatasetError> {
    Ok(DatasetMetadata::parse(path, text)?.info())
}

impl Dataset {
    /// The frames of one episode. Errors: `NoEpisode`, and those of [`Dataset::open`].
    pub fn episode_frames(directory: &Path, episode: usize) -> Result<Vec<Frame>, DatasetError> {
        let metadata = DatasetMetadata::read(directory)?;
        let info = DatasetInfo {
            // They are not read.
            has_masks: false,
            ..metadata.info()
        };
        let missing = || {
            let (name, count) = (&info.name, info.episode_count);
            DatasetError::NoEpisode(format!(
                "there is no episode {episode} in \"{name}\"; it has {count}, counted from 0"
            ))
        };
        let shards = Shard::all(directory, &metadata);
        let shard = shards.iter().find(|shard| shard.episodes.contains(&episode));
        let shard = shard.ok_or_else(missing)?;
        let table = directory.join(EPISODES);
        verify(&table, &metadata.episodes_sha256)?;
        let episodes = read_episodes(&table, &info)?;
        let wanted = episodes.get(episode).ok_or_else(missing)?;
        let content = shard.read(&info, ImageTarget::Memory)?;
        let start = wanted.first_frame.saturating_sub(shard.frames.start);
        let frames = content.pixels.into_iter().skip(start).take(wanted.frame_count);
        frames
            .map(|pixels| {
                Ok(Frame::new(
                    info.frame_width_px,
                    info.frame_height_px,
                    pixels.into_vec(),
                )?)
            })
            .collect()
    }
}
