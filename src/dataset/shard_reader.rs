//! Reads a shard: the episode records from its footer, or its frames into memory.

use std::fs::File;
use std::path::{Path, PathBuf};

use arrow_array::cast::AsArray;
use arrow_array::types::{ArrowPrimitiveType, Float32Type, Int64Type};
use arrow_array::{Array, BinaryArray, RecordBatch, StructArray};
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder};

use super::layout::{ACTION, IMAGE, MASK, STATE, TIMESTAMP};
use super::shard::{EpisodeRecord, RECORDS_KEY};
use super::{DatasetError, DatasetInfo};
use crate::frame::codec;

/// The records of a shard's episodes, from its footer. Errors: `Io`, `Corrupt`.
pub(super) fn records(path: &Path) -> Result<Vec<EpisodeRecord>, DatasetError> {
    let file = File::open(path).map_err(DatasetError::io("read", path))?;
    let metadata =
        ArrowReaderMetadata::load(&file, ArrowReaderOptions::default()).map_err(|error| corrupt(path, &error))?;
    let pairs = metadata.metadata().file_metadata().key_value_metadata();
    let text = pairs
        .and_then(|pairs| pairs.iter().find(|pair| pair.key == RECORDS_KEY))
        .and_then(|pair| pair.value.as_deref())
        .ok_or_else(|| corrupt(path, &format!("its footer has no \"{RECORDS_KEY}\"")))?;
    serde_json::from_str(text).map_err(|error| corrupt(path, &error))
}

/// Reads all batches of a Parquet file. Errors: `Io`, `Corrupt`.
pub(super) fn batches(path: &Path) -> Result<Vec<RecordBatch>, DatasetError> {
    let file = File::open(path).map_err(DatasetError::io("read", path))?;
    let reader = ParquetRecordBatchReaderBuilder::try_new(file)
        .and_then(ParquetRecordBatchReaderBuilder::build)
        .map_err(|error| corrupt(path, &error))?;
    reader.collect::<Result<_, _>>().map_err(|error| corrupt(path, &error))
}

fn corrupt(path: &Path, reason: &impl ToString) -> DatasetError {
    DatasetError::Corrupt {
        path: path.to_owned(),
        reason: reason.to_string().trim().to_owned(),
    }
}

/// The memory into which a shard is read, and the expected number of frames.
pub(super) struct ShardSlot<'a> {
    pub(super) path: PathBuf,
    pub(super) frames: usize,
    /// Its first frame, counted over the whole data set.
    pub(super) first_frame: usize,
    pub(super) pixels: &'a mut [u8],
    pub(super) masks: Option<&'a mut [u8]>,
}

/// Actions, states and timestamps of a shard's frames.
#[derive(Default)]
pub(super) struct ShardNumbers {
    pub(super) actions: Vec<f32>,
    pub(super) states: Vec<f32>,
    pub(super) timestamps_s: Vec<f64>,
}

/// Decodes a shard's frames into the slot's memory. Errors: `Io`, `Corrupt`, `CorruptFrame`.
pub(super) fn read(info: &DatasetInfo, slot: &mut ShardSlot<'_>) -> Result<ShardNumbers, DatasetError> {
    let mut numbers = ShardNumbers::default();
    let mut row = 0;
    for batch in batches(&slot.path)? {
        if row + batch.num_rows() > slot.frames {
            return Err(wrong_rows(slot, row + batch.num_rows()));
        }
        read_batch(info, slot, &batch, row, &mut numbers)?;
        row += batch.num_rows();
    }
    if row != slot.frames {
        return Err(wrong_rows(slot, row));
    }
    Ok(numbers)
}

fn wrong_rows(slot: &ShardSlot<'_>, found: usize) -> DatasetError {
    corrupt(
        &slot.path,
        &format!("it has {found} or more rows; its metadata states {}", slot.frames),
    )
}

fn read_batch(
    info: &DatasetInfo,
    slot: &mut ShardSlot<'_>,
    batch: &RecordBatch,
    row: usize,
    numbers: &mut ShardNumbers,
) -> Result<(), DatasetError> {
    let range = row * info.frame_pixels()..(row + batch.num_rows()) * info.frame_pixels();
    let target = ImageTarget {
        info,
        path: &slot.path,
        row,
    };
    target.decode(batch, IMAGE, &mut slot.pixels[range.clone()])?;
    if let Some(masks) = &mut slot.masks {
        target.decode(batch, MASK, &mut masks[range])?;
    }
    let column = Column {
        batch,
        path: &slot.path,
    };
    numbers.states.extend(column.vectors(STATE, info.state_channels.len())?);
    numbers
        .actions
        .extend(column.vectors(ACTION, info.action_channels.len())?);
    let times = column.numbers::<Float32Type>(TIMESTAMP)?;
    numbers.timestamps_s.extend(times.iter().map(|&time| f64::from(time)));
    let first = (slot.first_frame + row) as i64;
    let indexes = column.numbers::<Int64Type>("index")?;
    if indexes.iter().zip(first..).any(|(&found, expected)| found != expected) {
        return Err(corrupt(
            &slot.path,
            &"its column \"index\" does not number the frames one after another",
        ));
    }
    Ok(())
}

