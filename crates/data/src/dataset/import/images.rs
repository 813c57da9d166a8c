//! A folder of images, with or without a CSV file that gives each its time, action and state.

use std::fs::File;
use std::path::{Path, PathBuf};

use super::files::{entries, extension, inside, open_file, stem};
use super::image_files::ImageFiles;
use super::recording::{Record, Recording, seconds_per_unit};
use super::skipped::{SkippedList, listed};
use super::{ImportError, ImportOptions};
use foreframe_core::types::Channel;

/// Names of the column with the image's file, if none is given.
const FILE_COLUMNS: [&str; 5] = ["file", "filename", "image", "path", "frame"];
/// Names of the column with the time, if none is given, and its unit in seconds.
const TIME_COLUMNS: [(&str, f64); 8] = [
    ("timestamp", 1.0),
    ("timestamp_s", 1.0),
    ("time", 1.0),
    ("time_s", 1.0),
    ("t", 1.0),
    ("timestamp_ms", 1e-3),
    ("timestamp_us", 1e-6),
    ("timestamp_ns", 1e-9),
];

/// What can separate the columns of a CSV file.
const SEPARATORS: [u8; 3] = *b",;\t";
/// The largest CSV file.
const MAX_CSV_BYTES: u64 = 256 << 20;

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
    let mut found = entries(folder)?;
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

fn without_csv(folder: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    let mut paths = entries(folder)?;
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
        image: index,
        place: path.display().to_string(),
        ..Record::default()
    };
    let records = paths.iter().enumerate().map(record).collect();
    let name = stem(folder, "recording");
    Ok(Recording::of_images(name, records, ImageFiles(paths)))
}

/// The columns that are used, by position.
struct Columns {
    file: usize,
    time: Option<(usize, f64)>,
    actions: Vec<usize>,
    states: Vec<usize>,
}

fn with_csv(folder: &Path, csv: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    let (mut reader, header) = reader(csv, options)?;
    let columns = Columns::find(&header, csv, options)?;
    let (mut records, mut paths, mut skipped) = (Vec::new(), Vec::new(), SkippedList::default());
    let mut lines = reader.records();
    let mut row = 0;
    while let Some(line) = lines.next() {
        // The line after this one, since empty lines are not counted as records.
        let next = lines.reader().position().line();
        let place = format!("{} line {}", csv.display(), next.saturating_sub(1).max(row as u64 + 2));
        let parsed = line
            .map_err(|error| ImportError::record(&place, error.to_string()))
            .and_then(|line| columns.record(&line, row, &place, folder, options));
        match parsed {
            Ok((path, record)) => {
                records.push(Record {
                    image: paths.len(),
                    ..record
                });
                paths.push(path);
            }
            Err(error) => error.leave_out(options.skip_bad, &mut skipped)?,
        }
        row += 1;
    }
    Ok(Recording {
        action_channels: channels(&header, &columns.actions, options),
        state_channels: channels(&header, &columns.states, options),
        skipped,
        ..Recording::of_images(stem(folder, "recording"), records, ImageFiles(paths))
    })
}

/// A CSV file after its header, and the header. Its columns are separated by what gives the images' column, or else the
/// most columns. Errors: `Option`, `Io`.
fn reader(csv: &Path, options: &ImportOptions) -> Result<(csv::Reader<File>, Vec<String>), ImportError> {
    let bytes = open_file(csv)?.metadata().map_err(ImportError::io("read", csv))?.len();
    if bytes > MAX_CSV_BYTES {
        let (size, most) = (bytes >> 20, MAX_CSV_BYTES >> 20);
        let reason = format!("{} has {size} MiB; at most {most} MiB are possible", csv.display());
        return Err(ImportError::Option(reason));
    }
    let mut best: Option<(csv::Reader<File>, Vec<String>)> = None;
    for separator in SEPARATORS {
        let mut reader = csv::ReaderBuilder::new()
            .delimiter(separator)
            .trim(csv::Trim::All)
            .from_reader(open_file(csv)?);
        let header = reader.headers().map_err(|error| {
            let reason = format!("the header of {} cannot be read: {error}", csv.display());
            ImportError::Option(reason)
        })?;
        let header: Vec<String> = header.iter().map(str::to_owned).collect();
        if image_column(&header, options).is_some() {
            return Ok((reader, header));
        }
        if best.as_ref().is_none_or(|(_, other)| header.len() > other.len()) {
            best = Some((reader, header));
        }
    }
    best.filter(|(_, header)| !header.is_empty()).ok_or_else(|| {
        ImportError::Option(format!(
            "{} is empty; its first line must name the columns",
            csv.display()
        ))
    })
}

/// The column of that name, with or without its unit.
fn position(header: &[String], name: &str) -> Option<usize> {
    header
        .iter()
        .position(|text| text == name || name_and_unit(text).0 == name)
}

/// The column with the images' files.
fn image_column(header: &[String], options: &ImportOptions) -> Option<usize> {
    match &options.image {
        Some(name) => position(header, name),
        None => FILE_COLUMNS.iter().find_map(|name| position(header, name)),
    }
}

