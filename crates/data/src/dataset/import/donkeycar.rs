//! Donkeycar tubs, version 2: `manifest.json`, `catalog_*.catalog` and `images/`.

use std::collections::BTreeSet;
use std::fmt::Display;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::files::{folder_name, inside, open_file, read_text};
use super::image_files::ImageFiles;
use super::options::are_none;
use super::recording::{Record, Recording, any_follow};
use super::skipped::{SkippedList, listed, shortened};
use super::{ImportError, ImportOptions};

const MANIFEST: &str = "manifest.json";
/// Lines of the manifest: input names, input types, metadata, times, catalogs.
const MANIFEST_LINES: usize = 5;

/// The longest line of a catalog, in bytes.
const MAX_LINE_BYTES: u64 = 1 << 20;
/// How much of a wrong value a message quotes, in bytes.
const QUOTED_BYTES: usize = 60;

/// Whether a directory is a tub.
pub(super) fn is_tub(source: &Path) -> bool {
    source.join(MANIFEST).is_file()
}

/// What the manifest says.
struct TubManifest {
    inputs: Vec<(String, String)>,
    catalogs: Vec<String>,
    deleted: BTreeSet<u64>,
}

impl TubManifest {
    fn read(tub: &Path) -> Result<Self, ImportError> {
        let path = tub.join(MANIFEST);
        let text = read_text(&path)?;
        let wrong =
            |line: usize, reason: &dyn Display| ImportError::record(format!("{} line {line}", path.display()), reason);
        let parse = |(index, line)| serde_json::from_str(line).map_err(|error| wrong(index + 1, &error));
        let lines: Vec<Value> = text.lines().enumerate().map(parse).collect::<Result<_, _>>()?;
        let [names, types, _, _, catalogs, ..] = lines.as_slice() else {
            let count = lines.len();
            return Err(wrong(count, &format!("the file has {count} lines of {MANIFEST_LINES}")));
        };
        let inputs = texts(names).zip(texts(types));
        let (names, types) =
            inputs.ok_or_else(|| wrong(1, &"the names and types of the inputs are not lists of texts"))?;
        let deleted = catalogs["deleted_indexes"].as_array();
        Ok(Self {
            inputs: names.into_iter().zip(types).collect(),
            catalogs: texts(&catalogs["paths"])
                .ok_or_else(|| wrong(MANIFEST_LINES, &"\"paths\" is not a list of file names"))?,
            deleted: deleted.into_iter().flatten().filter_map(Value::as_u64).collect(),
        })
    }

    fn missing(&self, what: &str, option: &str) -> ImportError {
        let known = listed(self.inputs.iter().map(|(name, kind)| format!("{name} ({kind})")));
        ImportError::Option(format!("the tub has no {what} ({option}); its inputs are: {known}"))
    }

    /// The inputs of which this is true.
    fn inputs(&self, is_wanted: impl Fn(&str, &str) -> bool) -> Vec<String> {
        let wanted = self.inputs.iter().filter(|(name, kind)| is_wanted(name, kind));
        wanted.map(|(name, _)| name.clone()).collect()
    }

    /// The input that holds the image.
    fn image(&self, options: &ImportOptions) -> Result<String, ImportError> {
        let found = self.inputs(|name, kind| match &options.image {
            Some(wanted) => name == wanted,
            None => kind == "image_array",
        });
        let first = found.into_iter().next();
        first.ok_or_else(|| self.missing("an image input", "--image"))
    }

    /// The named inputs, which must exist; none for `none`.
    fn named(&self, names: &[String], option: &str) -> Result<Vec<String>, ImportError> {
        if are_none(names) {
            return Ok(Vec::new());
        }
        let is_known = |name: &String| self.inputs.iter().any(|(input, _)| input == name);
        match names.iter().find(|name| !is_known(name)) {
            Some(name) => Err(self.missing(&format!("input \"{name}\""), option)),
            None => Ok(names.to_vec()),
        }
    }

    /// The inputs of the action: those named, else every number that the driver gives (`user/…`).
    fn actions(&self, options: &ImportOptions) -> Result<Vec<String>, ImportError> {
        match options.actions.as_slice() {
            [] => Ok(self.inputs(|name, kind| kind == "float" && name.starts_with("user/"))),
            names => self.named(names, "--action"),
        }
    }
}

/// A list of texts.
fn texts(value: &Value) -> Option<Vec<String>> {
    let items = value.as_array()?.iter();
    items.map(|item| item.as_str().map(str::to_owned)).collect()
}

