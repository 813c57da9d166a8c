//! Reads a complete data set from disk, and writes the tables and metadata that complete one.

use std::path::Path;
use std::sync::Arc;

use arrow_array::types::Int64Type;
use rayon::prelude::*;

use super::check::check_numbers;
use super::files::{sha256_of_file, verify, write_atomically};
use super::frame_file::{FrameFile, FrameFilePlace};
use super::frame_store::{FrameStore, HeldFrames};
use super::layout::{self, DatasetMetadata, EPISODES, INFO, METADATA, STATS, ShardEntry, TASKS};
use super::shard::{EpisodeRecord, ShardBytes};
use super::shard_reader::{Column, FrameTarget, ShardNumbers, ShardSlot, batches, read, records};
use super::tables::{self, EpisodeRow};
use super::{Dataset, DatasetError, DatasetInfo, Episode, TrialParameters};
use foreframe_core::files::sha256_hex;

impl Dataset {
    /// Reads a complete data set into memory and verifies the hash of every file.
    /// Errors: `NotADataset`, `Unfinished`, `HashDiffers`, `Corrupt`, `CorruptFrame`, `Io`, `NotFinite`, `TimeOrder`.
    pub fn open(directory: &Path) -> Result<Self, DatasetError> {
        Self::open_within(directory, u64::MAX >> 20)
    }

