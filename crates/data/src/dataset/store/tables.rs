//! The small tables of a data set: tasks, episodes and statistics of every column; writes them, and reads the episodes.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;

use arrow_array::builder::{Float64Builder, ListBuilder, StringBuilder};
use arrow_array::types::Int64Type;
use arrow_array::{ArrayRef, Float64Array, Int64Array, RecordBatch, StringArray};
use arrow_schema::{DataType, Field, Schema};
use parquet::arrow::ArrowWriter;
use parquet::basic::Compression;
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use serde_json::{Value, json};

use super::layout::{COUNTERS, IMAGE, MASK, shard_location};
use super::shard::EpisodeRecord;
use super::shard_reader::{Column, batches};
use super::stats::ChannelStats;
use crate::dataset::{DatasetError, DatasetInfo, Episode};
use foreframe_sim::TrialParameters;

/// One row of the table of episodes: the record, the shard and the first frame.
pub(crate) struct EpisodeRow<'a> {
    pub(crate) record: &'a EpisodeRecord,
    pub(crate) shard: usize,
    pub(crate) first_frame: usize,
}

impl EpisodeRow<'_> {
    /// Statistics of every column. Those of the counters follow from the position.
    fn stats(&self, episode: usize) -> BTreeMap<String, ChannelStats> {
        let mut stats = self.record.stats.clone();
        let starts = [(0, 1), (episode, 0), (self.first_frame, 1), (0, 0)];
        for (key, (first, step)) in COUNTERS.iter().zip(starts) {
            let values: Vec<f64> = (0..self.record.frames).map(|i| (first + step * i) as f64).collect();
            stats.insert((*key).to_owned(), ChannelStats::of_rows(&values, 1));
        }
        stats
    }
}

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
    let columns: Vec<(String, ArrayRef)> = vec![
        ("task_index".to_owned(), Arc::new(Int64Array::from(vec![0]))),
        ("task".to_owned(), Arc::new(StringArray::from(vec![task]))),
    ];
    write(columns, &[("pandas", pandas.to_string())])
}