/// The column with the times and its unit in seconds: the unit in the header, or else the one that the name says.
/// Errors: `Option` for another unit.
fn time_column(header: &[String], column: usize, by_name_s: f64) -> Result<(usize, f64), ImportError> {
    let unit_s = match name_and_unit(&header[column]).1 {
        "" => by_name_s,
        "s" => 1.0,
        "ms" => 1e-3,
        "us" | "µs" | "μs" => 1e-6,
        "ns" => 1e-9,
        _ => {
            return Err(ImportError::Option(format!(
                "the column of times is {:?}; its unit must be s, ms, us or ns",
                header[column]
            )));
        }
    };
    Ok((column, unit_s))
}

/// Splits `speed [m/s]` or `speed (m/s)` into name and unit.
fn name_and_unit(header: &str) -> (&str, &str) {
    for (open, close) in [('[', ']'), ('(', ')')] {
        if let Some((name, unit)) = header.strip_suffix(close).and_then(|text| text.rsplit_once(open)) {
            return (name.trim(), unit.trim());
        }
    }
    (header, "")
}

fn channels(header: &[String], columns: &[usize], options: &ImportOptions) -> Vec<Channel> {
    let channel = |&column: &usize| {
        let (name, unit) = name_and_unit(&header[column]);
        let given = options.unit(name);
        Channel::new(name, if given.is_empty() { unit } else { &given })
    };
    columns.iter().map(channel).collect()
}

impl Columns {
    fn find(header: &[String], csv: &Path, options: &ImportOptions) -> Result<Self, ImportError> {
        let columns = || listed(header.iter().map(|name| name.escape_debug().to_string()));
        let position = |name: &str| position(header, name);
        let missing = |name: &str, option: &str| {
            ImportError::Option(format!(
                "{} has no column \"{name}\" ({option}); its columns are: {}",
                csv.display(),
                columns()
            ))
        };
        let wanted = |names: &[String], option: &str| -> Result<Vec<usize>, ImportError> {
            let find = |name: &String| position(name).ok_or_else(|| missing(name, option));
            names.iter().map(find).collect()
        };
        let prefixed = |prefix: &str| -> Vec<usize> {
            let is_of = |text: &String| {
                text.strip_prefix(prefix)
                    .is_some_and(|rest| rest.starts_with(['.', '_', '/']))
            };
            (0..header.len()).filter(|&column| is_of(&header[column])).collect()
        };
        let file = image_column(header, options).ok_or_else(|| match &options.image {
            Some(name) => missing(name, "--image"),
            None => missing("file", "name the images' column with --image"),
        })?;
        let time = match &options.time {
            Some(name) => Some((
                position(name).ok_or_else(|| missing(name, "--time"))?,
                seconds_per_unit(name_and_unit(name).0),
            )),
            None => TIME_COLUMNS
                .iter()
                .find_map(|(name, unit_s)| position(name).map(|column| (column, *unit_s))),
        };
        let time = time
            .map(|(column, unit_s)| time_column(header, column, unit_s))
            .transpose()?;
        if time.is_none() && options.rate_hz.is_none() {
            return Err(ImportError::Option(format!(
                "{} has no column of times (its columns are: {}); name it with --time, or give --rate",
                csv.display(),
                columns()
            )));
        }
        let chosen = |names: &[String], prefix: &str| match names {
            [] => Ok(prefixed(prefix)),
            names => wanted(names, &format!("--{prefix}")),
        };
        Ok(Self {
            file,
            time,
            actions: chosen(&options.actions, "action")?,
            states: chosen(&options.states, "state")?,
        })
    }

    #[expect(clippy::too_many_arguments, reason = "a line, its place and what it refers to")]
    fn record(
        &self,
        line: &csv::StringRecord,
        row: usize,
        place: &str,
        folder: &Path,
        options: &ImportOptions,
    ) -> Result<(PathBuf, Record), ImportError> {
        let text = |column: usize| line.get(column).unwrap_or_default();
        let number = |column: usize| -> Result<f64, ImportError> {
            // Data sets hold 32 bits.
            let value = text(column)
                .parse::<f64>()
                .ok()
                .filter(|value| (*value as f32).is_finite());
            value.ok_or_else(|| {
                let reason = format!(
                    "column {} is {:?}; it must be a finite number, as in 0.5",
                    column + 1,
                    text(column)
                );
                ImportError::record(place, reason)
            })
        };
        let numbers = |columns: &[usize]| -> Result<Vec<f32>, ImportError> {
            columns
                .iter()
                .map(|&column| number(column).map(|value| value as f32))
                .collect()
        };
        let timestamp_s = match self.time {
            Some((column, unit_s)) => number(column)? * unit_s,
            None => row as f64 * options.rate_hz.map_or(1.0, f64::recip),
        };
        let record = Record {
            timestamp_s,
            action: numbers(&self.actions)?,
            state: numbers(&self.states)?,
            place: place.to_owned(),
            ..Record::default()
        };
        Ok((inside(folder, text(self.file), place)?, record))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_read_from_the_header() {
        assert_eq!(name_and_unit("speed [m/s]"), ("speed", "m/s"));
        assert_eq!(name_and_unit("turn (rad/s)"), ("turn", "rad/s"));
        assert_eq!(name_and_unit("throttle"), ("throttle", ""));
    }
}