    /// As [`Dataset::open`], but holds the frames in memory only if they need at most `memory_mb` MiB. Otherwise they are
    /// decoded into a file in the directory `.cache` of the data set, unless an earlier call did so, and are read from there
    /// when they are used. Errors: as [`Dataset::open`], and `FrameFile`.
    pub fn open_within(directory: &Path, memory_mb: u64) -> Result<Self, DatasetError> {
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
        let (frames, numbers) = if info.decoded_bytes() <= memory_mb << 20 {
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

/// Reads the table of episodes. Errors: `Io`, `Corrupt`.
pub(super) fn read_episodes(path: &Path, info: &DatasetInfo) -> Result<Vec<Episode>, DatasetError> {
    let corrupt = |reason: String| DatasetError::Corrupt {
        path: path.to_owned(),
        reason,
    };
    let mut episodes = Vec::with_capacity(info.episode_count);
    let mut first_frame = 0;
    for batch in &batches(path)? {
        let column = Column { batch, path };
        let lengths = column.numbers::<Int64Type>("length")?;
        for (&length, trial) in lengths.iter().zip(column.texts("trial")?) {
            let frame_count = usize::try_from(length).map_err(|error| corrupt(error.to_string()))?;
            let trial: Option<TrialParameters> = trial
                .map(serde_json::from_str)
                .transpose()
                .map_err(|error| corrupt(format!("trial of episode {}: {error}", episodes.len())))?;
            episodes.push(Episode {
                index: episodes.len(),
                first_frame,
                frame_count,
                trial,
            });
            first_frame += frame_count;
        }
    }
    if (episodes.len(), first_frame) != (info.episode_count, info.frame_count) {
        return Err(corrupt(format!(
            "it has {} episodes with {first_frame} frames in total; the metadata states {} episodes with {} frames",
            episodes.len(),
            info.episode_count,
            info.frame_count
        )));
    }
    Ok(episodes)
}

/// A shard that has been written to disk.
pub(super) struct FinishedShard {
    pub(super) sha256: String,
    pub(super) records: Vec<EpisodeRecord>,
}

impl FinishedShard {
    /// Writes a shard. Errors: `Io`, `Description`.
    pub(super) fn write(path: &Path, built: &ShardBytes) -> Result<Self, DatasetError> {
        write_atomically(path, &built.bytes)?;
        // Parse the text as a resumed run would, so that a resumed data set has the same digits.
        let records = serde_json::from_str(&built.records);
        Ok(Self {
            sha256: sha256_hex(&built.bytes),
            records: records.map_err(|error| DatasetError::Description(error.to_string()))?,
        })
    }

    /// A shard that was written before; none if it is missing or damaged.
    pub(super) fn read(path: &Path) -> Option<Self> {
        Some(Self {
            records: records(path).ok()?,
            sha256: sha256_of_file(path).ok()?,
        })
    }

    /// Number of frames in the shard.
    pub(super) fn frames(&self) -> usize {
        self.records.iter().map(|record| record.frames).sum()
    }
}

/// Writes the tables and metadata of a data set whose shards are all written, `meta/info.json` last. Returns `info` with
/// counts and hash filled in. Errors: `Build`, `Io`.
pub(super) fn complete(
    directory: &Path,
    info: DatasetInfo,
    shards: &[FinishedShard],
) -> Result<DatasetInfo, DatasetError> {
    let mut rows = Vec::new();
    let mut first_frame = 0;
    for (shard, finished) in shards.iter().enumerate() {
        for record in &finished.records {
            rows.push(EpisodeRow {
                record,
                shard,
                first_frame,
            });
            first_frame += record.frames;
        }
    }
    let task = info.scenario.clone().unwrap_or_else(|| info.name.clone());
    let episodes = tables::episodes(&rows, &task).map_err(DatasetError::Build)?;
    let world = info.world.clone();
    let metadata = metadata(info, shards, sha256_hex(&episodes));
    let info = DatasetInfo {
        world,
        ..metadata.info()
    };
    write_atomically(&directory.join(EPISODES), &episodes)?;
    let tasks = tables::tasks(&task).map_err(DatasetError::Build)?;
    write_atomically(&directory.join(TASKS), &tasks)?;
    write_json(&directory.join(STATS), &tables::stats_json(&rows))?;
    write_json(&directory.join(METADATA), &metadata)?;
    write_json(&directory.join(INFO), &layout::lerobot_info(&info))?;
    Ok(info)
}

fn metadata(info: DatasetInfo, shards: &[FinishedShard], episodes_sha256: String) -> DatasetMetadata {
    let entries: Vec<_> = shards
        .iter()
        .enumerate()
        .map(|(shard, finished)| ShardEntry {
            path: layout::shard_path(shard),
            sha256: finished.sha256.clone(),
            episodes: finished.records.len(),
            frames: finished.frames(),
        })
        .collect();
    DatasetMetadata {
        program_version: env!("CARGO_PKG_VERSION").to_owned(),
        name: info.name,
        scenario: info.scenario,
        seed: info.seed,
        frame_width_px: info.frame_width_px,
        frame_height_px: info.frame_height_px,
        frame_period_s: info.frame_period_s,
        action_channels: info.action_channels,
        state_channels: info.state_channels,
        has_masks: info.has_masks,
        camera: info.camera,
        content_hash: layout::content_hash(&entries),
        episodes_sha256,
        shards: entries,
    }
}

pub(super) fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<(), DatasetError> {
    let mut text = serde_json::to_string_pretty(value).map_err(|error| DatasetError::Description(error.to_string()))?;
    text.push('\n');
    write_atomically(path, text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::super::EpisodeData;
    use super::super::shard::{EncodedEpisode, ShardStart, build};
    use super::*;
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
        let start = ShardStart { episode: 0, frame: 0 };
        let mut built = build(&info(), start, &[encoded]).unwrap();
        change_bytes(&mut built.bytes);
        let shard = FinishedShard::write(&directory.path().join(layout::shard_path(0)), &built).unwrap();
        complete(directory.path(), described, &[shard]).unwrap();
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
        let built = build(&info(), ShardStart { episode: 0, frame: 0 }, &[encoded]).unwrap();
        let path = directory.path().join("shard");
        std::fs::write(&path, &built.bytes).unwrap();
        let digest = sha256_hex(super::super::files::sha256_of_file(&path).unwrap().as_bytes());
        assert_eq!(read.info().content_hash, digest);
    }
}
