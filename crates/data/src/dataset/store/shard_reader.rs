//! Reads a shard: the episode records from its footer, or its frames into memory.

use std::fs::File;
use std::path::{Path, PathBuf};

use arrow_array::cast::AsArray;
use arrow_array::types::{ArrowPrimitiveType, Float32Type, Int64Type};
use arrow_array::{Array, BinaryArray, RecordBatch, StructArray};
use parquet::arrow::ProjectionMask;

use super::layout::{ACTION, IMAGE, INDEX, MASK, STATE, TIMESTAMP};
use super::parquet_file;
use super::parquet_file::Batches;
use super::shard::{EpisodeRecord, RECORDS_KEY};
use crate::dataset::check::Numbers;
use crate::dataset::frame_store::frame_file::{FrameFileWriter, FrameImage};
use crate::dataset::{DatasetError, DatasetInfo, Episode};
use foreframe_core::frame::codec;

/// Rows that are read at a time, with their images.
const IMAGE_ROWS: usize = 64;

/// The records of a shard's episodes, from its footer. Errors: `Io`, `Corrupt`.
pub(crate) fn records(path: &Path) -> Result<Vec<EpisodeRecord>, DatasetError> {
    let file = File::open(path).map_err(DatasetError::io("read", path))?;
    let builder = parquet_file::open(file).map_err(|error| DatasetError::corrupt(path, &error))?;
    let pairs = builder.metadata().file_metadata().key_value_metadata();
    let text = pairs
        .and_then(|pairs| pairs.iter().find(|pair| pair.key == RECORDS_KEY))
        .and_then(|pair| pair.value.as_deref())
        .ok_or_else(|| DatasetError::corrupt(path, &format!("its footer has no \"{RECORDS_KEY}\"")))?;
    serde_json::from_str(text).map_err(|error| DatasetError::corrupt(path, &error))
}

/// Reads all batches of a Parquet file. Errors: `Io`, `Corrupt`.
pub(crate) fn batches(path: &Path) -> Result<Vec<RecordBatch>, DatasetError> {
    let file = File::open(path).map_err(DatasetError::io("read", path))?;
    let reader = parquet_file::open(file)
        .and_then(parquet_file::batches)
        .map_err(|error| DatasetError::corrupt(path, &error))?;
    reader
        .collect::<Result<_, _>>()
        .map_err(|error| DatasetError::corrupt(path, &error))
}

/// Where the decoded frames of a shard go.
pub(crate) enum FrameTarget<'a> {
    /// The memory of the shard's frames.
    Memory {
        pixels: &'a mut [u8],
        masks: Option<&'a mut [u8]>,
    },
    /// The file of all frames.
    File(&'a FrameFileWriter<'a>),
    /// The images are not read.
    Nothing,
}

/// A shard to read, the expected number of frames, and where the frames go.
pub(crate) struct ShardSlot<'a> {
    pub(crate) path: PathBuf,
    pub(crate) frames: usize,
    /// Its first frame, counted over the whole data set.
    pub(crate) first_frame: usize,
    pub(crate) target: FrameTarget<'a>,
}

/// Actions, states and timestamps of frames.
#[derive(Default)]
pub(crate) struct ShardNumbers {
    pub(crate) actions: Vec<f32>,
    pub(crate) states: Vec<f32>,
    pub(crate) timestamps_s: Vec<f64>,
}

impl ShardNumbers {
    /// The numbers of a whole data set from those of its shards.
    pub(crate) fn joined(info: &DatasetInfo, parts: Vec<Self>) -> Self {
        let mut all = Self {
            actions: Vec::with_capacity(info.frame_count * info.action_channels.len()),
            states: Vec::with_capacity(info.frame_count * info.state_channels.len()),
            timestamps_s: Vec::with_capacity(info.frame_count),
        };
        for part in parts {
            all.actions.extend(part.actions);
            all.states.extend(part.states);
            all.timestamps_s.extend(part.timestamps_s);
        }
        all
    }

    /// The numbers of an episode from those of its data set.
    pub(crate) fn of_episode(&self, info: &DatasetInfo, episode: &Episode) -> Numbers<'_> {
        let frames = episode.frames();
        let (actions, states) = (info.action_channels.len(), info.state_channels.len());
        Numbers {
            actions: &self.actions[frames.start * actions..frames.end * actions],
            states: &self.states[frames.start * states..frames.end * states],
            timestamps_s: &self.timestamps_s[frames],
        }
    }
}