/// The table of episodes: position, trial parameters and statistics of every column.
pub(crate) fn episodes(rows: &[EpisodeRow<'_>], task: &str) -> Result<Vec<u8>, ParquetError> {
    write(episode_columns(rows, task), &[])
}

/// The same of a data set whose frames are videos, one for each shard.
pub(crate) fn episodes_with_videos(
    rows: &[EpisodeRow<'_>],
    task: &str,
    frame_period_s: f64,
) -> Result<Vec<u8>, ParquetError> {
    let mut columns = episode_columns(rows, task);
    let first_frame = |shard: usize| {
        rows.iter()
            .find(|row| row.shard == shard)
            .map_or(0, |row| row.first_frame)
    };
    let times = |frame: &dyn Fn(&EpisodeRow<'_>) -> usize| -> ArrayRef {
        let seconds = rows
            .iter()
            .map(|row| (frame(row) - first_frame(row.shard)) as f64 * frame_period_s);
        Arc::new(Float64Array::from_iter_values(seconds))
    };
    let places = |place: &dyn Fn((usize, usize)) -> usize| -> ArrayRef {
        let values = rows.iter().map(|row| place(shard_location(row.shard)) as i64);
        Arc::new(Int64Array::from_iter_values(values))
    };
    columns.extend([
        (format!("videos/{IMAGE}/chunk_index"), places(&|(chunk, _)| chunk)),
        (format!("videos/{IMAGE}/file_index"), places(&|(_, file)| file)),
        (format!("videos/{IMAGE}/from_timestamp"), times(&|row| row.first_frame)),
        (
            format!("videos/{IMAGE}/to_timestamp"),
            times(&|row| row.first_frame + row.record.frames),
        ),
    ]);
    write(columns, &[])
}

fn episode_columns(rows: &[EpisodeRow<'_>], task: &str) -> Vec<(String, ArrayRef)> {
    let counts = |value: &dyn Fn(usize, &EpisodeRow<'_>) -> usize| -> ArrayRef {
        let values = rows.iter().enumerate().map(|(index, row)| value(index, row) as i64);
        Arc::new(Int64Array::from_iter_values(values))
    };
    let mut tasks = ListBuilder::new(StringBuilder::new());
    for _ in rows {
        tasks.values().append_value(task);
        tasks.append(true);
    }
    let trials: StringArray = rows.iter().map(|row| row.record.trial.as_deref()).collect();
    let mut columns: Vec<(String, ArrayRef)> = vec![
        ("episode_index".to_owned(), counts(&|index, _| index)),
        ("tasks".to_owned(), Arc::new(tasks.finish())),
        ("length".to_owned(), counts(&|_, row| row.record.frames)),
        ("trial".to_owned(), Arc::new(trials)),
        (
            "data/chunk_index".to_owned(),
            counts(&|_, row| shard_location(row.shard).0),
        ),
        (
            "data/file_index".to_owned(),
            counts(&|_, row| shard_location(row.shard).1),
        ),
        ("dataset_from_index".to_owned(), counts(&|_, row| row.first_frame)),
        (
            "dataset_to_index".to_owned(),
            counts(&|_, row| row.first_frame + row.record.frames),
        ),
        ("meta/episodes/chunk_index".to_owned(), counts(&|_, _| 0)),
        ("meta/episodes/file_index".to_owned(), counts(&|_, _| 0)),
    ];
    columns.extend(stats_columns(rows));
    columns
}

fn stats_columns(rows: &[EpisodeRow<'_>]) -> Vec<(String, ArrayRef)> {
    let all: Vec<_> = rows.iter().enumerate().map(|(index, row)| row.stats(index)).collect();
    let Some(first) = all.first() else {
        return Vec::new();
    };
    let mut columns = Vec::new();
    for key in first.keys() {
        let stats = || all.iter().filter_map(|stats| stats.get(key));
        for (statistic, values) in STATISTICS {
            let lists: Vec<&[f64]> = stats().map(|stats| values(stats).as_slice()).collect();
            let array = if is_image(key) {
                image_lists(&lists)
            } else {
                lists_of(&lists)
            };
            columns.push((format!("stats/{key}/{statistic}"), array));
        }
        let mut counts = ListBuilder::new(Int64Array::builder(rows.len()));
        for stats in stats() {
            counts.values().append_value(stats.count as i64);
            counts.append(true);
        }
        columns.push((format!("stats/{key}/count"), Arc::new(counts.finish())));
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

fn lists_of(lists: &[&[f64]]) -> ArrayRef {
    let mut builder = ListBuilder::new(Float64Builder::new());
    for list in lists {
        builder.values().append_slice(list);
        builder.append(true);
    }
    Arc::new(builder.finish())
}

/// Statistics of an image in LeRobot's shape: channels × 1 × 1.
fn image_lists(lists: &[&[f64]]) -> ArrayRef {
    let mut builder = ListBuilder::new(ListBuilder::new(ListBuilder::new(Float64Builder::new())));
    for list in lists {
        for &value in *list {
            builder.values().values().values().append_value(value);
            builder.values().values().append(true);
            builder.values().append(true);
        }
        builder.append(true);
    }
    Arc::new(builder.finish())
}

/// LeRobot's `stats.json`: the statistics of every column over all episodes.
pub(crate) fn stats_json(rows: &[EpisodeRow<'_>]) -> Value {
    let all: Vec<_> = rows.iter().enumerate().map(|(index, row)| row.stats(index)).collect();
    let mut features = serde_json::Map::new();
    for key in all.first().map(BTreeMap::keys).into_iter().flatten() {
        let parts: Vec<_> = all.iter().filter_map(|stats| stats.get(key)).collect();
        let merged = ChannelStats::merged(&parts);
        let mut statistics = serde_json::Map::new();
        for (statistic, values) in STATISTICS {
            let values = values(&merged);
            let value = if is_image(key) {
                values.iter().map(|value| json!([[value]])).collect()
            } else {
                json!(values)
            };
            statistics.insert(statistic.to_owned(), value);
        }
        statistics.insert("count".to_owned(), json!([merged.count]));
        features.insert(key.clone(), Value::Object(statistics));
    }
    Value::Object(features)
}

fn write(columns: Vec<(String, ArrayRef)>, metadata: &[(&str, String)]) -> Result<Vec<u8>, ParquetError> {
    let nullable = |kind: &DataType, name: &String| Field::new(name, kind.clone(), true);
    let fields: Vec<_> = columns
        .iter()
        .map(|(name, array)| nullable(array.data_type(), name))
        .collect();
    let metadata: HashMap<_, _> = metadata
        .iter()
        .map(|(key, value)| ((*key).to_owned(), value.clone()))
        .collect();
    let schema = Arc::new(Schema::new(fields).with_metadata(metadata));
    let arrays = columns.into_iter().map(|(_, array)| array).collect();
    let batch = RecordBatch::try_new(schema.clone(), arrays)?;
    let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
    let mut writer = ArrowWriter::try_new(Vec::new(), schema, Some(properties))?;
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
