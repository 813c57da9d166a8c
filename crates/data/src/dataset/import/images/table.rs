//! The CSV file of a folder of images: its columns, and the record of each line.

use std::fs::File;
use std::path::Path;

use crate::dataset::import::files::open_file;
use crate::dataset::import::options::are_none;
use crate::dataset::import::recording::{Record, seconds_per_unit};
use crate::dataset::import::skipped::{listed, shortened};
use crate::dataset::import::{ImportError, ImportOptions};
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
/// How much of a wrong value a message quotes, in bytes.
const QUOTED_BYTES: usize = 60;
/// The largest CSV file.
const MAX_CSV_BYTES: u64 = 256 << 20;

/// A CSV file after its header, and the header. Its columns are separated by what gives the images' column, or else the
/// most columns. Errors: `Option`, `Io`.
pub(super) fn reader<'a>(
    csv: &'a Path,
    options: &'a ImportOptions,
) -> Result<(csv::Reader<File>, Header<'a>), ImportError> {
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
pub(super) struct Header<'a> {
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
        if are_none(names) {
            return Ok(Vec::new());
        }
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
    pub(super) fn columns(&self) -> Result<Columns, ImportError> {
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

    /// The actions and states that were found by their names, but have texts in all lines. Errors: `Record`.
    pub(super) fn columns_of_texts(
        &self,
        columns: &Columns,
        reader: &mut csv::Reader<File>,
    ) -> Result<Vec<TextColumn>, ImportError> {
        let by_name =
            |names: &[String], columns: &[usize]| if names.is_empty() { columns.to_vec() } else { Vec::new() };
        let found = [
            by_name(&self.options.actions, &columns.actions),
            by_name(&self.options.states, &columns.states),
        ];
        let of = |column| TextColumn {
            column,
            first: String::new(),
        };
        let mut texts: Vec<TextColumn> = found.concat().into_iter().map(of).collect();
        let start = reader.position().clone();
        for line in reader.records() {
            if texts.is_empty() {
                break;
            }
            match line {
                Ok(line) => texts.retain_mut(|text| text.takes(line.get(text.column).unwrap_or_default())),
                Err(error) if error.is_io_error() => return Err(ImportError::record(self.csv.display(), error)),
                // Damage of a line, which is found again when the records are read.
                Err(_) => {}
            }
        }
        let found = reader.seek(start);
        found.map_err(|error| ImportError::record(self.csv.display(), error))?;
        Ok(texts)
    }

    /// What is said about columns that were not imported.
    pub(super) fn notes(&self, columns: &Columns, texts: &[TextColumn]) -> Vec<String> {
        let csv = self.csv.file_name().unwrap_or(self.csv.as_os_str()).display();
        let name = |column: usize| name_and_unit(&self.names[column]).0;
        let of_text = |text: &TextColumn| {
            let (column, first) = (name(text.column), shortened(&text.first, QUOTED_BYTES));
            let why = if text.first.is_empty() {
                "is empty".to_owned()
            } else {
                format!("holds no numbers (its first value is {first:?})")
            };
            format!("the column {column:?} of {csv} {why}, so it was not imported")
        };
        let mut notes: Vec<String> = texts.iter().map(of_text).collect();
        let time = columns.time.map(|(column, _)| column);
        let is_known = |column: &usize| {
            let used = columns.actions.iter().chain(&columns.states).copied();
            let mut known = used
                .chain([columns.file])
                .chain(time)
                .chain(texts.iter().map(|text| text.column));
            known.any(|known| known == *column)
        };
        let unused = (0..self.names.len()).filter(|column| !is_known(column));
        let names: Vec<String> = unused.map(|column| name(column).escape_debug().to_string()).collect();
        if !names.is_empty() {
            notes.push(format!(
                "columns of {csv} that were not imported: {}; to import one, name it as a component of the action (what the robot \
                 was told) with --action COLUMN, or of the state (what it measured) with --state COLUMN",
                listed(names)
            ));
        }
        notes
    }

    pub(super) fn channels(&self, columns: &[usize]) -> Vec<Channel> {
        let names = columns.iter().map(|&column| name_and_unit(&self.names[column]));
        names.map(|(name, unit)| self.options.channel(name, unit)).collect()
    }
}

/// The columns that are used, by position.
pub(super) struct Columns {
    pub(super) file: usize,
    /// The times and their unit in seconds.
    time: Option<(usize, f64)>,
    /// From one row to the next, without times.
    period_s: f64,
    pub(super) actions: Vec<usize>,
    pub(super) states: Vec<usize>,
}

/// A column without numbers.
pub(super) struct TextColumn {
    column: usize,
    /// Its first value that is not empty.
    first: String,
}

impl TextColumn {
    /// Takes the value of a line. Returns false if it is a number.
    fn takes(&mut self, value: &str) -> bool {
        if self.first.is_empty() {
            value.clone_into(&mut self.first);
        }
        // A number that is too large or NaN is an error of its own.
        value.parse::<f64>().is_err()
    }
}

/// A number that data sets can hold: with 32 bits.
fn finite(text: &str) -> Option<f64> {
    text.parse().ok().filter(|value: &f64| (*value as f32).is_finite())
}

impl Columns {
    /// Leaves out these columns where they were found by name, as `options` say.
    pub(super) fn leave_out(&mut self, texts: &[TextColumn], options: &ImportOptions) {
        for (columns, named) in [
            (&mut self.actions, &options.actions),
            (&mut self.states, &options.states),
        ] {
            columns.retain(|column| !named.is_empty() || texts.iter().all(|text| text.column != *column));
        }
    }

    /// The record of a line. Errors: `Record`.
    pub(super) fn record(
        &self,
        header: &Header<'_>,
        line: &csv::StringRecord,
        row: usize,
        place: &str,
    ) -> Result<Record, ImportError> {
        let number = |column: usize, other: &str| {
            let text = line.get(column).unwrap_or_default();
            finite(text).ok_or_else(|| {
                let (name, text) = (&header.names[column], shortened(text, QUOTED_BYTES));
                let reason = format!("the column {name:?} is {text:?}; it must be a finite number, as in 0.5{other}");
                ImportError::record(place, reason)
            })
        };
        let numbers = |columns: &[usize], option: &str| -> Result<Vec<f32>, ImportError> {
            let other = format!(" ({option} chooses other columns, or none)");
            let of = |&column: &usize| number(column, &other).map(|value| value as f32);
            columns.iter().map(of).collect()
        };
        Ok(Record {
            timestamp_s: match self.time {
                Some((column, unit_s)) => number(column, "")? * unit_s,
                None => row as f64 * self.period_s,
            },
            action: numbers(&self.actions, "--action")?,
            state: numbers(&self.states, "--state")?,
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