/// Reads a shard, a few rows at a time, and decodes its frames into the slot's target.
/// Errors: `Io`, `Corrupt`, `CorruptFrame`, `FrameFile`.
pub(crate) fn read(info: &DatasetInfo, slot: &mut ShardSlot<'_>) -> Result<ShardNumbers, DatasetError> {
    let mut numbers = ShardNumbers::default();
    let mut row = 0;
    let with_images = !matches!(slot.target, FrameTarget::Nothing);
    for batch in reader(&slot.path, with_images)? {
        let batch = batch.map_err(|error| DatasetError::corrupt(&slot.path, &error))?;
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

fn reader(path: &Path, with_images: bool) -> Result<Batches, DatasetError> {
    let file = File::open(path).map_err(DatasetError::io("read", path))?;
    let built = parquet_file::open(file).and_then(|builder| {
        if with_images {
            return parquet_file::batches(builder.with_batch_size(IMAGE_ROWS));
        }
        let columns = builder.schema().fields().iter().enumerate();
        let numbers = columns.filter(|(_, column)| ![IMAGE, MASK].contains(&column.name().as_str()));
        let numbers = numbers.map(|(index, _)| index).collect::<Vec<usize>>();
        let columns = ProjectionMask::roots(builder.parquet_schema(), numbers);
        parquet_file::batches(builder.with_projection(columns))
    });
    built.map_err(|error| DatasetError::corrupt(path, &error))
}

fn wrong_rows(slot: &ShardSlot<'_>, found: usize) -> DatasetError {
    DatasetError::corrupt(
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
    let images = ImageBatch {
        info,
        path: &slot.path,
        batch,
        row,
    };
    let size = info.frame_pixels();
    match &mut slot.target {
        FrameTarget::Memory { pixels, masks } => {
            let copy =
                |to: &mut [u8], row: usize, frame: &[u8]| to[row * size..(row + 1) * size].copy_from_slice(frame);
            images.decode(IMAGE, |row, frame| {
                copy(pixels, row, frame);
                Ok(())
            })?;
            if let Some(masks) = masks {
                images.decode(MASK, |row, mask| {
                    copy(masks, row, mask);
                    Ok(())
                })?;
            }
        }
        FrameTarget::File(file) => {
            let first = slot.first_frame;
            images.decode(IMAGE, |row, frame| file.write(FrameImage::Pixels, first + row, frame))?;
            if info.has_masks {
                images.decode(MASK, |row, mask| file.write(FrameImage::Mask, first + row, mask))?;
            }
        }
        FrameTarget::Nothing => {}
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
    let indexes = column.numbers::<Int64Type>(INDEX)?;
    if indexes.iter().zip(first..).any(|(&found, expected)| found != expected) {
        return Err(DatasetError::corrupt(
            &slot.path,
            &"its column \"index\" does not number the frames one after another",
        ));
    }
    Ok(())
}

/// The images of a batch.
struct ImageBatch<'a> {
    info: &'a DatasetInfo,
    path: &'a Path,
    batch: &'a RecordBatch,
    /// The batch's first row in the shard.
    row: usize,
}

impl ImageBatch<'_> {
    /// Decodes a column, and gives each image's row in the shard and its pixels to `take`.
    fn decode(
        &self,
        key: &'static str,
        mut take: impl FnMut(usize, &[u8]) -> Result<(), DatasetError>,
    ) -> Result<(), DatasetError> {
        let images = image_bytes(self.batch, key)
            .ok_or_else(|| DatasetError::corrupt(self.path, &format!("it has no column \"{key}\" of images")))?;
        let (width, height) = (self.info.frame_width_px, self.info.frame_height_px);
        for index in 0..images.len() {
            let row = self.row + index;
            let frame = codec::decode(images.value(index)).map_err(|source| DatasetError::CorruptFrame {
                path: self.path.to_owned(),
                row,
                column: key,
                source,
            })?;
            if (frame.width(), frame.height()) != (width, height) {
                let reason = format!(
                    "{key} in row {row} is {}×{} px; the data set has frames of {width}×{height} px",
                    frame.width(),
                    frame.height()
                );
                return Err(DatasetError::corrupt(self.path, &reason));
            }
            take(row, frame.pixels())?;
        }
        Ok(())
    }
}

pub(crate) fn image_bytes<'a>(batch: &'a RecordBatch, key: &str) -> Option<&'a BinaryArray> {
    let images: &StructArray = batch.column_by_name(key)?.as_struct_opt()?;
    let bytes = images.column_by_name("bytes")?.as_binary_opt::<i32>()?;
    (bytes.null_count() == 0).then_some(bytes)
}

/// The columns of a batch. Errors name the file and the column.
pub(crate) struct Column<'a> {
    pub(crate) batch: &'a RecordBatch,
    pub(crate) path: &'a Path,
}

impl<'a> Column<'a> {
    /// The numbers of a column without null values. Errors: `Corrupt`.
    pub(crate) fn numbers<T: ArrowPrimitiveType>(&self, key: &str) -> Result<&'a [T::Native], DatasetError> {
        self.batch
            .column_by_name(key)
            .and_then(|column| column.as_primitive_opt::<T>())
            .filter(|column| column.null_count() == 0)
            .map(|column| &column.values()[..])
            .ok_or_else(|| DatasetError::corrupt(self.path, &format!("it has no column \"{key}\" of {}", T::DATA_TYPE)))
    }

    /// The vectors of a column, `size` numbers each, one after another; empty if `size` is 0. Errors: `Corrupt`.
    pub(crate) fn vectors(&self, key: &str, size: usize) -> Result<&'a [f32], DatasetError> {
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
            .ok_or_else(|| DatasetError::corrupt(self.path, &format!("it has no column \"{key}\" of vectors")))?;
        if list.value_length() as usize != size {
            let reason = format!(
                "column \"{key}\" has {} components; the metadata states {size}",
                list.value_length()
            );
            return Err(DatasetError::corrupt(self.path, &reason));
        }
        let values = list.values().as_primitive_opt::<Float32Type>();
        // A slice of a list array still refers to all values. Select those of its rows.
        let first = list.value_offset_at(0);
        let rows = first..first + list.len() * size;
        values
            .filter(|values| values.null_count() == 0)
            .and_then(|values| values.values().get(rows))
            .ok_or_else(|| {
                DatasetError::corrupt(
                    self.path,
                    &format!("column \"{key}\" does not contain 32-bit floating-point numbers"),
                )
            })
    }

    /// The texts of a column; null values become none. Errors: `Corrupt`.
    pub(crate) fn texts(&self, key: &str) -> Result<Vec<Option<&'a str>>, DatasetError> {
        self.batch
            .column_by_name(key)
            .and_then(|column| column.as_string_opt::<i32>())
            .map(|column| column.iter().collect())
            .ok_or_else(|| DatasetError::corrupt(self.path, &format!("it has no column \"{key}\" of text")))
    }
}
