//! Writes a data set for other programs: `LeRobot` version 3 with images or videos, a bag of ROS 2, and one episode as MP4.
//!
//! Other programs expect regular times, so frame k of an episode gets the time k · frame period.

mod bag;
mod cdr;
pub mod live;
mod mcap;
mod video;

use std::path::Path;

use parquet::arrow::ArrowWriter;
use serde_json::{Value, json};

pub use self::bag::{ACTION_TOPIC, IMAGE_TOPIC, STATE_TOPIC, to_mcap};
pub use self::video::to_mp4;
use super::store::files::write_atomically;
use super::store::layout::{self, IMAGE, INFO, MASK, shard_location, shard_path};
use super::store::shard::{EncodedEpisode, ShardStart, batch, schema};
use super::store::tables::EpisodeRow;
use super::store::writer::{ShardWriter, shard_ranges, write_json, write_tables};
use super::{Dataset, DatasetError, DatasetInfo, Episode, EpisodeData};
use foreframe_core::frame::codec;

const VIDEO_PATH: &str = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4";

/// `LeRobot` works with color images: its tools want statistics of three channels, also of masks.
const CHANNELS: usize = 3;

/// Writes an empty directory as a `LeRobot` data set of version 3 with images in its tables, which `foreframe` opens, too. Without
/// a `robot_type`, it is that of the simulator, or unknown. Errors: `Encode`, `Build`, `Io`.
pub fn to_lerobot_images(dataset: &Dataset, out: &Path, robot_type: Option<&str>) -> Result<(), DatasetError> {
    let mut writer = ShardWriter::new(out, dataset.info().clone());
    for episodes in shards(dataset) {
        let mut encoded = encoded(dataset, writer.info(), episodes)?;
        for episode in &mut encoded {
            for png in episode.images.iter_mut().chain(episode.masks.iter_mut().flatten()) {
                *png = codec::encode_rgb_png(&codec::decode(png)?)?;
            }
        }
        writer.write(&encoded)?;
    }
    let info = writer.complete()?;
    let described = described(&info, robot_type, json!({"dtype": "image"}));
    write_json(&out.join(INFO), &described)
}

/// The same with the frames as H.264 videos, without masks.
/// Errors: `Usage`, `Program`, `Encode`, `Build`, `Io`.
pub fn to_lerobot_videos(dataset: &Dataset, out: &Path, robot_type: Option<&str>) -> Result<(), DatasetError> {
    let info = DatasetInfo {
        has_masks: false,
        ..dataset.info().clone()
    };
    let (width, height) = (info.frame_width_px, info.frame_height_px);
    if width % 2 == 1 || height % 2 == 1 {
        return Err(DatasetError::Usage(format!(
            "frames of {width}×{height} px cannot become a video, which needs even sides; export images, or import with \
             another --size"
        )));
    }
    let (mut records, mut start) = (Vec::new(), ShardStart::default());
    for (shard, episodes) in shards(dataset).enumerate() {
        let encoded = encoded(dataset, &info, episodes)?;
        let (bytes, end) = numbers(&info, start, &encoded)?;
        write_atomically(&out.join(shard_path(shard)), &bytes)?;
        let (chunk, file) = shard_location(shard);
        let path = out.join(format!("videos/{IMAGE}/chunk-{chunk:03}/file-{file:03}.mp4"));
        to_mp4(dataset, start.frame..end.frame, &path)?;
        start = end;
        records.extend(encoded.into_iter().map(|episode| (shard, episode.record)));
    }
    let rows = EpisodeRow::all(records.iter().map(|(shard, record)| (*shard, record)));
    write_tables(out, &info, &rows, Some(info.frame_period_s))?;
    write_json(&out.join(INFO), &video_info(&info, robot_type))
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
        let of_frames = |values: fn(&Dataset, usize) -> &[f32]| {
            let values = episode.frames().flat_map(|frame| values(dataset, frame));
            values.copied().collect()
        };
        let times = (0..episode.frame_count).map(|frame| frame as f64 * info.frame_period_s);
        let data = EpisodeData {
            timestamps_s: times.collect(),
            pixels,
            masks,
            actions: of_frames(Dataset::action),
            states: of_frames(Dataset::state),
            trial: episode.trial.clone(),
        };
        let mut encoded = EncodedEpisode::new(info, episode.index, data)?;
        for (key, stats) in &mut encoded.record.stats {
            if [IMAGE, MASK].contains(&key.as_str()) {
                *stats = stats.in_channels(CHANNELS);
            }
        }
        Ok(encoded)
    };
    episodes.iter().map(encode).collect()
}

/// A table of everything but the images, and the position after it.
fn numbers(
    info: &DatasetInfo,
    start: ShardStart,
    episodes: &[EncodedEpisode],
) -> Result<(Vec<u8>, ShardStart), DatasetError> {
    let schema = schema(info, false);
    let mut writer = ArrowWriter::try_new(Vec::new(), schema.clone(), None)?;
    let mut next = start;
    for episode in episodes {
        writer.write(&batch(info, &schema, next, episode)?)?;
        next = next.after(&episode.record);
    }
    Ok((writer.into_inner()?, next))
}

/// `LeRobot`'s `info.json` of a data set with videos.
fn video_info(info: &DatasetInfo, robot_type: Option<&str>) -> Value {
    let fps = layout::lerobot_info(info)["fps"].clone();
    let video = json!({
        "dtype": "video",
        "info": {
            "video.height": info.frame_height_px,
            "video.width": info.frame_width_px,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": false,
            "video.fps": fps,
            "video.channels": CHANNELS,
            "has_audio": false,
        },
    });
    let mut described = described(info, robot_type, video);
    described["video_path"] = json!(VIDEO_PATH);
    described
}

/// `LeRobot`'s `info.json` with color images; `image` says how they are stored.
fn described(info: &DatasetInfo, robot_type: Option<&str>, mut image: Value) -> Value {
    let mut described = layout::lerobot_info(info);
    if let Some(robot_type) = robot_type {
        described["robot_type"] = json!(robot_type);
    }
    let shape = json!([info.frame_height_px, info.frame_width_px, CHANNELS]);
    image["shape"] = shape.clone();
    image["names"] = json!(["height", "width", "channels"]);
    described["features"][IMAGE] = image;
    if info.has_masks {
        described["features"][MASK]["shape"] = shape;
    }
    described
}
