//! Opens Parquet files, also those of others.

use std::fs::File;

use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::errors::ParquetError;

/// A reader of the file, which still has to be built. Errors: the file is not Parquet, or a column is outside of it, at which the
/// library would panic.
pub(super) fn open(file: File) -> Result<ParquetRecordBatchReaderBuilder<File>, ParquetError> {
    let length = file.metadata()?.len();
    let builder = ParquetRecordBatchReaderBuilder::try_new(file)?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_column_outside_of_the_file_is_an_error() {
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/tests/corpus/shards/column-outside-of-the-file"
        );
        let error = open(File::open(path).unwrap()).map(drop).unwrap_err();
        assert!(error.to_string().contains("is outside of the file"), "{error}");
    }
}
