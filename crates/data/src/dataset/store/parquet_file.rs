//! Reads Parquet files, also those of others. The library panics at some damaged files instead of returning an error: everything
//! that parses or decodes goes through here, where a panic becomes an error.

use std::any::Any;
use std::cell::Cell;
use std::fs::File;
use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};

use arrow_array::RecordBatch;
use arrow_schema::ArrowError;
use parquet::arrow::arrow_reader::{ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder};
use parquet::errors::ParquetError;

/// A reader of the file, which still has to be built with [`batches`]. Errors: the file is not Parquet, is damaged, or a column is
/// outside of it.
pub(crate) fn open(file: File) -> Result<ParquetRecordBatchReaderBuilder<File>, ParquetError> {
    let length = file.metadata()?.len();
    let builder = guarded(|| ParquetRecordBatchReaderBuilder::try_new(file)).map_err(ParquetError::General)??;
    for (number, group) in builder.metadata().row_groups().iter().enumerate() {
        for column in group.columns() {
            let start = column
                .dictionary_page_offset()
                .unwrap_or_else(|| column.data_page_offset());
            let end = u64::try_from(start)
                .ok()
                .zip(u64::try_from(column.compressed_size()).ok())
                .and_then(|(start, size)| start.checked_add(size));
            if end.is_none_or(|end| end > length) || group.num_rows() < 0 {
                let name = column.column_path().string();
                return Err(ParquetError::General(format!(
                    "column {name:?} of row group {number} is outside of the file"
                )));
            }
        }
    }
    Ok(builder)
}

/// The rows of the builder's file. Errors: the file is damaged.
pub(crate) fn batches(builder: ParquetRecordBatchReaderBuilder<File>) -> Result<Batches, ParquetError> {
    let reader = guarded(|| builder.build()).map_err(ParquetError::General)??;
    Ok(Batches(Some(reader)))
}

/// Rows of a file, some at a time. Ends after a panic of the library.
pub(crate) struct Batches(Option<ParquetRecordBatchReader>);

impl Iterator for Batches {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        let reader = self.0.as_mut()?;
        guarded(|| reader.next()).unwrap_or_else(|reason| {
            self.0 = None;
            Some(Err(ArrowError::ParquetError(reason)))
        })
    }
}

thread_local! {
    /// Whether a panic of this thread becomes an error.
    static IS_GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// Keeps the present panic hook from panics that become errors: nobody needs to read of them.
pub fn silence_caught_panics() {
    let hook = take_hook();
    set_hook(Box::new(move |panic| {
        if !IS_GUARDED.get() {
            hook(panic);
        }
    }));
}

/// The result of `work`, after whose panic nothing that it changed is used. Error: what the panic said.
fn guarded<T>(work: impl FnOnce() -> T) -> Result<T, String> {
    IS_GUARDED.set(true);
    let result = catch_unwind(AssertUnwindSafe(work));
    IS_GUARDED.set(false);
    result.map_err(|panic| format!("it is damaged: {}", message(panic.as_ref())))
}

fn message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("the Parquet library could not read it")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Everything that is read of a damaged file of the corpus.
    fn read(name: &str) -> String {
        let dir = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/corpus/shards");
        let file = File::open(format!("{dir}/{name}")).unwrap();
        let rows = open(file).and_then(batches);
        let error = rows.map_or_else(
            |error| Some(error.to_string()),
            |mut rows| rows.find_map(|row| row.err().map(|error| error.to_string())),
        );
        error.unwrap()
    }

    #[test]
    fn a_column_outside_of_the_file_is_an_error() {
        let error = read("column-outside-of-the-file");
        assert!(error.contains("is outside of the file"), "{error}");
    }

    #[test]
    fn a_panic_of_the_library_is_an_error() {
        for name in ["dictionary-page-is-missing", "validity-bits-outside-of-the-buffer"] {
            let error = read(name);
            assert!(error.contains("it is damaged: "), "{name}: {error}");
        }
    }
}
