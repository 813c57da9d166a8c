//! Paths in a data set's directory (LeRobot's v3.0 layout) and the content of its metadata files.

use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::dataset::{DatasetError, DatasetInfo};
use foreframe_core::files::sha256_hex;
use foreframe_core::types::Channel;
use foreframe_sim::{CameraConfig, WorldConfig};

/// LeRobot's description. It is written last, so a directory without it is unfinished.
pub const INFO: &str = "meta/info.json";
/// Foreframe's metadata: hashes and exact values.
pub const METADATA: &str = "meta/foreframe.json";
/// The arguments of the collection. They are written first.
pub(crate) const ARGUMENTS: &str = "meta/collect.json";
/// The source and options of an import. They are written first.
pub const IMPORT_ARGUMENTS: &str = "meta/import.json";
/// Statistics of every column.
pub(crate) const STATS: &str = "meta/stats.json";
/// The table of tasks, with one task.
pub(crate) const TASKS: &str = "meta/tasks.parquet";
/// The table of episodes.
pub(crate) const EPISODES: &str = "meta/episodes/chunk-000/file-000.parquet";

/// Largest number of files in one chunk directory.
const CHUNK_FILES: usize = 1000;

/// Names of the columns.
pub(crate) const IMAGE: &str = "observation.image";
pub(crate) const MASK: &str = "observation.mask";
pub(crate) const STATE: &str = "observation.state";
pub(crate) const ACTION: &str = "action";
pub(crate) const TIMESTAMP: &str = "timestamp";
/// The number of a frame in the data set.
pub(crate) const INDEX: &str = "index";
/// Counters that LeRobot stores for every frame.
pub(crate) const COUNTERS: [&str; 4] = ["frame_index", "episode_index", INDEX, "task_index"];

/// What a column holds.
pub(crate) enum ColumnKind<'a> {
    /// Images, as the bytes of PNG files.
    Images,
    /// These numbers of 32 bits of each frame.
    Vectors(&'a [Channel]),
    /// Seconds since the start of the episode.
    Times,
    Counters,
}

/// The columns of a shard in their order; without images if these are in videos.
pub(crate) fn columns(info: &DatasetInfo, with_images: bool) -> impl Iterator<Item = (&'static str, ColumnKind<'_>)> {
    let masks = info.has_masks.then_some((MASK, ColumnKind::Images));
    let vectors = [(STATE, &info.state_channels), (ACTION, &info.action_channels)].into_iter();
    let vectors = vectors.filter(|(_, channels)| !channels.is_empty());
    let images = with_images.then_some((IMAGE, ColumnKind::Images));
    images
        .into_iter()
        .chain(masks)
        .chain(vectors.map(|(key, channels)| (key, ColumnKind::Vectors(channels))))
        .chain([(TIMESTAMP, ColumnKind::Times)])
        .chain(COUNTERS.map(|key| (key, ColumnKind::Counters)))
}

/// Number of a shard's chunk directory, and of its file in that directory.
pub(crate) fn shard_location(shard: usize) -> (usize, usize) {
    (shard / CHUNK_FILES, shard % CHUNK_FILES)
}

/// Path of a shard in the data set's directory.
pub(crate) fn shard_path(shard: usize) -> PathBuf {
    let (chunk, file) = shard_location(shard);
    PathBuf::from(format!("data/chunk-{chunk:03}/file-{file:03}.parquet"))
}

/// One shard in the metadata.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ShardEntry {
    pub(crate) path: PathBuf,
    pub(crate) sha256: String,
    pub(crate) episodes: usize,
    pub(crate) frames: usize,
}

/// The content of `meta/foreframe.json`.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct DatasetMetadata {
    pub(crate) program_version: String,
    #[serde(flatten)]
    info: DatasetInfo,
    pub(crate) episodes_sha256: String,
    pub(crate) shards: Vec<ShardEntry>,
}

impl DatasetMetadata {
    /// The metadata of a data set with these shards.
    pub(crate) fn new(info: DatasetInfo, shards: Vec<ShardEntry>, episodes_sha256: String) -> Self {
        Self {
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            info: DatasetInfo {
                content_hash: content_hash(&shards),
                ..info
            },
            episodes_sha256,
            shards,
        }
    }

    /// Reads and checks the metadata of a finished data set. Errors: `Unfinished`, `NotFound`, `OtherTool`, `Corrupt`.
    pub(crate) fn read(directory: &Path) -> Result<Self, DatasetError> {
        if !directory.join(INFO).exists() {
            let mut arguments = [ARGUMENTS, IMPORT_ARGUMENTS].into_iter();
            let found = arguments.find_map(|path| fs::read_to_string(directory.join(path)).ok());
            return Err(found.map_or_else(
                || DatasetError::no_dataset(directory),
                |text| DatasetError::Unfinished {
                    path: directory.to_owned(),
                    arguments: one_line(&text),
                },
            ));
        }
        let path = directory.join(METADATA);
        if !path.exists() {
            return Err(DatasetError::OtherTool(directory.to_owned()));
        }
        let text = fs::read(&path).map_err(DatasetError::io("read", &path))?;
        Self::parse(&path, &text)
    }

    /// The description of the data set in that directory. Metadata of older data sets have no camera model; it is then taken
    /// from the arguments of the collection, unless each trial has a camera of its own. Errors: `Corrupt`, `Io`.
    pub(crate) fn info_in(&self, directory: &Path) -> Result<DatasetInfo, DatasetError> {
        let mut info = self.info();
        info.world = collected_world(directory)?;
        info.camera = info.camera.or(info.common_camera().map(CameraConfig::model));
        Ok(info)
    }

