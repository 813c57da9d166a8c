//! Writes the shards of a data set in order, and the tables and metadata that complete it.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::files::{pretty_json, sha256_of_file, write_atomically};
use super::layout::{self, DatasetMetadata, EPISODES, INFO, METADATA, STATS, ShardEntry, TASKS, shard_path};
use super::shard::{EncodedEpisode, EpisodeRecord, ShardStart, build};
use super::shard_reader::records;
use super::tables::{self, EpisodeRow};
use crate::dataset::{DatasetError, DatasetInfo};
use foreframe_core::files::sha256_hex;

/// Number of frames after which a shard is closed. It holds whole episodes.
const SHARD_FRAMES: usize = 2000;

/// A data set that is being written. Its finished shards are the first ones, without gaps.
pub(crate) struct ShardWriter {
    out: PathBuf,
    /// The description, without counts and hash.
    info: DatasetInfo,
    shards: Vec<FinishedShard>,
    start: ShardStart,
}

/// A shard that has been written to disk.
struct FinishedShard {
    sha256: String,
    records: Vec<EpisodeRecord>,
}

impl ShardWriter {
    /// A data set in the directory `out` without shards.
    pub(crate) fn new(out: &Path, info: DatasetInfo) -> Self {
        Self {
            out: out.to_owned(),
            info,
            shards: Vec::new(),
            start: ShardStart::default(),
        }
    }

    /// The description of the data set, without counts and hash.
    pub(crate) fn info(&self) -> &DatasetInfo {
        &self.info
    }

    /// Number of finished shards.
    pub(crate) fn shard_count(&self) -> usize {
        self.shards.len()
    }

    /// Number of episodes in the finished shards.
    pub(crate) fn episode_count(&self) -> usize {
        self.start.episode
    }

    /// Takes the next shard from disk if an earlier call wrote it, with this number of episodes if one is given. False if it is
    /// missing, damaged or another.
    pub(crate) fn resume(&mut self, episodes: Option<usize>) -> bool {
        let path = self.out.join(shard_path(self.shards.len()));
        let Ok((records, sha256)) = records(&path).and_then(|records| Ok((records, sha256_of_file(&path)?))) else {
            return false;
        };
        let is_same = episodes.is_none_or(|episodes| records.len() == episodes);
        if is_same {
            self.push(FinishedShard { sha256, records });
        }
        is_same
    }

    /// Deletes the shards on disk that follow the finished ones, the last first, so that no gap stays. Returns how many there were.
    /// Errors: `Io`.
    pub(crate) fn discard_rest(&self) -> Result<usize, DatasetError> {
        let paths = (self.shards.len()..).map(|shard| self.out.join(shard_path(shard)));
        let paths: Vec<PathBuf> = paths.take_while(|path| path.is_file()).collect();
        for path in paths.iter().rev() {
            fs::remove_file(path).map_err(DatasetError::io("delete", path))?;
        }
        Ok(paths.len())
    }

    /// Writes the next shard. Errors: `Build`, `Invalid`, `Io`.
    pub(crate) fn write(&mut self, episodes: &[EncodedEpisode]) -> Result<(), DatasetError> {
        let (bytes, records) = build(&self.info, self.start, episodes)?;
        write_atomically(&self.out.join(shard_path(self.shards.len())), &bytes)?;
        // Parse the text as a resumed run would, so that a resumed data set has the same digits.
        let records = serde_json::from_str(&records).map_err(|error| DatasetError::Invalid(error.to_string()))?;
        let sha256 = sha256_hex(&bytes);
        self.push(FinishedShard { sha256, records });
        Ok(())
    }

    fn push(&mut self, shard: FinishedShard) {
        self.start = shard.records.iter().fold(self.start, ShardStart::after);
        self.shards.push(shard);
    }

    /// Writes the tables and metadata after all shards are written, `meta/info.json` last. Returns the description with counts and
    /// hash filled in. Errors: `Build`, `Io`.
    pub(crate) fn complete(self) -> Result<DatasetInfo, DatasetError> {
        let shards = || self.shards.iter().enumerate();
        let records = shards().flat_map(|(shard, finished)| finished.records.iter().map(move |record| (shard, record)));
        let episodes = write_tables(&self.out, &self.info, &EpisodeRow::all(records), None)?;
        let entries = shards().map(|(shard, finished)| ShardEntry {
            path: shard_path(shard),
            sha256: finished.sha256.clone(),
            episodes: finished.records.len(),
            frames: finished.records.iter().map(|record| record.frames).sum(),
        });
        let metadata = DatasetMetadata::new(self.info, entries.collect(), sha256_hex(&episodes));
        let info = metadata.info();
        write_json(&self.out.join(METADATA), &metadata)?;
        write_json(&self.out.join(INFO), &layout::lerobot_info(&info))?;
        Ok(info)
    }
}

/// Divides episodes of these lengths among shards.
pub(crate) fn shard_ranges(lengths: impl ExactSizeIterator<Item = usize>) -> Vec<Range<usize>> {
    let (mut shards, mut start, mut frames, count) = (Vec::new(), 0, 0, lengths.len());
    for (end, length) in (1..).zip(lengths) {
        frames += length;
        if frames >= SHARD_FRAMES || end == count {
            shards.push(start..end);
            (start, frames) = (end, 0);
        }
    }
    shards
}

