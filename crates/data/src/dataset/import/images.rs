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
/// Names of the column with the time, if none is given.
const TIME_COLUMNS: [&str; 8] = [
    "timestamp",
    "timestamp_s",
    "time",
    "time_s",
    "t",
    "timestamp_ms",
    "timestamp_us",
    "timestamp_ns",
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
    let columns = header.columns()?;
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
                let record = columns.record(&line, row, &place)?;
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
        notes: header.note_on_unused(&columns),
        ..Recording::new(stem(folder, "recording"), records, ImageFiles(paths))
    })
}

/// A CSV file after its header, and the header. Its columns are separated by what gives the images' column, or else the
/// most columns. Errors: `Option`, `Io`.
fn reader<'a>(csv: &'a Path, options: &'a ImportOptions) -> Result<(csv::Reader<File>, Header<'a>), ImportError> {
    let bytes = open_file(csv)?.metadata().map_err(ImportError::io("read", csv))?.len();
    let shown = csv.display();
    if bytes > MAX_CSV_BYTES {
        let (size, most) = (bytes >> 20, MAX_CSV_BYTES >> 20);
        return Err(ImportError::Option(format!(
            "{shown} has {size} MiB; at most {most} MiB are possible"
        )));
    }
    let mut best: Option<(csv::Reader<File>, Header<'_>)> = None;
    for separator in SEPARATORS {
        let mut reader = csv::ReaderBuilder::new()
            .delimiter(separator)
            .trim(csv::Trim::All)
            .from_reader(open_file(csv)?);
        let names = reader
            .headers()
            .map_err(|error| ImportError::Option(format!("the header of {shown} cannot be read: {error}")))?;
        let header = Header {
            csv,
            names: names.iter().map(str::to_owned).collect(),
            options,
        };
        if header.image().is_some() {
            return Ok((reader, header));
        }
        if best
            .as_ref()
            .is_none_or(|(_, other)| header.names.len() > other.names.len())
        {
            best = Some((reader, header));
        }
    }
    best.filter(|(_, header)| !header.names.is_empty())
        .ok_or_else(|| ImportError::Option(format!("{shown} is empty; its first line must name the columns")))
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

/// The first line of a CSV file.
struct Header<'a> {
    csv: &'a Path,
    names: Vec<String>,
    options: &'a ImportOptions,
}

impl Header<'_> {
    /// The column of that name, with or without its unit.
    fn position(&self, name: &str) -> Option<usize> {
        let is_named = |text: &String| text == name || name_and_unit(text).0 == name;
        self.names.iter().position(is_named)
    }

    /// The column of a name that was given. Errors: `Option`.
    fn named(&self, name: &str, option: &str) -> Result<usize, ImportError> {
        self.position(name).ok_or_else(|| self.missing(name, option))
    }

    fn missing(&self, name: &str, option: &str) -> ImportError {
        let (csv, names) = (self.csv.display(), self.listed());
        ImportError::Option(format!(
            "{csv} has no column \"{name}\" ({option}); its columns are: {names}"
        ))
    }

    fn listed(&self) -> String {
        listed(self.names.iter().map(|name| name.escape_debug().to_string()))
    }

    /// The column with the images' files.
    fn image(&self) -> Option<usize> {
        match &self.options.image {
            Some(name) => self.position(name),
            None => FILE_COLUMNS.iter().find_map(|name| self.position(name)),
        }
    }

    /// The column with the times and its unit in seconds: the unit in the header, or else the one that the name says. `None`
    /// if the frames come at a known rate instead. Errors: `Option` without times, or for another unit.
    fn time(&self) -> Result<Option<(usize, f64)>, ImportError> {
        let usual = || TIME_COLUMNS.iter().find_map(|name| self.position(name));
        let column = match &self.options.time {
            Some(name) => Some(self.named(name, "--time")?),
            None => usual(),
        };
        let Some(column) = column else {
            if self.options.rate_hz.is_some() {
                return Ok(None);
            }
            let (csv, names) = (self.csv.display(), self.listed());
            return Err(ImportError::Option(format!(
                "{csv} has no column of times (its columns are: {names}); name it with --time, or give --rate"
            )));
        };
        let (name, unit) = name_and_unit(&self.names[column]);
        let unit_s = match unit {
            "" => seconds_per_unit(name),
            "s" => 1.0,
            "ms" => 1e-3,
            "us" | "µs" | "μs" => 1e-6,
            "ns" => 1e-9,
            _ => {
                return Err(ImportError::Option(format!(
                    "the column of times is {:?}; its unit must be s, ms, us or ns",
                    self.names[column]
                )));
            }
        };
        Ok(Some((column, unit_s)))
    }

    /// The columns named, else those whose names are the prefix or begin with it. Errors: `Option`.
    fn chosen(&self, names: &[String], prefix: &str) -> Result<Vec<usize>, ImportError> {
        if !names.is_empty() {
            let option = format!("--{prefix}");
            return names.iter().map(|name| self.named(name, &option)).collect();
        }
        let is_of = |&column: &usize| {
            let rest = name_and_unit(&self.names[column]).0.strip_prefix(prefix);
            rest.is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '_', '/']))
        };
        Ok((0..self.names.len()).filter(is_of).collect())
    }

    /// The columns that are used. Errors: `Option`.
    fn columns(&self) -> Result<Columns, ImportError> {
        let options = self.options;
        Ok(Columns {
            file: self.image().ok_or_else(|| match &options.image {
                Some(name) => self.missing(name, "--image"),
                None => self.missing("file", "name the images' column with --image"),
            })?,
            time: self.time()?,
            period_s: options.rate_hz.map_or(1.0, f64::recip),
            actions: self.chosen(&options.actions, "action")?,
            states: self.chosen(&options.states, "state")?,
        })
    }

    /// What is said about columns that nobody asked for.
    fn note_on_unused(&self, columns: &Columns) -> Vec<String> {
        let time = columns.time.map(|(column, _)| column);
        let is_used = |column: &usize| {
            let (column, chosen) = (*column, columns.actions.iter().chain(&columns.states));
            column == columns.file || Some(column) == time || chosen.copied().any(|used| used == column)
        };
        let unused = (0..self.names.len()).filter(|column| !is_used(column));
        let names: Vec<&str> = unused.map(|column| name_and_unit(&self.names[column]).0).collect();
        if names.is_empty() {
            return Vec::new();
        }
        let csv = self.csv.file_name().unwrap_or(self.csv.as_os_str());
        vec![format!(
            "columns of {} that were not imported: {}; to import one, name it as a component of the action (what the robot was \
             told) with --action COLUMN, or of the state (what it measured) with --state COLUMN",
            csv.display(),
            listed(names.iter().map(|name| name.escape_debug().to_string()))
        )]
    }

    fn channels(&self, columns: &[usize]) -> Vec<Channel> {
        let names = columns.iter().map(|&column| name_and_unit(&self.names[column]));
        names.map(|(name, unit)| self.options.channel(name, unit)).collect()
    }
}

