//! A shard: the frames of some consecutive episodes as a Parquet file, with one row group for each episode. Its footer also
//! contains the record of each episode, so that an interrupted collection can resume from the shards alone.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use arrow_array::{
    ArrayRef, BinaryArray, FixedSizeListArray, Float32Array, Int64Array, RecordBatch, StringArray, StructArray,
};
use arrow_schema::{ArrowError, DataType, Field, Fields, Schema, SchemaRef};
use parquet::arrow::ArrowWriter;
use parquet::basic::Compression;
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;
use serde::{Deserialize, Serialize};

use super::layout::{ACTION, COUNTERS, IMAGE, MASK, STATE, TIMESTAMP, huggingface_features};
use super::stats::ChannelStats;
use crate::dataset::check::check_episode;
use crate::dataset::{DatasetError, DatasetInfo, EpisodeData};
use foreframe_core::frame::{Frame, codec};

/// Key of the episode records in a shard's footer.
pub(crate) const RECORDS_KEY: &str = "foreframe.episodes";

/// Data of an episode besides its frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct EpisodeRecord {
    pub(crate) frames: usize,
    /// Parameters of the trial as JSON; none for recordings.
    pub(crate) trial: Option<String>,
    /// Statistics of the columns whose values do not follow from the episode's position.
    pub(crate) stats: BTreeMap<String, ChannelStats>,
}

/// An episode with encoded frames, ready to be written.
pub(crate) struct EncodedEpisode {
    pub(crate) images: Vec<Vec<u8>>,
    pub(crate) masks: Option<Vec<Vec<u8>>>,
    pub(crate) actions: Vec<f32>,
    pub(crate) states: Vec<f32>,
    pub(crate) timestamps_s: Vec<f32>,
    pub(crate) record: EpisodeRecord,
}

impl EncodedEpisode {
    /// Checks an episode as [`crate::dataset::Dataset::from_episodes`] does, and encodes its frames. `episode` is its position.
    pub(crate) fn new(info: &DatasetInfo, episode: usize, data: EpisodeData) -> Result<Self, DatasetError> {
        check_episode(info, episode, &data)?;
        let frames = data.timestamps_s.len();
        let timestamps_s: Vec<f32> = data.timestamps_s.iter().map(|&time| time as f32).collect();
        let mut stats = BTreeMap::from([
            (IMAGE.to_owned(), ChannelStats::of_pixels(&data.pixels, frames)),
            (TIMESTAMP.to_owned(), rows_stats(&timestamps_s, 1)),
        ]);
        if let Some(masks) = &data.masks {
            stats.insert(MASK.to_owned(), ChannelStats::of_pixels(masks, frames));
        }
        for (key, values, size) in [
            (STATE, &data.states, info.state_channels.len()),
            (ACTION, &data.actions, info.action_channels.len()),
        ] {
            if size > 0 {
                stats.insert(key.to_owned(), rows_stats(values, size));
            }
        }
        let trial = data.trial.as_ref().map(serde_json::to_string).transpose();
        Ok(Self {
            images: encode_frames(info, &data.pixels)?,
            masks: data
                .masks
                .as_deref()
                .map(|masks| encode_frames(info, masks))
                .transpose()?,
            actions: data.actions,
            states: data.states,
            timestamps_s,
            record: EpisodeRecord {
                frames,
                trial: trial.map_err(|error| DatasetError::Description(error.to_string()))?,
                stats,
            },
        })
    }
}

fn rows_stats(values: &[f32], size: usize) -> ChannelStats {
    let values: Vec<f64> = values.iter().map(|&value| f64::from(value)).collect();
    ChannelStats::of_rows(&values, size)
}

fn encode_frames(info: &DatasetInfo, pixels: &[u8]) -> Result<Vec<Vec<u8>>, DatasetError> {
    pixels
        .chunks(info.frame_pixels())
        .map(|frame| {
            Frame::new(info.frame_width_px, info.frame_height_px, frame.to_vec())
                .and_then(|frame| codec::encode_png(&frame))
                .map_err(DatasetError::Encode)
        })
        .collect()
}

/// Position of a shard in its data set.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ShardStart {
    /// Number of episodes before it.
    pub(crate) episode: usize,
    /// Number of frames before it.
    pub(crate) frame: usize,
}

/// The bytes of a shard, and its episode records as JSON.
pub(crate) struct ShardBytes {
    pub(crate) bytes: Vec<u8>,
    pub(crate) records: String,
}

/// Writes a shard's episodes as a Parquet file in memory. Errors: `Build`, `Description`.
pub(crate) fn build(
    info: &DatasetInfo,
    start: ShardStart,
    episodes: &[EncodedEpisode],
) -> Result<ShardBytes, DatasetError> {
    let records: Vec<_> = episodes.iter().map(|episode| &episode.record).collect();
    let records = serde_json::to_string(&records).map_err(|error| DatasetError::Description(error.to_string()))?;
    let bytes = write_parquet(info, start, episodes, &records).map_err(DatasetError::Build)?;
    Ok(ShardBytes { bytes, records })
}

