//! Reads a shard: the episode records from its footer, or its frames into memory.

use std::fmt::Display;
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};

use arrow_array::cast::AsArray;
use arrow_array::types::{ArrowPrimitiveType, Float32Type, Int64Type};
use arrow_array::{Array, ArrayRef, RecordBatch, StringArray};
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

use super::files::verify;
use super::layout::{ACTION, DatasetMetadata, IMAGE, INDEX, MASK, STATE, TIMESTAMP};
use super::parquet_file::{self, Batches};
use super::shard::{EpisodeRecord, RECORDS_KEY};
use crate::dataset::frame_store::FrameContent;
use crate::dataset::frame_store::frame_file::FrameFileWriter;
use crate::dataset::{DatasetError, DatasetInfo};
use foreframe_core::frame::{Frame, codec};

/// Rows that are read at a time, with their images.
const IMAGE_ROWS: usize = 64;

/// The records of a shard's episodes, from its footer. Errors: `Io`, `Corrupt`.
pub(crate) fn records(path: &Path) -> Result<Vec<EpisodeRecord>, DatasetError> {
    let builder = open(path)?;
    let pairs = builder.metadata().file_metadata().key_value_metadata();
    let text = pairs
        .and_then(|pairs| pairs.iter().find(|pair| pair.key == RECORDS_KEY))
        .and_then(|pair| pair.value.as_deref())
        .ok_or_else(|| DatasetError::corrupt(path, &format!("its footer has no \"{RECORDS_KEY}\"")))?;
    serde_json::from_str(text).map_err(|error| DatasetError::corrupt(path, &error))
}

/// Reads all batches of a Parquet file. Errors: `Io`, `Corrupt`.
pub(crate) fn batches(path: &Path) -> Result<Vec<RecordBatch>, DatasetError> {
    let reader = parquet_file::batches(open(path)?).map_err(|error| DatasetError::corrupt(path, &error))?;
    let batches: Result<Vec<_>, _> = reader.collect();
    batches.map_err(|error| DatasetError::corrupt(path, &error))
}

fn open(path: &Path) -> Result<ParquetRecordBatchReaderBuilder<File>, DatasetError> {
    let file = File::open(path).map_err(DatasetError::io("read", path))?;
    parquet_file::open(file).map_err(|error| DatasetError::corrupt(path, &error))
}

/// Where the decoded images of shards go.
#[derive(Clone, Copy)]
pub(crate) enum ImageTarget<'a> {
    Memory,
    /// The file of all images.
    File(&'a FrameFileWriter<'a>),
    /// The images are not read.
    Nothing,
}

/// A shard of a data set.
pub(crate) struct Shard {
    pub(crate) path: PathBuf,
    pub(crate) sha256: String,
    /// Its episodes, counted over the whole data set.
    pub(crate) episodes: Range<usize>,
    /// Its frames, counted over the whole data set.
    pub(crate) frames: Range<usize>,
}

impl Shard {
    /// The shards of the data set in a directory.
    pub(crate) fn all(directory: &Path, metadata: &DatasetMetadata) -> Vec<Self> {
        let (mut episode, mut frame) = (0, 0);
        let entries = metadata.shards.iter().map(|entry| {
            (episode, frame) = (episode + entry.episodes, frame + entry.frames);
            Self {
                path: directory.join(&entry.path),
                sha256: entry.sha256.clone(),
                episodes: episode - entry.episodes..episode,
                frames: frame - entry.frames..frame,
            }
        });
        entries.collect()
    }

    /// Verifies the shard and reads it, a few rows at a time; decoded images go to the target.
    /// Errors: `Io`, `HashDiffers`, `Corrupt`, `CorruptFrame`, `FrameFile`.
    pub(crate) fn read(&self, info: &DatasetInfo, target: ImageTarget<'_>) -> Result<FrameContent, DatasetError> {
        verify(&self.path, &self.sha256)?;
        let mut content = FrameContent::default();
        let wrong_rows = |found: usize| {
            let stated = self.frames.len();
            let reason = format!("it has {found} or more rows; its metadata states {stated}");
            Err(DatasetError::corrupt(&self.path, &reason))
        };
        for batch in self.batches(target)? {
            let batch = batch.map_err(|error| DatasetError::corrupt(&self.path, &error))?;
            let row = content.timestamps_s.len();
            if row + batch.num_rows() > self.frames.len() {
                return wrong_rows(row + batch.num_rows());
            }
            let column = Column {
                batch: &batch,
                path: &self.path,
            };
            if !matches!(target, ImageTarget::Nothing) {
                self.read_images(info, &column, target, &mut content)?;
            }
            self.read_numbers(info, &column, &mut content)?;
        }
        match content.timestamps_s.len() {
            rows if rows == self.frames.len() => Ok(content),
            rows => wrong_rows(rows),
        }
    }

    fn batches(&self, target: ImageTarget<'_>) -> Result<Batches, DatasetError> {
        let builder = open(&self.path)?;
        let builder = if matches!(target, ImageTarget::Nothing) {
            let columns = builder.schema().fields().iter().enumerate();
            let numbers = columns.filter(|(_, column)| ![IMAGE, MASK].contains(&column.name().as_str()));
            let numbers: Vec<usize> = numbers.map(|(index, _)| index).collect();
            let columns = ProjectionMask::roots(builder.parquet_schema(), numbers);
            builder.with_projection(columns)
        } else {
            builder.with_batch_size(IMAGE_ROWS)
        };
        parquet_file::batches(builder).map_err(|error| DatasetError::corrupt(&self.path, &error))
    }

