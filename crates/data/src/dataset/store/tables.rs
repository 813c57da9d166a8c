//! The small tables of a data set: tasks, episodes and statistics of every column; writes them, and reads the episodes.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;

use arrow_array::types::Int64Type;
use arrow_array::{Array, ArrayRef, Float64Array, Int64Array, ListArray, RecordBatch, StringArray};
use arrow_buffer::OffsetBuffer;
use arrow_schema::{Field, Schema};
use parquet::arrow::ArrowWriter;
use parquet::basic::Compression;
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use serde_json::{Value, json};

use super::layout::{COUNTERS, IMAGE, MASK, shard_location};
use super::shard::{EpisodeRecord, ShardStart};
use super::shard_reader::{Column, batches};
use super::stats::ChannelStats;
use crate::dataset::{DatasetError, DatasetInfo, Episode};
use foreframe_sim::TrialParameters;

/// One row of the table of episodes.
pub(crate) struct EpisodeRow<'a> {
    record: &'a EpisodeRecord,
    shard: usize,
    /// The episodes and frames before it.
    start: ShardStart,
}

impl<'a> EpisodeRow<'a> {
    /// The rows of all episodes in their order, each with the number of its shard.
    pub(crate) fn all(episodes: impl Iterator<Item = (usize, &'a EpisodeRecord)>) -> Vec<Self> {
        let mut next = ShardStart::default();
        let rows = episodes.map(|(shard, record)| {
            let start = next;
            next = next.after(record);
            Self { record, shard, start }
        });
        rows.collect()
    }

    /// The number of the frame after the episode.
    fn end(&self) -> usize {
        self.start.frame + self.record.frames
    }

    /// Statistics of every column. Those of the counters follow from the position.
    fn stats(&self) -> BTreeMap<String, ChannelStats> {
        let mut stats = self.record.stats.clone();
        let starts = [(0, 1), (self.start.episode, 0), (self.start.frame, 1), (0, 0)];
        for (key, (first, step)) in COUNTERS.iter().zip(starts) {
            let values: Vec<f64> = (0..self.record.frames).map(|i| (first + step * i) as f64).collect();
            stats.insert((*key).to_owned(), ChannelStats::of_rows(&values, 1));
        }
        stats
    }
}

/// A column of a table: its name and its values.
type TableColumn = (String, ArrayRef);

/// A table with one task, in the format of a pandas index named `task`, because LeRobot uses it to find tasks.
pub(crate) fn tasks(task: &str) -> Result<Vec<u8>, ParquetError> {
    let column = |name: &str, kind: &str, numpy: &str| json!({"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": null});
    let pandas = json!({
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "creator": {"library": "foreframe", "version": env!("CARGO_PKG_VERSION")},
        "pandas_version": "2.0.0",
    });
    let columns: Vec<TableColumn> = vec![
        ("task_index".to_owned(), Arc::new(Int64Array::from(vec![0]))),
        ("task".to_owned(), Arc::new(StringArray::from(vec![task]))),
    ];
    write(columns, HashMap::from([("pandas".to_owned(), pandas.to_string())]))
}

/// The table of episodes: position, trial parameters and statistics of every column. With a frame period, their frames are videos,
/// one for each shard.
pub(crate) fn episodes(
    rows: &[EpisodeRow<'_>],
    task: &str,
    video_period_s: Option<f64>,
) -> Result<Vec<u8>, ParquetError> {
    let counts = |name: &str, value: &dyn Fn(&EpisodeRow<'_>) -> usize| -> TableColumn {
        let values = rows.iter().map(|row| value(row) as i64);
        (name.to_owned(), Arc::new(Int64Array::from_iter_values(values)))
    };
    let tasks = Arc::new(StringArray::from(vec![task; rows.len()]));
    let trials: StringArray = rows.iter().map(|row| row.record.trial.as_deref()).collect();
    let chunk = |row: &EpisodeRow<'_>| shard_location(row.shard).0;
    let file = |row: &EpisodeRow<'_>| shard_location(row.shard).1;
    let mut columns = vec![
        counts("episode_index", &|row| row.start.episode),
        ("tasks".to_owned(), singles(tasks)),
        counts("length", &|row| row.record.frames),
        ("trial".to_owned(), Arc::new(trials)),
        counts("data/chunk_index", &chunk),
        counts("data/file_index", &file),
        counts("dataset_from_index", &|row| row.start.frame),
        counts("dataset_to_index", &|row| row.end()),
        counts("meta/episodes/chunk_index", &|_| 0),
        counts("meta/episodes/file_index", &|_| 0),
    ];
    columns.extend(stats_columns(rows));
    if let Some(period_s) = video_period_s {
        let times = |name: &str, frame: &dyn Fn(&EpisodeRow<'_>) -> usize| -> TableColumn {
            let shards = rows.chunk_by(|a, b| a.shard == b.shard);
            let frames = shards.flat_map(|shard| shard.iter().map(|row| frame(row) - shard[0].start.frame));
            let seconds = frames.map(|frame| frame as f64 * period_s);
            let seconds = Arc::new(Float64Array::from_iter_values(seconds));
            (format!("videos/{IMAGE}/{name}"), seconds)
        };
        columns.extend([
            counts(&format!("videos/{IMAGE}/chunk_index"), &chunk),
            counts(&format!("videos/{IMAGE}/file_index"), &file),
            times("from_timestamp", &|row| row.start.frame),
            times("to_timestamp", &|row| row.end()),
        ]);
    }
    write(columns, HashMap::new())
}

fn stats_columns(rows: &[EpisodeRow<'_>]) -> Vec<TableColumn> {
    let all: Vec<_> = rows.iter().map(EpisodeRow::stats).collect();
    let mut columns = Vec::new();
    for key in all.first().map(BTreeMap::keys).into_iter().flatten() {
        let stats = || all.iter().filter_map(|stats| stats.get(key));
        for (statistic, values) in STATISTICS {
            let lengths = stats().map(|stats| values(stats).len());
            let numbers = stats().flat_map(|stats| values(stats).iter().copied());
            let numbers: ArrayRef = Arc::new(Float64Array::from_iter_values(numbers));
            // Those of an image have LeRobot's shape: channels × 1 × 1.
            let numbers = if is_image(key) {
                singles(singles(numbers))
            } else {
                numbers
            };
            columns.push((format!("stats/{key}/{statistic}"), lists(numbers, lengths)));
        }
        let counts = Int64Array::from_iter_values(stats().map(|stats| stats.count as i64));
        columns.push((format!("stats/{key}/count"), singles(Arc::new(counts))));
    }
    columns
}

/// Name of a statistic, and how to read it.
type StatColumn = (&'static str, fn(&ChannelStats) -> &Vec<f64>);

const STATISTICS: [StatColumn; 4] = [
    ("min", |stats| &stats.min),
    ("max", |stats| &stats.max),
    ("mean", |stats| &stats.mean),
    ("std", |stats| &stats.std),
];

fn is_image(key: &str) -> bool {
    key == IMAGE || key == MASK
}

/// Lists of these lengths.
fn lists(values: ArrayRef, lengths: impl Iterator<Item = usize>) -> ArrayRef {
    let item = Arc::new(Field::new_list_field(values.data_type().clone(), true));
    Arc::new(ListArray::new(item, OffsetBuffer::from_lengths(lengths), values, None))
}

/// Lists of one value each.
fn singles(values: ArrayRef) -> ArrayRef {
    let count = values.len();
    lists(values, std::iter::repeat_n(1, count))
}

/// LeRobot's `stats.json`: the statistics of every column over all episodes.
pub(crate) fn stats_json(rows: &[EpisodeRow<'_>]) -> Value {
    let all: Vec<_> = rows.iter().map(EpisodeRow::stats).collect();
    let mut features = serde_json::Map::new();
    for key in all.first().map(BTreeMap::keys).into_iter().flatten() {
        let parts: Vec<_> = all.iter().filter_map(|stats| stats.get(key)).collect();
        let merged = ChannelStats::merged(&parts);
        let mut statistics = json!({"count": [merged.count]});
        for (statistic, values) in STATISTICS {
            let values = values(&merged);
            statistics[statistic] = if is_image(key) {
                values.iter().map(|value| json!([[value]])).collect()
            } else {
                json!(values)
            };
        }
        features.insert(key.clone(), statistics);
    }
    Value::Object(features)
}

fn write(columns: Vec<TableColumn>, metadata: HashMap<String, String>) -> Result<Vec<u8>, ParquetError> {
    let columns = columns.into_iter().map(|(name, values)| (name, values, true));
    let batch = RecordBatch::try_from_iter_with_nullable(columns)?;
    let schema = Schema::clone(&batch.schema()).with_metadata(metadata);
    let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
    let mut writer = ArrowWriter::try_new(Vec::new(), Arc::new(schema), Some(properties))?;
    writer.write(&batch)?;
    writer.into_inner()
}

/// Reads the table of episodes. Errors: `Io`, `Corrupt`.
pub(crate) fn read_episodes(path: &Path, info: &DatasetInfo) -> Result<Vec<Episode>, DatasetError> {
    let corrupt = |reason: String| DatasetError::corrupt(path, &reason);
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