fn write_parquet(
    info: &DatasetInfo,
    start: ShardStart,
    episodes: &[EncodedEpisode],
    records: &str,
) -> Result<Vec<u8>, ParquetError> {
    let schema = schema(info);
    let mut writer = ArrowWriter::try_new(Vec::new(), schema.clone(), Some(properties()))?;
    let mut next = start;
    for episode in episodes {
        writer.write(&batch(info, &schema, next, episode)?)?;
        writer.flush()?;
        next = ShardStart {
            episode: next.episode + 1,
            frame: next.frame + episode.record.frames,
        };
    }
    writer.append_key_value_metadata(KeyValue::new(RECORDS_KEY.to_owned(), records.to_owned()));
    writer.into_inner()
}

/// PNG images are already compressed, so their column is not compressed again. Masks often repeat, so their column keeps
/// its dictionary.
fn properties() -> WriterProperties {
    let image = ColumnPath::new(vec![IMAGE.to_owned(), "bytes".to_owned()]);
    let mask = ColumnPath::new(vec![MASK.to_owned(), "bytes".to_owned()]);
    WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_column_compression(image.clone(), Compression::UNCOMPRESSED)
        .set_column_dictionary_enabled(image.clone(), false)
        .set_column_statistics_enabled(image, EnabledStatistics::None)
        .set_column_statistics_enabled(mask, EnabledStatistics::None)
        .build()
}

fn image_fields() -> Fields {
    Fields::from(vec![
        Field::new("bytes", DataType::Binary, true),
        Field::new("path", DataType::Utf8, true),
    ])
}

fn item_field() -> Arc<Field> {
    Arc::new(Field::new("element", DataType::Float32, true))
}

/// The type of a column of vectors: a plain number where they have one component, as LeRobot has it.
fn vector_type(size: usize) -> DataType {
    match size {
        1 => DataType::Float32,
        _ => DataType::FixedSizeList(item_field(), size as i32),
    }
}

/// The columns of a shard.
pub(crate) fn schema(info: &DatasetInfo) -> SchemaRef {
    let mut fields = vec![Field::new(IMAGE, DataType::Struct(image_fields()), true)];
    if info.has_masks {
        fields.push(Field::new(MASK, DataType::Struct(image_fields()), true));
    }
    for (key, size) in [(STATE, info.state_channels.len()), (ACTION, info.action_channels.len())] {
        if size > 0 {
            fields.push(Field::new(key, vector_type(size), true));
        }
    }
    fields.push(Field::new(TIMESTAMP, DataType::Float32, true));
    fields.extend(COUNTERS.map(|key| Field::new(key, DataType::Int64, true)));
    let metadata = HashMap::from([("huggingface".to_owned(), huggingface_features(info).to_string())]);
    Arc::new(Schema::new(fields).with_metadata(metadata))
}

/// The rows of one episode.
pub(crate) fn batch(
    info: &DatasetInfo,
    schema: &SchemaRef,
    start: ShardStart,
    episode: &EncodedEpisode,
) -> Result<RecordBatch, ArrowError> {
    let frames = episode.record.frames;
    let mut columns = vec![image_column(&episode.images)?];
    if let Some(masks) = &episode.masks {
        columns.push(image_column(masks)?);
    }
    for (values, size) in [
        (&episode.states, info.state_channels.len()),
        (&episode.actions, info.action_channels.len()),
    ] {
        if size > 0 {
            columns.push(vector_column(values, size)?);
        }
    }
    let counter = |value: fn(usize, usize) -> usize, first: usize| -> ArrayRef {
        Arc::new(Int64Array::from_iter_values(
            (0..frames).map(|frame| value(first, frame) as i64),
        ))
    };
    columns.push(Arc::new(Float32Array::from(episode.timestamps_s.clone())));
    columns.push(counter(|_, frame| frame, 0));
    columns.push(counter(|first, _| first, start.episode));
    columns.push(counter(|first, frame| first + frame, start.frame));
    columns.push(counter(|_, _| 0, 0));
    RecordBatch::try_new(schema.clone(), columns)
}

fn image_column(images: &[Vec<u8>]) -> Result<ArrayRef, ArrowError> {
    let bytes: ArrayRef = Arc::new(BinaryArray::from_iter_values(images));
    let paths: ArrayRef = Arc::new(StringArray::new_null(images.len()));
    Ok(Arc::new(StructArray::try_new(
        image_fields(),
        vec![bytes, paths],
        None,
    )?))
}

fn vector_column(values: &[f32], size: usize) -> Result<ArrayRef, ArrowError> {
    let numbers: ArrayRef = Arc::new(Float32Array::from(values.to_vec()));
    if size == 1 {
        return Ok(numbers);
    }
    Ok(Arc::new(FixedSizeListArray::try_new(
        item_field(),
        size as i32,
        numbers,
        None,
    )?))
}