    /// Decodes the images and masks of a batch that follows the content.
    fn read_images(
        &self,
        info: &DatasetInfo,
        column: &Column<'_>,
        target: ImageTarget<'_>,
        content: &mut FrameContent,
    ) -> Result<(), DatasetError> {
        let first_row = content.timestamps_s.len();
        let pixels = Some((IMAGE, 0, &mut content.pixels));
        let masks = info.has_masks.then_some((MASK, info.frame_count, &mut content.masks));
        for (key, first_image, held) in pixels.into_iter().chain(masks) {
            for (image, row) in column.images(key)?.zip(first_row..) {
                let frame = self.decode(info, key, row, image)?;
                match target {
                    ImageTarget::Memory => held.push(frame.into_pixels().into_boxed_slice()),
                    ImageTarget::File(file) => file.write(first_image + self.frames.start + row, frame.pixels())?,
                    ImageTarget::Nothing => {}
                }
            }
        }
        Ok(())
    }

    fn decode(
        &self,
        info: &DatasetInfo,
        column: &'static str,
        row: usize,
        image: &[u8],
    ) -> Result<Frame, DatasetError> {
        let damaged =
            |source| DatasetError::CorruptFrame(format!("{}, row {row}: {column}", self.path.display()), source);
        let frame = codec::decode(image).map_err(damaged)?;
        let (width, height) = (info.frame_width_px, info.frame_height_px);
        if (frame.width(), frame.height()) == (width, height) {
            return Ok(frame);
        }
        let reason = format!(
            "{column} in row {row} is {}×{} px; the data set has frames of {width}×{height} px",
            frame.width(),
            frame.height()
        );
        Err(DatasetError::corrupt(&self.path, &reason))
    }

    fn read_numbers(
        &self,
        info: &DatasetInfo,
        column: &Column<'_>,
        content: &mut FrameContent,
    ) -> Result<(), DatasetError> {
        let first = (self.frames.start + content.timestamps_s.len()) as i64;
        let (states, actions) = (info.state_channels.len(), info.action_channels.len());
        content.states.extend(column.vectors(STATE, states)?);
        content.actions.extend(column.vectors(ACTION, actions)?);
        let times = column.numbers::<Float32Type>(TIMESTAMP)?;
        content.timestamps_s.extend(times.iter().map(|&time| f64::from(time)));
        let indexes = column.numbers::<Int64Type>(INDEX)?;
        if indexes.iter().zip(first..).all(|(&found, expected)| found == expected) {
            return Ok(());
        }
        let reason = "its column \"index\" does not number the frames one after another";
        Err(DatasetError::corrupt(&self.path, &reason))
    }
}

/// The columns of a batch. Errors name the file and the column.
pub(crate) struct Column<'a> {
    pub(crate) batch: &'a RecordBatch,
    pub(crate) path: &'a Path,
}

impl<'a> Column<'a> {
    /// What `cast` finds in a column; `what` names it for the error. Errors: `Corrupt`.
    fn cast<T>(
        &self,
        key: &str,
        what: impl Display,
        cast: impl FnOnce(&'a ArrayRef) -> Option<T>,
    ) -> Result<T, DatasetError> {
        let found = self.batch.column_by_name(key).and_then(cast);
        found.ok_or_else(|| DatasetError::corrupt(self.path, &format!("it has no column \"{key}\" of {what}")))
    }

    /// The encoded images of a column without null values. Errors: `Corrupt`.
    pub(crate) fn images(&self, key: &str) -> Result<impl Iterator<Item = &'a [u8]> + use<'a>, DatasetError> {
        let images = self.cast(key, "images", |column| {
            let bytes = column
                .as_struct_opt()?
                .column_by_name("bytes")?
                .as_binary_opt::<i32>()?;
            (bytes.null_count() == 0).then_some(bytes)
        })?;
        Ok(images.iter().flatten())
    }

    /// The numbers of a column without null values. Errors: `Corrupt`.
    pub(crate) fn numbers<T: ArrowPrimitiveType>(&self, key: &str) -> Result<&'a [T::Native], DatasetError> {
        self.cast(key, T::DATA_TYPE, |column| {
            let numbers = column.as_primitive_opt::<T>()?;
            (numbers.null_count() == 0).then_some(&numbers.values()[..])
        })
    }

    /// The vectors of a column, `size` numbers each, one after another; empty if `size` is 0. Errors: `Corrupt`.
    pub(crate) fn vectors(&self, key: &str, size: usize) -> Result<&'a [f32], DatasetError> {
        match size {
            0 => return Ok(&[]),
            1 => return self.numbers::<Float32Type>(key),
            _ => {}
        }
        let list = self.cast(key, "vectors", |column| {
            let list = column.as_fixed_size_list_opt()?;
            (list.null_count() == 0).then_some(list)
        })?;
        let found = list.value_length();
        if found as usize != size {
            let reason = format!("column \"{key}\" has {found} components; the metadata states {size}");
            return Err(DatasetError::corrupt(self.path, &reason));
        }
        // A slice of a list array still refers to all values. Select those of its rows.
        let first = list.value_offset_at(0);
        let rows = first..first + list.len() * size;
        let values = list.values().as_primitive_opt::<Float32Type>();
        let values = values.filter(|values| values.null_count() == 0);
        values.and_then(|values| values.values().get(rows)).ok_or_else(|| {
            let reason = format!("column \"{key}\" does not contain 32-bit floating-point numbers");
            DatasetError::corrupt(self.path, &reason)
        })
    }

    /// The texts of a column; null values become none. Errors: `Corrupt`.
    pub(crate) fn texts(&self, key: &str) -> Result<&'a StringArray, DatasetError> {
        self.cast(key, "text", |column| column.as_string_opt::<i32>())
    }
}
