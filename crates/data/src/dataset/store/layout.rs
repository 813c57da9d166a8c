//! Paths in a data set's directory (LeRobot's v3.0 layout) and the content of its metadata files.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::dataset::{DatasetError, DatasetInfo};
use foreframe_core::files::sha256_hex;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::types::{Channel, Seed};
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ShardEntry {
    pub(crate) path: PathBuf,
    pub(crate) sha256: String,
    pub(crate) episodes: usize,
    pub(crate) frames: usize,
}

/// The content of `meta/foreframe.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct DatasetMetadata {
    pub(crate) program_version: String,
    pub(crate) name: String,
    pub(crate) scenario: Option<String>,
    pub(crate) seed: Option<Seed>,
    pub(crate) frame_width_px: u32,
    pub(crate) frame_height_px: u32,
    pub(crate) frame_period_s: f64,
    pub(crate) action_channels: Vec<Channel>,
    pub(crate) state_channels: Vec<Channel>,
    pub(crate) has_masks: bool,
    /// Absent in data sets that were collected before it was recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) camera: Option<CameraModel>,
    pub(crate) content_hash: String,
    pub(crate) episodes_sha256: String,
    pub(crate) shards: Vec<ShardEntry>,
}

impl DatasetMetadata {
    /// Reads and checks the metadata of a finished data set. Errors: `Unfinished`, `NotADataset`, `OtherTool`,
    /// `Corrupt`.
    pub(crate) fn read(directory: &Path) -> Result<Self, DatasetError> {
        let arguments = directory.join(ARGUMENTS);
        if !directory.join(INFO).exists() {
            let found = std::fs::read_to_string(arguments);
            return Err(
                match found.or_else(|_| std::fs::read_to_string(directory.join(IMPORT_ARGUMENTS))) {
                    Ok(text) => DatasetError::Unfinished {
                        path: directory.to_owned(),
                        arguments: one_line(&text),
                    },
                    Err(_) => DatasetError::NotADataset {
                        path: directory.to_owned(),
                    },
                },
            );
        }
        let path = directory.join(METADATA);
        if !path.exists() {
            return Err(DatasetError::OtherTool {
                path: directory.to_owned(),
            });
        }
        let text = std::fs::read(&path).map_err(DatasetError::io("read", &path))?;
        Self::parse(&path, &text)
    }

    /// The description of the data set in that directory. Metadata of older data sets have no camera model; it is then taken
    /// from the arguments of the collection. Errors: `Corrupt`, `Io`.
    pub(crate) fn info_in(&self, directory: &Path) -> Result<DatasetInfo, DatasetError> {
        let mut info = self.info();
        info.world = collected_world(directory)?;
        let camera = info.world.as_ref().map(|world| &world.camera);
        info.camera = info.camera.or(camera.map(CameraConfig::model));
        Ok(info)
    }

    /// Parses and checks the text of a metadata file. Errors: `Corrupt`; they name `path`.
    pub(crate) fn parse(path: &Path, text: &[u8]) -> Result<Self, DatasetError> {
        let metadata: Self = serde_json::from_slice(text).map_err(|error| DatasetError::corrupt(path, &error))?;
        if metadata.content_hash != content_hash(&metadata.shards) {
            let reason = "its content hash does not match the shards that it lists";
            return Err(DatasetError::corrupt(path, &reason));
        }
        Ok(metadata)
    }

    /// The description of the data set.
    pub(crate) fn info(&self) -> DatasetInfo {
        DatasetInfo {
            name: self.name.clone(),
            frame_width_px: self.frame_width_px,
            frame_height_px: self.frame_height_px,
            frame_period_s: self.frame_period_s,
            action_channels: self.action_channels.clone(),
            state_channels: self.state_channels.clone(),
            content_hash: self.content_hash.clone(),
            scenario: self.scenario.clone(),
            seed: self.seed,
            frame_count: self.shards.iter().map(|shard| shard.frames).sum(),
            episode_count: self.shards.iter().map(|shard| shard.episodes).sum(),
            has_masks: self.has_masks,
            camera: self.camera,
            world: None,
        }
    }
}

/// The part of a collection's arguments that is used later.
#[derive(Deserialize)]
struct CollectedWith {
    /// None where no world was simulated.
    #[serde(default)]
    world: Option<WorldConfig>,
}

/// The world settings of a collection; `None` for other data sets. Errors: `Corrupt`, `Io`.
fn collected_world(directory: &Path) -> Result<Option<WorldConfig>, DatasetError> {
    let path = directory.join(ARGUMENTS);
    if !path.exists() {
        return Ok(None);
    }
    let text = std::fs::read(&path).map_err(DatasetError::io("read", &path))?;
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
        "robot_type": "turtlebot",
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

fn lerobot_features(info: &DatasetInfo) -> Value {
    let image = json!({
        "dtype": "image",
        "shape": [info.frame_height_px, info.frame_width_px, 1],
        "names": ["height", "width", "channels"],
    });
    let mut features = serde_json::Map::new();
    features.insert(IMAGE.to_owned(), image.clone());
    if info.has_masks {
        features.insert(MASK.to_owned(), image);
    }
    for (key, channels) in [(STATE, &info.state_channels), (ACTION, &info.action_channels)] {
        if !channels.is_empty() {
            let names: Vec<_> = channels.iter().map(|channel| &channel.name).collect();
            features.insert(
                key.to_owned(),
                json!({"dtype": "float32", "shape": [channels.len()], "names": names}),
            );
        }
    }
    let scalar = |dtype: &str| json!({"dtype": dtype, "shape": [1], "names": null});
    features.insert(TIMESTAMP.to_owned(), scalar("float32"));
    for key in COUNTERS {
        features.insert(key.to_owned(), scalar("int64"));
    }
    Value::Object(features)
}

/// The columns in the format of the `datasets` library, for the Parquet schema's `huggingface` entry.
pub(crate) fn huggingface_features(info: &DatasetInfo) -> Value {
    let value = |dtype: &str| json!({"dtype": dtype, "_type": "Value"});
    let mut features = serde_json::Map::new();
    features.insert(IMAGE.to_owned(), json!({"_type": "Image"}));
    if info.has_masks {
        features.insert(MASK.to_owned(), json!({"_type": "Image"}));
    }
    for (key, size) in [(STATE, info.state_channels.len()), (ACTION, info.action_channels.len())] {
        match size {
            0 => {}
            1 => {
                features.insert(key.to_owned(), value("float32"));
            }
            _ => {
                let list = json!({"feature": value("float32"), "length": size, "_type": "Sequence"});
                features.insert(key.to_owned(), list);
            }
        }
    }
    features.insert(TIMESTAMP.to_owned(), value("float32"));
    for key in COUNTERS {
        features.insert(key.to_owned(), value("int64"));
    }
    json!({"info": {"features": features}})
}
