//! The numbers of a table's rows. Images are not read.

use std::fmt::Display;
use std::path::Path;

use arrow_array::cast::AsArray;
use arrow_array::types::{
    ArrowPrimitiveType, Float16Type, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type,
    UInt16Type, UInt32Type,
};
use arrow_array::{Array, ArrayRef, RecordBatch};
use arrow_schema::DataType;
use parquet::arrow::ProjectionMask;

use super::description::Component;
use crate::dataset::import::error::ImportError;
use crate::dataset::import::files::open_file;
use crate::dataset::store::parquet_file;

/// The numbers of one row.
pub(super) struct Row {
    pub(super) episode: usize,
    /// Seconds since the start of the episode.
    pub(super) timestamp_s: f64,
    /// The chosen components.
    pub(super) values: Vec<f32>,
    /// A column with a value that is missing or not finite.
    pub(super) bad: Option<String>,
}

/// The rows of a table are in memory as a whole.
const MAX_ROWS: i64 = 5_000_000;

/// Reads the chosen components of all rows. Errors: `Io`, `Record`.
pub(super) fn read_rows(path: &Path, name: &Path, components: &[Component]) -> Result<Vec<Row>, ImportError> {
    let wrong = |reason: &dyn Display| ImportError::record(path.display(), reason.to_string().trim());
    let file = open_file(path).map_err(|error| match error {
        ImportError::Io { source, .. } if source.kind() == std::io::ErrorKind::NotFound => {
            wrong(&format!("the table {} is missing", name.display()))
        }
        other => other,
    })?;
    let builder = parquet_file::open(file).map_err(|error| wrong(&error))?;
    let count = builder.metadata().file_metadata().num_rows();
    if count > MAX_ROWS {
        return Err(wrong(&format!(
            "it has {count} rows; at most {MAX_ROWS} of a table are read"
        )));
    }
    let mut wanted = vec!["episode_index", "timestamp"];
    wanted.extend(components.iter().map(|component| component.feature.as_str()));
    let fields = builder.schema().fields();
    if let Some(missing) = wanted.iter().find(|name| fields.find(name).is_none()) {
        return Err(wrong(&format!("it has no column {missing:?}")));
    }
    let roots = (0..fields.len()).filter(|&root| wanted.contains(&fields[root].name().as_str()));
    let mask = ProjectionMask::roots(builder.parquet_schema(), roots.collect::<Vec<_>>());
    let batches = parquet_file::batches(builder.with_projection(mask)).map_err(|error| wrong(&error))?;
    let mut rows = Vec::new();
    for batch in batches {
        let batch = batch.map_err(|error| wrong(&error))?;
        append(&batch, components, &mut rows).map_err(|column| {
            wrong(&format!(
                "column {column:?} does not hold one list of numbers in every row, as its feature states (--action and \
                 --state choose other features, or none)"
            ))
        })?;
    }
    Ok(rows)
}

/// Errors: the column of another type or length.
fn append(batch: &RecordBatch, components: &[Component], rows: &mut Vec<Row>) -> Result<(), String> {
    let scalar = |name: &str| column_numbers(batch, name).ok_or_else(|| name.to_owned());
    let (episodes, times) = (scalar("episode_index")?, scalar("timestamp")?);
    let mut vectors = Vec::with_capacity(components.len());
    for component in components {
        let column = batch.column_by_name(&component.feature);
        let lists = column.and_then(vectors_of).ok_or_else(|| component.feature.clone())?;
        if lists.iter().any(|list| component.index >= list.len()) {
            return Err(component.feature.clone());
        }
        vectors.push(lists);
    }
    for row in 0..batch.num_rows() {
        let chosen = components.iter().zip(&vectors);
        let values: Vec<f32> = chosen
            .map(|(component, lists)| lists[row][component.index] as f32)
            .collect();
        let bad = values.iter().position(|value| !value.is_finite());
        let bad = bad.map(|place| components[place].feature.clone());
        rows.push(Row {
            episode: episodes[row] as usize,
            timestamp_s: times[row],
            values,
            bad: bad.or_else(|| (!times[row].is_finite()).then(|| "timestamp".to_owned())),
        });
    }
    Ok(())
}

/// A column of single numbers; NaN where one is missing.
pub(super) fn column_numbers(batch: &RecordBatch, name: &str) -> Option<Vec<f64>> {
    numbers(batch.column_by_name(name)?)
}

/// The numbers of an array of any numeric type; NaN where one is missing.
fn numbers(array: &ArrayRef) -> Option<Vec<f64>> {
    fn of<T: ArrowPrimitiveType>(array: &ArrayRef, number: impl Fn(T::Native) -> f64) -> Vec<f64> {
        let values = array.as_primitive::<T>().iter();
        values.map(|value| value.map_or(f64::NAN, &number)).collect()
    }
    Some(match array.data_type() {
        DataType::Float16 => of::<Float16Type>(array, f64::from),
        DataType::Float32 => of::<Float32Type>(array, f64::from),
        DataType::Float64 => of::<Float64Type>(array, f64::from),
        DataType::Int8 => of::<Int8Type>(array, f64::from),
        DataType::Int16 => of::<Int16Type>(array, f64::from),
        DataType::Int32 => of::<Int32Type>(array, f64::from),
        DataType::UInt8 => of::<UInt8Type>(array, f64::from),
        DataType::UInt16 => of::<UInt16Type>(array, f64::from),
        DataType::UInt32 => of::<UInt32Type>(array, f64::from),
        DataType::Int64 => of::<Int64Type>(array, |value| value as f64),
        DataType::Boolean => {
            let values = array.as_boolean().iter();
            values
                .map(|value| value.map_or(f64::NAN, |value| f64::from(u8::from(value))))
                .collect()
        }
        _ => return None,
    })
}

/// The rows of a column of lists, or of single numbers.
fn vectors_of(array: &ArrayRef) -> Option<Vec<Vec<f64>>> {
    let list = |values: ArrayRef| numbers(&values);
    match array.data_type() {
        DataType::List(_) => array.as_list::<i32>().iter().map(|row| list(row?)).collect(),
        DataType::LargeList(_) => array.as_list::<i64>().iter().map(|row| list(row?)).collect(),
        DataType::FixedSizeList(..) => array.as_fixed_size_list().iter().map(|row| list(row?)).collect(),
        _ => Some(numbers(array)?.into_iter().map(|value| vec![value]).collect()),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use arrow_array::PrimitiveArray;

    use super::*;

    #[test]
    fn floats_of_16_bits_are_numbers() {
        let half = <Float16Type as ArrowPrimitiveType>::Native::from_f32(-1.5);
        let array: ArrayRef = Arc::new(PrimitiveArray::<Float16Type>::from_iter_values([half]));
        assert_eq!(numbers(&array), Some(vec![-1.5]));
    }
}
