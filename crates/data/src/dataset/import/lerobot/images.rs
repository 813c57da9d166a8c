//! The images of a data set of `LeRobot` in a column of its tables. Few of them are in memory at a time.

use std::collections::VecDeque;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};

use arrow_array::cast::AsArray;
use arrow_array::{Array, RecordBatch};
use parquet::arrow::ProjectionMask;

use crate::dataset::import::error::ImportError;
use crate::dataset::import::files::{inside, open_file};
use crate::dataset::import::image_files::read_image;
use crate::dataset::import::recording::{ImageSource, Record};
use crate::dataset::store::parquet_file;
use foreframe_core::frame::{Frame, codec};

/// Rows that are read together.
const BLOCK_ROWS: usize = 256;
/// Blocks of rows that are kept: parallel readers are at most so far apart.
const KEPT: usize = 3;
/// A block ends after the row at which its images have this number of bytes.
const BLOCK_BYTES: usize = 64 << 20;
/// Rows that the library decodes at a time.
const BATCH_ROWS: usize = 8;

/// Images in a column of tables.
pub(super) struct ImageTable {
    source: PathBuf,
    column: String,
    tables: Vec<PathBuf>,
    /// Table and row of each image.
    places: Vec<(usize, usize)>,
    blocks: Mutex<VecDeque<ImageBlock>>,
}

/// Some consecutive rows of a table.
struct ImageBlock {
    table: usize,
    first: usize,
    batches: Vec<RecordBatch>,
}

impl ImageBlock {
    /// The batch with a row, and the row's number in it.
    fn row(&self, table: usize, row: usize) -> Option<(RecordBatch, usize)> {
        let mut left = row.checked_sub(self.first).filter(|_| self.table == table)?;
        for batch in &self.batches {
            if left < batch.num_rows() {
                return Some((batch.clone(), left));
            }
            left -= batch.num_rows();
        }
        None
    }
}

impl ImageTable {
    pub(super) fn new(source: &Path, column: &str, tables: Vec<PathBuf>, places: Vec<(usize, usize)>) -> Self {
        Self {
            source: source.to_owned(),
            column: column.to_owned(),
            tables,
            places,
            blocks: Mutex::new(VecDeque::new()),
        }
    }

    /// The batch with a row, and the row's number in it; `None` if the table has no such row. Errors: `Io`, `Record`.
    fn stored(&self, table: usize, row: usize) -> Result<Option<(RecordBatch, usize)>, ImportError> {
        let mut blocks = self.blocks.lock().unwrap_or_else(PoisonError::into_inner);
        let find = |blocks: &VecDeque<ImageBlock>| blocks.iter().find_map(|block| block.row(table, row));
        // A block of large images can end before the row.
        for first in [row / BLOCK_ROWS * BLOCK_ROWS, row] {
            if let Some(found) = find(&blocks) {
                return Ok(Some(found));
            }
            if blocks.iter().any(|block| block.table == table && block.first == first) {
                continue;
            }
            let batches = self.load(table, first)?;
            blocks.push_back(ImageBlock { table, first, batches });
            if blocks.len() > KEPT {
                blocks.pop_front();
            }
        }
        Ok(find(&blocks))
    }

    /// The batches of a block of rows, which ends early if they are large. Errors: `Io`, `Record`.
    fn load(&self, table: usize, first: usize) -> Result<Vec<RecordBatch>, ImportError> {
        let path = &self.tables[table];
        let wrong = |reason: &dyn Display| ImportError::record(path.display(), reason.to_string().trim());
        let file = open_file(path)?;
        let builder = parquet_file::open(file).map_err(|error| wrong(&error))?;
        let fields = builder.schema().fields();
        let Some((root, _)) = fields.find(&self.column) else {
            return Err(wrong(&format!("it has no column {:?}", self.column)));
        };
        let mask = ProjectionMask::roots(builder.parquet_schema(), [root]);
        // Only the row groups that hold the block are opened.
        let (mut groups, mut start, mut skipped) = (Vec::new(), 0, 0);
        for (number, group) in builder.metadata().row_groups().iter().enumerate() {
            let end = start + group.num_rows() as usize;
            if end > first && start < first + BLOCK_ROWS {
                groups.push(number);
            } else if end <= first {
                skipped = end;
            }
            start = end;
        }
        let builder = builder
            .with_projection(mask)
            .with_row_groups(groups)
            .with_offset(first - skipped)
            .with_limit(BLOCK_ROWS)
            .with_batch_size(BATCH_ROWS);
        let (mut batches, mut bytes) = (Vec::new(), 0);
        for batch in parquet_file::batches(builder).map_err(|error| wrong(&error))? {
            let batch = batch.map_err(|error| wrong(&error))?;
            bytes += batch.get_array_memory_size();
            batches.push(batch);
            if bytes >= BLOCK_BYTES {
                break;
            }
        }
        Ok(batches)
    }
}

impl ImageSource for ImageTable {
    fn read(&self, wanted: &Record, _cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let Record { image, place, .. } = wanted;
        let (table, row) = self.places[*image];
        let path = &self.tables[table];
        let missing = || ImportError::record(place, format!("{} has no image", self.column));
        let (batch, row) = self.stored(table, row)?.ok_or_else(missing)?;
        let (bytes, name) = stored_image(&batch, row).ok_or_else(|| {
            let reason = format!("its column {:?} does not hold images", self.column);
            ImportError::record(path.display(), reason)
        })?;
        if let Some(bytes) = bytes {
            return codec::decode(bytes).map_err(ImportError::image(place, path));
        }
        let path = inside(&self.source, name.ok_or_else(missing)?, place)?;
        codec::decode(&read_image(&path, place)?).map_err(ImportError::image(place, path))
    }
}

/// The bytes of an image and its file's name, in a batch whose only column is one of images; `None` if it is of another type.
fn stored_image(batch: &RecordBatch, row: usize) -> Option<(Option<&[u8]>, Option<&str>)> {
    let column = batch.columns().first()?.as_struct_opt()?;
    let (bytes, paths) = (column.column_by_name("bytes")?, column.column_by_name("path"));
    let bytes = match bytes.as_binary_opt::<i32>() {
        Some(small) => small.is_valid(row).then(|| small.value(row)),
        None => Some(bytes.as_binary_opt::<i64>()?)
            .filter(|large| large.is_valid(row))
            .map(|large| large.value(row)),
    };
    let paths = paths.and_then(|paths| paths.as_string_opt::<i32>());
    let name = paths.filter(|paths| paths.is_valid(row)).map(|paths| paths.value(row));
    Some((bytes, name))
}