/// Writes the tables of episodes, tasks and statistics. With a frame period, the frames are videos. Returns the bytes of the
/// first table. Errors: `Build`, `Io`.
pub(crate) fn write_tables(
    directory: &Path,
    info: &DatasetInfo,
    rows: &[EpisodeRow<'_>],
    video_period_s: Option<f64>,
) -> Result<Vec<u8>, DatasetError> {
    let task = info.scenario.as_ref().unwrap_or(&info.name);
    let episodes = tables::episodes(rows, task, video_period_s)?;
    write_atomically(&directory.join(EPISODES), &episodes)?;
    let tasks = tables::tasks(task)?;
    write_atomically(&directory.join(TASKS), &tasks)?;
    write_json(&directory.join(STATS), &tables::stats_json(rows))?;
    Ok(episodes)
}

pub(crate) fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<(), DatasetError> {
    write_atomically(path, pretty_json(value).as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::Dataset;
    use crate::dataset::info::EpisodeData;
    use foreframe_core::types::Channel;

    fn info() -> DatasetInfo {
        DatasetInfo {
            name: "made-up".to_owned(),
            frame_width_px: 4,
            frame_height_px: 2,
            frame_period_s: 0.2,
            action_channels: vec![Channel::new("linear", "m/s")],
            ..DatasetInfo::default()
        }
    }

    fn episode(frames: usize) -> EpisodeData {
        EpisodeData {
            timestamps_s: (0..frames).map(|frame| f64::from(frame as f32) * 0.25).collect(),
            pixels: (0..frames * 8).map(|i| i as u8).collect(),
            actions: (0..frames).map(|frame| frame as f32).collect(),
            ..EpisodeData::default()
        }
    }

    /// Writes a data set with one shard after two changes, and opens it with the description `described`.
    fn open_changed(
        described: DatasetInfo,
        change: impl Fn(&mut EncodedEpisode),
        change_bytes: impl Fn(&mut Vec<u8>),
    ) -> Result<Dataset, DatasetError> {
        let directory = tempfile::tempdir().unwrap();
        let mut encoded = EncodedEpisode::new(&info(), 0, episode(5)).unwrap();
        change(&mut encoded);
        let mut writer = ShardWriter::new(directory.path(), info());
        writer.write(&[encoded]).unwrap();
        let path = directory.path().join(shard_path(0));
        let mut bytes = std::fs::read(&path).unwrap();
        change_bytes(&mut bytes);
        std::fs::write(&path, &bytes).unwrap();
        writer.info = described;
        writer.shards[0].sha256 = sha256_hex(&bytes);
        writer.complete().unwrap();
        Dataset::open(directory.path())
    }

    #[test]
    fn one_component_actions_without_states_are_read_back() {
        let read = open_changed(info(), |_| {}, |_| {}).unwrap();
        let mut made = Dataset::from_episodes(info(), vec![episode(5)]).unwrap();
        made.info.content_hash = read.info.content_hash.clone();
        assert_eq!(read, made);
    }

    #[test]
    fn actions_that_are_not_finite_are_refused() {
        let error = open_changed(info(), |episode| episode.actions[2] = f32::INFINITY, |_| {}).unwrap_err();
        assert_eq!(
            error.to_string(),
            "episode 0, frame 2: action is inf; every number must be finite"
        );
    }

    #[test]
    fn frames_of_another_size_are_refused() {
        let described = DatasetInfo {
            frame_width_px: 2,
            frame_height_px: 4,
            ..info()
        };
        let message = open_changed(described, |_| {}, |_| {}).unwrap_err().to_string();
        assert!(
            message.contains("row 0 is 4×2 px; the data set has frames of 2×4 px"),
            "{message}"
        );
    }

    #[test]
    fn actions_of_another_dimension_are_refused() {
        let two = vec![Channel::new("linear", "m/s"), Channel::new("angular", "rad/s")];
        let described = DatasetInfo {
            action_channels: two,
            ..info()
        };
        let message = open_changed(described, |_| {}, |_| {}).unwrap_err().to_string();
        assert!(message.contains("no column \"action\" of vectors"), "{message}");
    }

    #[test]
    fn errors_about_damaged_files_name_the_file() {
        for kept in [0, 3, 40, 400] {
            let error = open_changed(info(), |_| {}, |bytes| bytes.truncate(kept)).unwrap_err();
            assert!(error.to_string().contains("file-000.parquet is damaged"), "{error}");
        }
        let error = open_changed(info(), |_| {}, |bytes| bytes[40..120].fill(0xA5)).unwrap_err();
        assert!(error.to_string().contains("file-000.parquet"), "{error}");
    }

    #[test]
    fn the_error_for_an_invalid_image_names_its_cause() {
        let error = open_changed(info(), |episode| episode.images[3] = vec![1, 2, 3], |_| {}).unwrap_err();
        let sentence = foreframe_core::error_text::with_causes(&error);
        let expected = "file-000.parquet, row 3: observation.image is damaged: not a readable PNG or JPEG image: ";
        assert!(sentence.contains(expected), "{sentence}");
    }

    #[test]
    fn the_content_hash_is_the_hash_of_the_shard_hashes() {
        let read = open_changed(info(), |_| {}, |_| {}).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let encoded = EncodedEpisode::new(&info(), 0, episode(5)).unwrap();
        let (bytes, _) = build(&info(), ShardStart::default(), &[encoded]).unwrap();
        let path = directory.path().join("shard");
        std::fs::write(&path, &bytes).unwrap();
        let digest = sha256_hex(super::super::files::sha256_of_file(&path).unwrap().as_bytes());
        assert_eq!(read.info().content_hash, digest);
    }
}