/// Decodes the images of a batch into memory.
struct ImageTarget<'a> {
    info: &'a DatasetInfo,
    path: &'a Path,
    row: usize,
}

impl ImageTarget<'_> {
    fn decode(&self, batch: &RecordBatch, key: &'static str, pixels: &mut [u8]) -> Result<(), DatasetError> {
        let images = image_bytes(batch, key)
            .ok_or_else(|| corrupt(self.path, &format!("it has no column \"{key}\" of images")))?;
        for (row, target) in pixels.chunks_mut(self.info.frame_pixels()).enumerate() {
            let frame = codec::decode(images.value(row)).map_err(|source| DatasetError::CorruptFrame {
                path: self.path.to_owned(),
                row: self.row + row,
                column: key,
                source,
            })?;
            let (width, height) = (self.info.frame_width_px, self.info.frame_height_px);
            if (frame.width(), frame.height()) != (width, height) {
                let reason = format!(
                    "{key} in row {} is {}×{} px; the data set has frames of {width}×{height} px",
                    self.row + row,
                    frame.width(),
                    frame.height()
                );
                return Err(corrupt(self.path, &reason));
            }
            target.copy_from_slice(frame.pixels());
        }
        Ok(())
    }
}

pub(super) fn image_bytes<'a>(batch: &'a RecordBatch, key: &str) -> Option<&'a BinaryArray> {
    let images: &StructArray = batch.column_by_name(key)?.as_struct_opt()?;
    let bytes = images.column_by_name("bytes")?.as_binary_opt::<i32>()?;
    (bytes.null_count() == 0).then_some(bytes)
}

/// The columns of a batch. Errors name the file and the column.
pub(super) struct Column<'a> {
    pub(super) batch: &'a RecordBatch,
    pub(super) path: &'a Path,
}

impl<'a> Column<'a> {
    /// The numbers of a column without null values. Errors: `Corrupt`.
    pub(super) fn numbers<T: ArrowPrimitiveType>(&self, key: &str) -> Result<&'a [T::Native], DatasetError> {
        self.batch
            .column_by_name(key)
            .and_then(|column| column.as_primitive_opt::<T>())
            .filter(|column| column.null_count() == 0)
            .map(|column| &column.values()[..])
            .ok_or_else(|| corrupt(self.path, &format!("it has no column \"{key}\" of {}", T::DATA_TYPE)))
    }

    /// The vectors of a column, `size` numbers each, one after another; empty if `size` is 0. Errors: `Corrupt`.
    pub(super) fn vectors(&self, key: &str, size: usize) -> Result<&'a [f32], DatasetError> {
        match size {
            0 => return Ok(&[]),
            1 => return self.numbers::<Float32Type>(key),
            _ => {}
        }
        let list = self
            .batch
            .column_by_name(key)
            .and_then(|column| column.as_fixed_size_list_opt())
            .filter(|list| list.null_count() == 0)
            .ok_or_else(|| corrupt(self.path, &format!("it has no column \"{key}\" of vectors")))?;
        if list.value_length() as usize != size {
            let reason = format!(
                "column \"{key}\" has {} components; the metadata states {size}",
                list.value_length()
            );
            return Err(corrupt(self.path, &reason));
        }
        let values = list.values().as_primitive_opt::<Float32Type>();
        // A slice of a list array still refers to all values. Select those of its rows.
        let first = list.value_offset_at(0);
        let rows = first..first + list.len() * size;
        values
            .filter(|values| values.null_count() == 0)
            .and_then(|values| values.values().get(rows))
            .ok_or_else(|| {
                corrupt(
                    self.path,
                    &format!("column \"{key}\" does not contain 32-bit floating-point numbers"),
                )
            })
    }

    /// The texts of a column; null values become none. Errors: `Corrupt`.
    pub(super) fn texts(&self, key: &str) -> Result<Vec<Option<&'a str>>, DatasetError> {
        self.batch
            .column_by_name(key)
            .and_then(|column| column.as_string_opt::<i32>())
            .map(|column| column.iter().collect())
            .ok_or_else(|| corrupt(self.path, &format!("it has no column \"{key}\" of text")))
    }
}
