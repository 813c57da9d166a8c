//! Reads one episode of a data set on disk. Only the shard with this episode is read and verified.

use std::path::Path;

use super::files::verify;
use super::layout::{DatasetMetadata, EPISODES};
use super::shard_reader::{FrameTarget, ShardSlot, read};
use super::tables::read_episodes;
use crate::dataset::{Dataset, DatasetError, DatasetInfo};
use foreframe_core::frame::Frame;

/// The description of the finished data set in a directory, without reading its frames.
/// Errors: `NotADataset`, `Unfinished`, `Corrupt`, `Io`.
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
        let info = metadata.info();
        let missing = || DatasetError::NoEpisode {
            name: info.name.clone(),
            episode,
            count: info.episode_count,
        };
        let (mut first_episode, mut first_frame) = (0, 0);
        let shard = metadata.shards.iter().find(|shard| {
            let holds_it = episode < first_episode + shard.episodes;
            if !holds_it {
                first_episode += shard.episodes;
                first_frame += shard.frames;
            }
            holds_it
        });
        let shard = shard.ok_or_else(missing)?;
        let table = directory.join(EPISODES);
        verify(&table, &metadata.episodes_sha256)?;
        let wanted = read_episodes(&table, &info)?
            .into_iter()
            .nth(episode)
            .ok_or_else(missing)?;
        let path = directory.join(&shard.path);
        verify(&path, &shard.sha256)?;
        let size = info.frame_pixels();
        let mut pixels = vec![0; shard.frames * size];
        let mut slot = ShardSlot {
            path,
            frames: shard.frames,
            first_frame,
            target: FrameTarget::Memory {
                pixels: &mut pixels,
                masks: None,
            },
        };
        read(&info, &mut slot)?;
        let start = wanted.first_frame.saturating_sub(first_frame);
        let frames = pixels.chunks(size).skip(start).take(wanted.frame_count);
        frames
            .map(|pixels| Frame::new(info.frame_width_px, info.frame_height_px, pixels.to_vec()))
            .collect::<Result<_, _>>()
            .map_err(|error| DatasetError::Description(error.to_string()))
    }
}
