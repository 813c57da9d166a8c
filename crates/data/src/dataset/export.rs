//! Writes a data set for other programs: `LeRobot` version 3 with images or videos, a bag of ROS 2, and one episode as MP4.
//!
//! Other programs expect regular times, so frame k of an episode gets the time k · frame period.

mod bag;
mod cdr;
mod mcap;
mod video;

use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;

use arrow_array::RecordBatch;
use arrow_schema::{ArrowError, SchemaRef};
use parquet::arrow::ArrowWriter;
use parquet::errors::ParquetError;
use serde_json::{Value, json};

pub use self::bag::{ACTION_TOPIC, IMAGE_TOPIC, STATE_TOPIC, to_mcap};
use super::store::files::write_atomically;
use super::store::layout::{self, IMAGE, INFO, MASK, shard_location, shard_path};
use super::store::shard::{EncodedEpisode, ShardStart, batch, schema};
use super::store::tables::{self, EpisodeRow};
use super::store::writer::{ShardWriter, shard_ranges, write_json, write_tables};
use super::{Dataset, DatasetError, DatasetInfo, Episode, EpisodeData};

const VIDEO_PATH: &str = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4";

/// Writes an empty directory as a `LeRobot` data set of version 3 with images in its tables, which `foreframe` opens, too.
/// Errors: `Encode`, `Build`, `Io`.
pub fn to_lerobot_images(dataset: &Dataset, out: &Path) -> Result<(), DatasetError> {
    let info = DatasetInfo {
        content_hash: String::new(),
        ..dataset.info().clone()
    };
    let mut writer = ShardWriter::new(out, info);
    for episodes in shards(dataset) {
        let encoded = encoded(dataset, writer.info(), episodes)?;
        writer.write(&encoded)?;
    }
    writer.complete().map(drop)
}

/// Writes an empty directory as a `LeRobot` data set of version 3 with its frames as H.264 videos, without masks.
/// Errors: `OddFrames`, `Program`, `Encode`, `Build`, `Io`.
pub fn to_lerobot_videos(dataset: &Dataset, out: &Path) -> Result<(), DatasetError> {
    let info = DatasetInfo {
        has_masks: false,
        ..dataset.info().clone()
    };
    if info.frame_width_px % 2 == 1 || info.frame_height_px % 2 == 1 {
        return Err(DatasetError::OddFrames {
            width: info.frame_width_px,
            height: info.frame_height_px,
        });
    }
    let (mut records, mut start) = (Vec::new(), ShardStart { episode: 0, frame: 0 });
    for (shard, episodes) in shards(dataset).enumerate() {
        let encoded = encoded(dataset, &info, episodes)?;
        let bytes = numbers(&info, start, &encoded).map_err(DatasetError::Build)?;
        write_atomically(&out.join(shard_path(shard)), &bytes)?;
        let end = after(start, &encoded);
        let (chunk, file) = shard_location(shard);
        let path = out.join(format!("videos/{IMAGE}/chunk-{chunk:03}/file-{file:03}.mp4"));
        video::write(dataset, start.frame..end.frame, &path)?;
        start = end;
        records.extend(encoded.into_iter().map(|episode| (shard, episode.record)));
    }
    let mut first_frame = 0;
    let mut rows = Vec::new();
    for (shard, record) in &records {
        rows.push(EpisodeRow {
            record,
            shard: *shard,
            first_frame,
        });
        first_frame += record.frames;
    }
    write_tables(out, &info, &rows, |rows, task| {
        tables::episodes_with_videos(rows, task, info.frame_period_s)
    })?;
    write_json(&out.join(INFO), &video_info(&info))
}

/// Writes frames of one episode, counted over the whole data set, as an MP4 file. Errors: `Program`, `Io`.
pub fn to_mp4(dataset: &Dataset, frames: Range<usize>, path: &Path) -> Result<(), DatasetError> {
    video::write(dataset, frames, path)
}

/// The episodes of each shard.
fn shards(dataset: &Dataset) -> impl Iterator<Item = &[Episode]> {
    let lengths = dataset.episodes().iter().map(|episode| episode.frame_count);
    shard_ranges(lengths)
        .into_iter()
        .map(|range| &dataset.episodes()[range])
}

/// The episodes with regular times.
fn encoded(dataset: &Dataset, info: &DatasetInfo, episodes: &[Episode]) -> Result<Vec<EncodedEpisode>, DatasetError> {
    let encode = |episode: &Episode| {
        let (mut pixels, mut masks) = (Vec::new(), info.has_masks.then(Vec::new));
        for frame in episode.frames() {
            pixels.extend_from_slice(&dataset.pixels(frame)?);
            if let (Some(masks), Some(mask)) = (&mut masks, dataset.mask(frame)?) {
                masks.extend_from_slice(&mask);
            }
        }
        let data = EpisodeData {
            timestamps_s: (0..episode.frame_count)
                .map(|frame| frame as f64 * info.frame_period_s)
                .collect(),
            pixels,
            masks,
            actions: episode
                .frames()
                .flat_map(|frame| dataset.action(frame))
                .copied()
                .collect(),
            states: episode
                .frames()
                .flat_map(|frame| dataset.state(frame))
                .copied()
                .collect(),
            trial: episode.trial.clone(),
        };
        EncodedEpisode::new(info, episode.index, data)
    };
    episodes.iter().map(encode).collect()
}

fn after(start: ShardStart, episodes: &[EncodedEpisode]) -> ShardStart {
    ShardStart {
        episode: start.episode + episodes.len(),
        frame: start.frame + episodes.iter().map(|episode| episode.record.frames).sum::<usize>(),
    }
}

/// A table of everything but the images.
fn numbers(info: &DatasetInfo, start: ShardStart, episodes: &[EncodedEpisode]) -> Result<Vec<u8>, ParquetError> {
    let whole = schema(info);
    let kept: Vec<usize> = (0..whole.fields().len())
        .filter(|&column| *whole.field(column).name() != IMAGE)
        .collect();
    let schema = without_images(info, &whole, &kept)?;
    let mut writer = ArrowWriter::try_new(Vec::new(), schema.clone(), None)?;
    let mut next = start;
    for episode in episodes {
        let numbers = batch(info, &whole, next, episode)?.project(&kept)?;
        writer.write(&RecordBatch::try_new(schema.clone(), numbers.columns().to_vec())?)?;
        next = after(next, std::slice::from_ref(episode));
    }
    writer.into_inner()
}

/// The schema of the kept columns; the description for the `datasets` library has no images either.
fn without_images(info: &DatasetInfo, whole: &SchemaRef, kept: &[usize]) -> Result<SchemaRef, ArrowError> {
    let mut described = layout::huggingface_features(info);
    if let Some(features) = described["info"]["features"].as_object_mut() {
        features.remove(IMAGE);
    }
    let metadata = HashMap::from([("huggingface".to_owned(), described.to_string())]);
    Ok(whole.project(kept)?.with_metadata(metadata).into())
}

/// `LeRobot`'s `info.json` of a data set with videos.
fn video_info(info: &DatasetInfo) -> Value {
    let mut described = layout::lerobot_info(info);
    described["video_path"] = json!(VIDEO_PATH);
    let fps = described["fps"].clone();
    described["features"][IMAGE] = json!({
        "dtype": "video",
        "shape": [info.frame_height_px, info.frame_width_px, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": info.frame_height_px,
            "video.width": info.frame_width_px,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": false,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": false,
        },
    });
    if let Some(features) = described["features"].as_object_mut() {
        features.remove(MASK);
    }
    described
}