/// The columns that are used, by position.
struct Columns {
    file: usize,
    /// The times and their unit in seconds.
    time: Option<(usize, f64)>,
    /// From one row to the next, without times.
    period_s: f64,
    actions: Vec<usize>,
    states: Vec<usize>,
}

impl Columns {
    /// The record of a line. Errors: `Record`.
    fn record(&self, line: &csv::StringRecord, row: usize, place: &str) -> Result<Record, ImportError> {
        let number = |column: usize| {
            let text = line.get(column).unwrap_or_default();
            // Data sets hold 32 bits.
            let value = text.parse().ok().filter(|value: &f64| (*value as f32).is_finite());
            value.ok_or_else(|| {
                let column = column + 1;
                let reason = format!("column {column} is {text:?}; it must be a finite number, as in 0.5");
                ImportError::record(place, reason)
            })
        };
        let numbers = |columns: &[usize]| -> Result<Vec<f32>, ImportError> {
            columns
                .iter()
                .map(|&column| number(column).map(|value| value as f32))
                .collect()
        };
        Ok(Record {
            timestamp_s: match self.time {
                Some((column, unit_s)) => number(column)? * unit_s,
                None => row as f64 * self.period_s,
            },
            action: numbers(&self.actions)?,
            state: numbers(&self.states)?,
            place: place.to_owned(),
            ..Record::default()
        })
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
