//! A folder of images, with or without a CSV file that gives each its time, action and state.

mod table;

use std::path::{Path, PathBuf};

use self::table::reader;
use super::files::{entries, extension, inside, stem};
use super::image_files::ImageFiles;
use super::recording::{Record, Recording};
use super::skipped::SkippedList;
use super::{ImportError, ImportOptions};

/// Reads the records of a folder. Errors: `Option`, `Io`, `Record`.
pub(super) fn open(folder: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    match csv_file(folder, options)? {
        Some(csv) => with_csv(folder, &csv, options),
        None => without_csv(folder, options),
    }
}

/// The CSV file: the one given, or the only one of the folder.
fn csv_file(folder: &Path, options: &ImportOptions) -> Result<Option<PathBuf>, ImportError> {
    if let Some(csv) = &options.csv {
        return Ok(Some(csv.clone()));
    }
    let mut found = own_entries(folder)?;
    found.retain(|path| extension(path) == "csv");
    match found.as_slice() {
        [] => Ok(None),
        [one] => Ok(Some(one.clone())),
        [first, second, ..] => Err(ImportError::Option(format!(
            "{} holds more than one CSV file ({}, {}); name one with --csv",
            folder.display(),
            first.display(),
            second.display()
        ))),
    }
}

/// What is in a folder, without the files in which macOS keeps attributes of others.
fn own_entries(folder: &Path) -> Result<Vec<PathBuf>, ImportError> {
    let mut paths = entries(folder)?;
    paths.retain(|path| {
        let name = path.file_name().unwrap_or_default();
        !name.to_string_lossy().starts_with("._")
    });
    Ok(paths)
}

fn without_csv(folder: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    options.names_no_values("a folder of images without a CSV file")?;
    let mut paths = own_entries(folder)?;
    paths.retain(|path| ["png", "jpg", "jpeg"].contains(&extension(path).as_str()));
    if paths.is_empty() {
        return Err(ImportError::UnknownSource(folder.to_owned()));
    }
    let Some(rate) = options.rate_hz else {
        return Err(ImportError::Option(format!(
            "{} has no timestamps (no CSV file); give the frames per second with --rate",
            folder.display()
        )));
    };
    let record = |(index, path): (usize, &PathBuf)| Record {
        timestamp_s: index as f64 / rate,
        place: path.display().to_string(),
        ..Record::default()
    };
    let records = paths.iter().enumerate().map(record).collect();
    Ok(Recording::new(stem(folder, "recording"), records, ImageFiles(paths)))
}

fn with_csv(folder: &Path, csv: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    let (mut reader, header) = reader(csv, options)?;
    let mut columns = header.columns()?;
    let texts = header.columns_of_texts(&columns, &mut reader)?;
    columns.leave_out(&texts, options);
    let (mut records, mut paths, mut skipped) = (Vec::new(), Vec::new(), SkippedList::default());
    let mut lines = reader.records();
    let (mut row, mut left_out) = (0, false);
    while let Some(line) = lines.next() {
        // The line after this one, since empty lines are not counted as records.
        let next = lines.reader().position().line();
        let place = format!("{} line {}", csv.display(), next.saturating_sub(1).max(row as u64 + 2));
        let parsed = line
            .map_err(|error| ImportError::record(&place, error))
            .and_then(|line| {
                let record = columns.record(&header, &line, row, &place)?;
                let name = line.get(columns.file).unwrap_or_default();
                Ok((inside(folder, name, &place)?, record))
            });
        match parsed {
            Ok((path, mut record)) => {
                record.begins_episode = std::mem::take(&mut left_out);
                records.push(record);
                paths.push(path);
            }
            Err(error) => {
                error.leave_out(options.skip_bad, &mut skipped)?;
                left_out = true;
            }
        }
        row += 1;
    }
    Ok(Recording {
        action_channels: header.channels(&columns.actions),
        state_channels: header.channels(&columns.states),
        skipped,
        notes: header.notes(&columns, &texts),
        ..Recording::new(stem(folder, "recording"), records, ImageFiles(paths))
    })
}
