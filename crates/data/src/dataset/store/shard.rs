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

use super::files::json_text;
use super::layout::{ACTION, ColumnKind, IMAGE, MASK, STATE, TIMESTAMP, columns, huggingface_features};
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
        let mut stats = BTreeMap::from([(IMAGE.to_owned(), ChannelStats::of_pixels(&data.pixels, frames))]);
        if let Some(masks) = &data.masks {
            stats.insert(MASK.to_owned(), ChannelStats::of_pixels(masks, frames));
        }
        for (key, values, size) in [
            (STATE, &data.states, info.state_channels.len()),
            (ACTION, &data.actions, info.action_channels.len()),
            (TIMESTAMP, &timestamps_s, 1),
        ] {
            if size > 0 {
                let values: Vec<f64> = values.iter().map(|&value| f64::from(value)).collect();
                stats.insert(key.to_owned(), ChannelStats::of_rows(&values, size));
            }
        }
        let masks = data.masks.as_deref().map(|masks| encode_frames(info, masks));
        Ok(Self {
            images: encode_frames(info, &data.pixels)?,
            masks: masks.transpose()?,
            actions: data.actions,
            states: data.states,
            timestamps_s,
            record: EpisodeRecord {
                frames,
                trial: data.trial.as_ref().map(json_text),
                stats,
            },
        })
    }
}

fn encode_frames(info: &DatasetInfo, pixels: &[u8]) -> Result<Vec<Vec<u8>>, DatasetError> {
    let encode = |pixels: &[u8]| {
        let frame = Frame::new(info.frame_width_px, info.frame_height_px, pixels.to_vec())?;
        Ok(codec::encode_png(&frame)?)
    };
    pixels.chunks(info.frame_pixels()).map(encode).collect()
}

/// Position of a shard in its data set.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ShardStart {
    /// Number of episodes before it.
    pub(crate) episode: usize,
    /// Number of frames before it.
    pub(crate) frame: usize,
}

impl ShardStart {
    /// The position after an episode.
    pub(crate) fn after(self, episode: &EpisodeRecord) -> Self {
        Self {
            episode: self.episode + 1,
            frame: self.frame + episode.frames,
        }
    }
}

/// Writes a shard's episodes as a Parquet file in memory. Returns its bytes, and the episode records as JSON. Errors: `Build`.
pub(crate) fn build(
    info: &DatasetInfo,
    start: ShardStart,
    episodes: &[EncodedEpisode],
) -> Result<(Vec<u8>, String), DatasetError> {
    let records = json_text(&episodes.iter().map(|episode| &episode.record).collect::<Vec<_>>());
    let schema = schema(info, true);
    let mut writer = ArrowWriter::try_new(Vec::new(), schema.clone(), Some(properties()))?;
    let mut next = start;
    for episode in episodes {
        writer.write(&batch(info, &schema, next, episode)?)?;
        writer.flush()?;
        next = next.after(&episode.record);
    }
    writer.append_key_value_metadata(KeyValue::new(RECORDS_KEY.to_owned(), records.clone()));
    Ok((writer.into_inner()?, records))
}

/// PNG images are already compressed, so their column is not compressed again. Masks often repeat, so their column keeps
/// its dictionary.
fn properties() -> WriterProperties {
    let [image, mask] = [IMAGE, MASK].map(|key| ColumnPath::new(vec![key.to_owned(), "bytes".to_owned()]));
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

/// The columns of a shard. Vectors of one component are plain numbers, as LeRobot has them.
pub(crate) fn schema(info: &DatasetInfo, with_images: bool) -> SchemaRef {
    let field = |(key, kind): (&str, _)| {
        let data_type = match kind {
            ColumnKind::Images => DataType::Struct(image_fields()),
            ColumnKind::Vectors(channels) if channels.len() > 1 => {
                DataType::FixedSizeList(item_field(), channels.len() as i32)
            }
            ColumnKind::Vectors(_) | ColumnKind::Times => DataType::Float32,
            ColumnKind::Counters => DataType::Int64,
        };
        Field::new(key, data_type, true)
    };
    let metadata = HashMap::from([(
        "huggingface".to_owned(),
        huggingface_features(info, with_images).to_string(),
    )]);
    Arc::new(Schema::new(columns(info, with_images).map(field).collect::<Fields>()).with_metadata(metadata))
}

/// The rows of one episode, with images if the schema has them.
pub(crate) fn batch(
    info: &DatasetInfo,
    schema: &SchemaRef,
    start: ShardStart,
    episode: &EncodedEpisode,
) -> Result<RecordBatch, ParquetError> {
    let frames = episode.record.frames;
    let mut columns = Vec::new();
    if schema.index_of(IMAGE).is_ok() {
        columns.push(image_column(&episode.images)?);
    }
    if let Some(masks) = &episode.masks {
        columns.push(image_column(masks)?);
    }
    for (values, size) in [
        (&episode.states, info.state_channels.len()),
        (&episode.actions, info.action_channels.len()),
        (&episode.timestamps_s, 1),
    ] {
        if size > 0 {
            columns.push(vector_column(values, size)?);
        }
    }
    // As `COUNTERS`: how each begins, and by how much it grows from frame to frame.
    for (first, step) in [(0, 1), (start.episode, 0), (start.frame, 1), (0, 0)] {
        let values = (0..frames).map(|frame| (first + step * frame) as i64);
        columns.push(Arc::new(Int64Array::from_iter_values(values)));
    }
    Ok(RecordBatch::try_new(schema.clone(), columns)?)
}

fn image_column(images: &[Vec<u8>]) -> Result<ArrayRef, ArrowError> {
    let bytes: ArrayRef = Arc::new(BinaryArray::from_iter_values(images));
    let paths: ArrayRef = Arc::new(StringArray::new_null(images.len()));
    let images = StructArray::try_new(image_fields(), vec![bytes, paths], None)?;
    Ok(Arc::new(images))
}

fn vector_column(values: &[f32], size: usize) -> Result<ArrayRef, ArrowError> {
    let numbers: ArrayRef = Arc::new(Float32Array::from(values.to_vec()));
    if size == 1 {
        return Ok(numbers);
    }
    let vectors = FixedSizeListArray::try_new(item_field(), size as i32, numbers, None)?;
    Ok(Arc::new(vectors))
}
