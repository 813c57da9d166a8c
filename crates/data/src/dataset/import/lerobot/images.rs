//! The images of a data set of `LeRobot` in a column of its tables. Few of them are in memory at a time.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};

use arrow_array::cast::AsArray;
use arrow_array::{Array, RecordBatch};
use parquet::arrow::ProjectionMask;

use crate::dataset::import::error::ImportError;
use crate::dataset::import::files::{inside, open_file};
use crate::dataset::import::image_files::read_image;
use crate::dataset::import::recording::{ImageSource, WantedImage};
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
    images: Vec<StoredImage>,
}

/// An image in a table: its bytes, or a file's name.
#[derive(Clone)]
enum StoredImage {
    Bytes(Vec<u8>),
    File(String),
    Missing,
}

impl StoredImage {
    fn bytes(&self) -> usize {
        match self {
            Self::Bytes(bytes) => bytes.len(),
            Self::File(name) => name.len(),
            Self::Missing => 0,
        }
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

    fn stored(&self, table: usize, row: usize) -> Result<StoredImage, ImportError> {
        let mut blocks = self.blocks.lock().unwrap_or_else(PoisonError::into_inner);
        let find = |blocks: &VecDeque<ImageBlock>| {
            let holds = |block: &&ImageBlock| block.table == table && row >= block.first;
            let mut found = blocks.iter().filter(holds);
            found.find_map(|block| block.images.get(row - block.first).cloned())
        };
        // A block of large images can end before the row.
        for first in [row / BLOCK_ROWS * BLOCK_ROWS, row] {
            if let Some(image) = find(&blocks) {
                return Ok(image);
            }
            if blocks.iter().any(|block| block.table == table && block.first == first) {
                continue;
            }
            let images = self.load(table, first)?;
            blocks.push_back(ImageBlock { table, first, images });
            if blocks.len() > KEPT {
                blocks.pop_front();
            }
        }
        Ok(find(&blocks).unwrap_or(StoredImage::Missing))
    }

    /// The images of a block of rows, which ends early if they are large. Errors: `Io`, `Record`.
    fn load(&self, table: usize, first: usize) -> Result<Vec<StoredImage>, ImportError> {
        let path = &self.tables[table];
        let wrong = |reason: String| ImportError::record(path.display().to_string(), reason.trim());
        let file = open_file(path)?;
        let builder = parquet_file::open(file).map_err(|error| wrong(error.to_string()))?;
        let root = builder
            .schema()
            .fields()
            .iter()
            .position(|field| *field.name() == self.column);
        let root = root.ok_or_else(|| wrong(format!("it has no column {:?}", self.column)))?;
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
        let batches = parquet_file::batches(builder);
        let (mut images, mut bytes) = (Vec::with_capacity(BLOCK_ROWS), 0);
        for batch in batches.map_err(|error| wrong(error.to_string()))? {
            let batch = batch.map_err(|error| wrong(error.to_string()))?;
            let stored = stored_images(&batch)
                .ok_or_else(|| wrong(format!("its column {:?} does not hold images", self.column)))?;
            bytes += stored.iter().map(StoredImage::bytes).sum::<usize>();
            images.extend(stored);
            if bytes >= BLOCK_BYTES {
                break;
            }
        }
        Ok(images)
    }
}

impl ImageSource for ImageTable {
    fn read(&self, wanted: &WantedImage<'_>, _cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let WantedImage { image, place } = *wanted;
        let (table, row) = self.places[image];
        let path = &self.tables[table];
        let (bytes, path) = match self.stored(table, row)? {
            StoredImage::Bytes(bytes) => (bytes, path.clone()),
            StoredImage::File(name) => {
                let path = inside(&self.source, &name, place)?;
                (read_image(&path, place)?, path)
            }
            StoredImage::Missing => {
                return Err(ImportError::record(place, format!("{} has no image", self.column)));
            }
        };
        codec::decode(&bytes).map_err(ImportError::image(place, path))
    }
}

/// The images of a batch whose only column is one of images; `None` if it is of another type.
fn stored_images(batch: &RecordBatch) -> Option<Vec<StoredImage>> {
    let column = batch.columns().first()?.as_struct_opt()?;
    let (bytes, paths) = (column.column_by_name("bytes")?, column.column_by_name("path"));
    let bytes_at = |row: usize| -> Option<Vec<u8>> {
        let (small, large) = (bytes.as_binary_opt::<i32>(), bytes.as_binary_opt::<i64>());
        let small = small.map(|array| array.value(row).to_vec());
        small.or_else(|| large.map(|array| array.value(row).to_vec()))
    };
    let path_at = |row: usize| -> Option<String> {
        let paths = paths.filter(|paths| paths.is_valid(row))?.as_string_opt::<i32>()?;
        Some(paths.value(row).to_owned())
    };
    if bytes.as_binary_opt::<i32>().is_none() && bytes.as_binary_opt::<i64>().is_none() {
        return None;
    }
    let image = |row: usize| match (bytes.is_valid(row).then(|| bytes_at(row)).flatten(), path_at(row)) {
        (Some(bytes), _) => StoredImage::Bytes(bytes),
        (None, Some(path)) => StoredImage::File(path),
        (None, None) => StoredImage::Missing,
    };
    Some((0..batch.num_rows()).map(image).collect())
}