    /// Parses and checks the text of a metadata file. Errors: `Corrupt`; they name `path`.
    pub(crate) fn parse(path: &Path, text: &[u8]) -> Result<Self, DatasetError> {
        let metadata: Self = serde_json::from_slice(text).map_err(|error| DatasetError::corrupt(path, &error))?;
        if metadata.info.content_hash != content_hash(&metadata.shards) {
            let reason = "its content hash does not match the shards that it lists";
            return Err(DatasetError::corrupt(path, &reason));
        }
        Ok(metadata)
    }

    /// The description of the data set.
    pub(crate) fn info(&self) -> DatasetInfo {
        DatasetInfo {
            frame_count: self.shards.iter().map(|shard| shard.frames).sum(),
            episode_count: self.shards.iter().map(|shard| shard.episodes).sum(),
            ..self.info.clone()
        }
    }
}

/// The part of a collection's arguments that is used later.
#[derive(Deserialize)]
struct CollectedWith {
    /// None where no world was simulated.
    world: Option<WorldConfig>,
}

/// The world settings of a collection; `None` for other data sets. Errors: `Corrupt`, `Io`.
fn collected_world(directory: &Path) -> Result<Option<WorldConfig>, DatasetError> {
    let path = directory.join(ARGUMENTS);
    if !path.exists() {
        return Ok(None);
    }
    let text = fs::read(&path).map_err(DatasetError::io("read", &path))?;
    let arguments: CollectedWith =
        serde_json::from_slice(&text).map_err(|error| DatasetError::corrupt(&path, &error))?;
    Ok(arguments.world)
}

/// The SHA-256 of the shards' hexadecimal hashes, one after another, in hexadecimal.
pub(crate) fn content_hash(shards: &[ShardEntry]) -> String {
    let hashes: String = shards.iter().map(|shard| shard.sha256.as_str()).collect();
    sha256_hex(hashes.as_bytes())
}

/// A JSON object without line breaks, for a message.
fn one_line(text: &str) -> String {
    serde_json::from_str::<Value>(text).map_or_else(|_| text.trim().to_owned(), |value| value.to_string())
}

/// LeRobot's `info.json` of a data set.
pub(crate) fn lerobot_info(info: &DatasetInfo) -> Value {
    json!({
        "codebase_version": "v3.0",
        "robot_type": if info.scenario.is_some() { "turtlebot" } else { "unknown" },
        "total_episodes": info.episode_count,
        "total_frames": info.frame_count,
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": frame_rate(info.frame_period_s),
        "splits": {"train": format!("0:{}", info.episode_count)},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": null,
        "features": lerobot_features(info),
    })
}

/// Frames per second: an integer if possible, because LeRobot expects one.
fn frame_rate(period_s: f64) -> Value {
    let rate = 1.0 / period_s;
    if (rate - rate.round()).abs() < 1e-6 * rate {
        json!(rate.round() as u64)
    } else {
        json!(rate)
    }
}

fn lerobot_features(info: &DatasetInfo) -> Map<String, Value> {
    let feature = |(key, kind): (&str, _)| {
        let (dtype, shape, names) = match kind {
            ColumnKind::Images => (
                "image",
                vec![info.frame_height_px as usize, info.frame_width_px as usize, 1],
                json!(["height", "width", "channels"]),
            ),
            ColumnKind::Vectors(channels) => (
                "float32",
                vec![channels.len()],
                channels.iter().map(|channel| channel.name.as_str()).collect(),
            ),
            ColumnKind::Times => ("float32", vec![1], Value::Null),
            ColumnKind::Counters => ("int64", vec![1], Value::Null),
        };
        (key.to_owned(), json!({"dtype": dtype, "shape": shape, "names": names}))
    };
    columns(info, true).map(feature).collect()
}

/// The columns in the format of the `datasets` library, for the Parquet schema's `huggingface` entry.
pub(crate) fn huggingface_features(info: &DatasetInfo, with_images: bool) -> Value {
    let value = |dtype: &str| json!({"dtype": dtype, "_type": "Value"});
    let feature = |(key, kind): (&str, _)| {
        let described = match kind {
            ColumnKind::Images => json!({"_type": "Image"}),
            ColumnKind::Vectors(channels) if channels.len() > 1 => {
                json!({"feature": value("float32"), "length": channels.len(), "_type": "Sequence"})
            }
            ColumnKind::Vectors(_) | ColumnKind::Times => value("float32"),
            ColumnKind::Counters => value("int64"),
        };
        (key.to_owned(), described)
    };
    let features: Map<String, Value> = columns(info, with_images).map(feature).collect();
    json!({"info": {"features": features}})
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_fields_of_the_metadata_are_refused() {
        let metadata = DatasetMetadata::new(DatasetInfo::default(), Vec::new(), String::new());
        let text = serde_json::to_string(&metadata).unwrap();
        let path = Path::new(METADATA);
        assert!(DatasetMetadata::parse(path, text.as_bytes()).is_ok());
        let changed = text.replacen('{', "{\"colour\":1,", 1);
        let error = DatasetMetadata::parse(path, changed.as_bytes()).err().unwrap();
        assert!(error.to_string().contains("unknown field `colour`"), "{error}");
    }
}