/// Reads the records of a tub. Errors: `Option`, `Io`, `Record`.
pub(super) fn open(tub: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    let manifest = TubManifest::read(tub)?;
    let reader = Reader {
        images: tub.join("images"),
        image: manifest.image(options)?,
        actions: manifest.actions(options)?,
        states: manifest.named(&options.states, "--state")?,
    };
    let (mut records, mut paths, mut skipped) = (Vec::new(), Vec::new(), SkippedList::default());
    let (mut marked, mut left_out) = (0, false);
    for catalog in &manifest.catalogs {
        let path = inside(tub, catalog, &tub.join(MANIFEST).display().to_string())?;
        let file = open_file(&path)?;
        let (mut lines, mut row) = (BufReader::new(file), 0);
        while let Some(line) = next_line(&mut lines).map_err(ImportError::io("read", &path))? {
            row += 1;
            let place = format!("{} line {row}", path.display());
            let parsed = line
                .map_err(|reason| ImportError::record(&place, reason))
                .and_then(|line| reader.record(&line, &place));
            match parsed {
                Ok((index, _, _)) if !options.include_deleted && manifest.deleted.contains(&index) => {
                    (marked, left_out) = (marked + 1, true);
                }
                Ok((_, image, mut record)) => {
                    record.begins_episode = std::mem::take(&mut left_out);
                    records.push(record);
                    paths.push(image);
                }
                Err(error) => {
                    error.leave_out(options.skip_bad, &mut skipped)?;
                    left_out = true;
                }
            }
        }
    }
    let notes = note_on_deleted(tub, marked, &records)?;
    // `user/angle` becomes `angle`.
    let channel = |name: &String| options.channel(name.rsplit('/').next().unwrap_or(name), "");
    Ok(Recording {
        action_channels: reader.actions.iter().map(channel).collect(),
        state_channels: reader.states.iter().map(channel).collect(),
        skipped,
        notes,
        ..Recording::new(folder_name(tub, "tub"), records, ImageFiles(paths))
    })
}

/// What is said about records that are marked as deleted. Errors: `Option` if no two of the others follow each other.
fn note_on_deleted(tub: &Path, marked: usize, kept: &[Record]) -> Result<Vec<String>, ImportError> {
    match marked {
        0 => Ok(Vec::new()),
        _ if !any_follow(kept) => Err(ImportError::Option(format!(
            "{marked} of the {} records of {} are marked as deleted in {MANIFEST}, so that no two consecutive frames are left; \
             --include-deleted imports them, too",
            marked + kept.len(),
            tub.display()
        ))),
        _ => Ok(vec![format!(
            "{marked} records are marked as deleted and were left out; --include-deleted imports them, too"
        )]),
    }
}

/// The next line, or why it cannot be read; `None` at the end.
fn next_line(lines: &mut impl BufRead) -> std::io::Result<Option<Result<String, String>>> {
    let mut line = Vec::new();
    if std::io::Read::take(&mut *lines, MAX_LINE_BYTES + 1).read_until(b'\n', &mut line)? == 0 {
        return Ok(None);
    }
    if line.pop_if(|last| *last == b'\n').is_none() && line.len() as u64 > MAX_LINE_BYTES {
        lines.skip_until(b'\n')?;
        return Ok(Some(Err(format!("the line has more than {MAX_LINE_BYTES} bytes"))));
    }
    Ok(Some(String::from_utf8(line).map_err(|error| error.to_string())))
}

/// What is read of each line.
struct Reader {
    /// The folder of the images.
    images: PathBuf,
    image: String,
    actions: Vec<String>,
    states: Vec<String>,
}

impl Reader {
    /// Index, image and record of a catalog's line.
    fn record(&self, line: &str, place: &str) -> Result<(u64, PathBuf, Record), ImportError> {
        let fields: Map<String, Value> = serde_json::from_str(line)
            .map_err(|error| ImportError::record(place, format!("not a JSON object: {error}")))?;
        let field = |name: &str| fields.get(name).unwrap_or(&Value::Null);
        let wrong = |name: &str, right: &str| {
            let found = fields.get(name).map_or_else(|| "missing".to_owned(), Value::to_string);
            let found = shortened(&found, QUOTED_BYTES);
            ImportError::record(place, format!("{name:?} is {found}; it must be {right}"))
        };
        let number = |name: &String| {
            let value = field(name).as_f64().map(|value| value as f32);
            value
                .filter(|value| value.is_finite())
                .ok_or_else(|| wrong(name, "a finite number"))
        };
        let numbers = |names: &[String]| names.iter().map(number).collect::<Result<Vec<f32>, _>>();
        let index = field("_index")
            .as_u64()
            .ok_or_else(|| wrong("_index", "a whole number"))?;
        let time_ms = field("_timestamp_ms").as_f64();
        let time_ms = time_ms.ok_or_else(|| wrong("_timestamp_ms", "a number of milliseconds"))?;
        let image = field(&self.image)
            .as_str()
            .ok_or_else(|| wrong(&self.image, "a file's name"))?;
        let record = Record {
            timestamp_s: time_ms / 1000.0,
            session: field("_session_id").as_str().unwrap_or_default().to_owned(),
            action: numbers(&self.actions)?,
            state: numbers(&self.states)?,
            place: place.to_owned(),
            ..Record::default()
        };
        Ok((index, inside(&self.images, image, place)?, record))
    }
}
