//! Reads one episode of a data set on disk. Only the shard with this episode is read and verified.

use std::path::Path;

use super::files::verify;
use super::layout::{DatasetMetadata, EPISODES};
use super::shard_reader::{ImageTarget, Shard};
use super::tables::read_episodes;
use crate::dataset::{Dataset, DatasetError, DatasetInfo, EpisodeData};
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
    /// The frames of one episode. Errors: as [`Dataset::read_episode`].
    pub fn episode_frames(directory: &Path, episode: usize) -> Result<Vec<Frame>, DatasetError> {
        let (info, data) = Self::read_episode(directory, episode)?;
        let frames = data.pixels.chunks_exact(info.frame_pixels());
        let frame = |pixels: &[u8]| Frame::new(info.frame_width_px, info.frame_height_px, pixels.to_vec());
        frames.map(|pixels| Ok(frame(pixels)?)).collect()
    }

    /// One episode without masks, and the data set's description. Errors: `NoEpisode`, and those of [`Dataset::open`].
    pub fn read_episode(directory: &Path, episode: usize) -> Result<(DatasetInfo, EpisodeData), DatasetError> {
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
        let frames = FrameRange {
            start: wanted.first_frame.saturating_sub(shard.frames.start),
            count: wanted.frame_count,
        };
        let data = EpisodeData {
            timestamps_s: frames.of(content.timestamps_s, 1),
            pixels: frames.of(content.pixels, 1).concat(),
            masks: None,
            actions: frames.of(content.actions, info.action_channels.len()),
            states: frames.of(content.states, info.state_channels.len()),
            trial: wanted.trial.clone(),
        };
        Ok((info, data))
    }
}

/// Frames of a shard.
struct FrameRange {
    start: usize,
    count: usize,
}

impl FrameRange {
    /// The values of these frames, of `each` values a frame.
    fn of<T>(&self, values: Vec<T>, each: usize) -> Vec<T> {
        let values = values.into_iter().skip(self.start * each);
        values.take(self.count * each).collect()
    }
}
