//! Turns recordings of real robots into data sets.
//!
//! A source (`images`, `donkeycar`, `lerobot`, `numpy`, `npz`, `video` or `bag`) lists its records: time, action, state and where the image
//! is. `timing` cuts them into episodes at one frame rate. `writer` reads the images, resizes them, and writes shards.
//! Only one shard is in memory at a time.

mod bag;
mod donkeycar;
mod images;
mod kind;
mod lerobot;
mod npz;
mod numpy;
mod recording;
mod skipped;
mod timing;
mod video;
mod writer;

use std::fmt::Display;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use serde::{Deserialize, Serialize};

use self::recording::Recording;
pub use self::skipped::SkippedItem;
use self::skipped::{SkippedList, listed, shortened};
use super::{DatasetError, DatasetInfo};
use foreframe_core::frame::fit::Fit;
use foreframe_core::frame::{FrameError, MAX_SIDE_PX};

/// The largest [`ImportOptions::every`].
const MAX_EVERY: usize = 1_000_000;
/// The largest file that is read in one piece, in bytes.
const MAX_FILE_BYTES: u64 = 256 << 20;
/// The largest text that describes a recording, in bytes.
const MAX_TEXT_BYTES: u64 = 32 << 20;

/// What to import, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportConfig {
    /// The recording: a folder of images, a Donkeycar tub, a `LeRobot` data set, a bag, a `NumPy` file or a video.
    pub source: PathBuf,
    /// The data set's directory.
    pub out: PathBuf,
    /// How its records are read.
    pub options: ImportOptions,
    /// Disk space for frames that are decompressed before they are imported, in MiB.
    pub disk_mib: u64,
}

/// The default of [`ImportConfig::disk_mib`].
pub const DEFAULT_DISK_MIB: u64 = 16 << 10;

/// How a recording is read. All of it has defaults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImportOptions {
    /// Width of the data set's frames in pixels.
    pub frame_width_px: u32,
    /// Height of the data set's frames in pixels.
    pub frame_height_px: u32,
    /// How images of another shape are fitted.
    pub fit: Fit,
    /// Frames per second of the data set. Without timestamps: of the recording. `None` keeps the recording's rate.
    pub rate_hz: Option<f64>,
    /// Keeps every Nth frame, 1 to 1,000,000; actions in between are averaged.
    pub every: usize,
    /// A CSV file with one line per image.
    pub csv: Option<PathBuf>,
    /// The CSV column, the array, or the bag's topic, of the images; by default the usual names.
    pub image: Option<String>,
    /// The CSV column of the time in seconds (or `_ms`, `_us`, `_ns` by its name). For a bag, `header` or `log`.
    pub time: Option<String>,
    /// Names of the action's components; by default those that the source marks as actions.
    pub actions: Vec<String>,
    /// Names of the state's components; by default those that the source marks as states.
    pub states: Vec<String>,
    /// Units as `NAME=UNIT`.
    pub units: Vec<String>,
    /// For how long, in seconds, the last action and state of a bag hold.
    pub hold_s: f64,
    /// Leaves out what is damaged, counts it and lists it, instead of stopping there.
    pub skip_bad: bool,
}

impl Default for ImportOptions {
    fn default() -> Self {
        Self {
            frame_width_px: 64,
            frame_height_px: 64,
            fit: Fit::Crop,
            rate_hz: None,
            every: 1,
            csv: None,
            image: None,
            time: None,
            actions: Vec::new(),
            states: Vec::new(),
            units: Vec::new(),
            hold_s: 1.0,
            skip_bad: false,
        }
    }
}

/// What an import made.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    /// The data set.
    pub info: DatasetInfo,
    /// What was left out. The last entry can stand for all that are not listed.
    pub skipped: Vec<SkippedItem>,
}

impl Imported {
    /// How many items were left out.
    #[must_use]
    pub fn skipped_count(&self) -> u64 {
        self.skipped.iter().map(|item| item.count).sum()
    }
}

/// How many frames are written, of how many.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImportProgress {
    /// Frames written, those of an earlier run included.
    pub done: u64,
    /// Frames in all.
    pub total: u64,
}

/// Why a recording could not be imported: file and place, what was wrong, what would be right.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// The source is of no known kind.
    #[error(
        "{} is not a recording that can be imported; give a folder of PNG or JPEG images (with or without a CSV), a \
         Donkeycar tub (manifest.json), a LeRobot data set (meta/info.json), a bag of ROS 2 (.mcap, .db3 or its directory), a .npy \
         or .npz file, or a video (.mp4, .mkv, .avi, .mov, .webm)",
        .0.display()
    )]
    UnknownSource(PathBuf),
    /// An option does not fit the source.
    #[error("{0}")]
    Option(String),
    /// An option's value is out of range.
    #[error("--{option} is {value}; {right}")]
    OptionValue {
        /// The option of `foreframe import`, without dashes.
        option: &'static str,
        /// Its value.
        value: String,
        /// What would be right.
        right: String,
    },
    /// A file could not be read or written.
    #[error("could not {action} {}", path.display())]
    Io {
        /// `read`, `write`, …
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A record is wrong.
    #[error("{place}: {reason}; mend it, or leave out what is damaged with --skip-bad")]
    Record {
        /// File and line, frame or position.
        place: String,
        /// What is wrong with it.
        reason: String,
    },
    /// An image cannot be decoded.
    #[error("{place}: {} is damaged; replace it, or leave out what is damaged with --skip-bad", path.display())]
    Image {
        /// File and line of the record.
        place: String,
        /// The image.
        path: PathBuf,
        /// Why.
        source: FrameError,
    },
    /// Nothing is left to import.
    #[error("{} holds no two consecutive frames; a data set needs more", .0.display())]
    Empty(PathBuf),
    /// Another import uses the directory with other options, or it holds something else.
    #[error("{} exists and belongs to something else ({what}); name a new directory", path.display())]
    OutExists {
        /// The directory.
        path: PathBuf,
        /// What is there.
        what: String,
    },
    /// A program that is needed is missing or failed.
    #[error("{0}")]
    Program(String),
    /// It was cancelled; what was written stays.
    #[error("stopped after {done} of {total} frames; the same command continues")]
    Cancelled {
        /// Frames written.
        done: u64,
        /// Frames in all.
        total: u64,
    },
    /// It was cancelled before the first frame.
    #[error("stopped while the recording was read; the same command reads it again")]
    Stopped,
    /// The frames need more room beside the data set than they may have.
    #[error(
        "the compressed frames need {needed_mib} MiB of disk space during the import; the setting import_disk_mib allows \
         {limit_mib} MiB: raise it, or save the array without compression"
    )]
    Disk {
        /// What they need.
        needed_mib: u64,
        /// What they may have.
        limit_mib: u64,
    },
    /// The data set could not be written.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
}

impl ImportError {
    fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }

    fn record(place: impl Into<String>, reason: impl Into<String>) -> Self {
        Self::Record {
            place: place.into(),
            reason: reason.into(),
        }
    }

    /// The item to list when what is damaged is left out; `None` if it is no damage of a single item.
    fn skippable(&self) -> Option<SkippedItem> {
        match self {
            Self::Record { place, reason } => Some(SkippedItem::new(place, reason)),
            Self::Image { place, path, source } => {
                let reason = format!("{} is damaged: {source}", path.display());
                Some(SkippedItem::new(place, &reason))
            }
            _ => None,
        }
    }
}

/// Width and height in pixels, written as in `64x64`. Errors: `OptionValue`.
pub fn parse_size(text: &str) -> Result<(u32, u32), ImportError> {
    let sides = text
        .split_once('x')
        .and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    sides.ok_or_else(|| ImportError::OptionValue {
        option: "size",
        value: format!("\"{}\"", text.escape_default()),
        right: "write WIDTHxHEIGHT, as in 64x64".to_owned(),
    })
}

/// Whether a directory can be written by this import: it is unused, holds the same import, or holds another one that has
/// written no frames yet. Errors: `OutExists`, `Io`.
pub fn check_out(config: &ImportConfig) -> Result<(), ImportError> {
    writer::Directory::check(config).map(drop)
}

/// How many shards an unfinished import has written; a later run continues after them.
#[must_use]
pub fn saved_shards(out: &Path) -> usize {
    writer::saved_shards(out)
}

/// Imports a recording, or continues an import that was stopped; the result has the same bytes either way. Returns at once
/// if the data set is complete. Errors: every [`ImportError`].
pub fn import(
    config: &ImportConfig,
    on_progress: &(dyn Fn(ImportProgress) + Sync),
    cancelled: &AtomicBool,
) -> Result<Imported, ImportError> {
    let options = &config.options;
    options.validate()?;
    let directory = writer::Directory::claim(config)?;
    if let Some(finished) = directory.finished()? {
        return Ok(finished);
    }
    let recording = open(config, cancelled)?;
    check_channels(&recording)?;
    options.check_units(&recording)?;
    let plan = timing::plan(recording, options)?;
    directory.write(&plan, on_progress, cancelled)
}

/// Errors: `Option` if two components of the action or of the state have the same name.
fn check_channels(recording: &Recording) -> Result<(), ImportError> {
    for (what, channels) in [
        ("action", &recording.action_channels),
        ("state", &recording.state_channels),
    ] {
        for (index, channel) in channels.iter().enumerate() {
            if channels[..index].iter().any(|earlier| earlier.name == channel.name) {
                return Err(ImportError::Option(format!(
                    "two components of the {what} are named \"{}\"; choose and name them with --{what}, each once",
                    channel.name
                )));
            }
        }
    }
    Ok(())
}

/// Opens a file of a recording. Errors: `Io`, also for what is no regular file: reading a named pipe could take forever.
fn open_file(path: &Path) -> Result<File, ImportError> {
    let opened = std::fs::metadata(path).and_then(|found| {
        if found.is_file() {
            File::open(path)
        } else {
            Err(std::io::Error::new(
                std::io::ErrorKind::InvalidInput,
                "it is not a regular file",
            ))
        }
    });
    opened.map_err(ImportError::io("read", path))
}

fn read_file(path: &Path) -> Result<Vec<u8>, ImportError> {
    read_at_most(path, MAX_FILE_BYTES)
}

fn read_at_most(path: &Path, most: u64) -> Result<Vec<u8>, ImportError> {
    let mut bytes = Vec::new();
    let mut file = open_file(path)?.take(most + 1);
    file.read_to_end(&mut bytes).map_err(ImportError::io("read", path))?;
    if bytes.len() as u64 > most {
        let reason = format!("it has more than {} MiB", most >> 20);
        let error = std::io::Error::new(std::io::ErrorKind::InvalidData, reason);
        return Err(ImportError::io("read", path)(error));
    }
    Ok(bytes)
}

fn read_text(path: &Path) -> Result<String, ImportError> {
    let invalid = |_| std::io::Error::new(std::io::ErrorKind::InvalidData, "it is not UTF-8 text");
    String::from_utf8(read_at_most(path, MAX_TEXT_BYTES)?)
        .map_err(invalid)
        .map_err(ImportError::io("read", path))
}

/// Reads the records of a source, after finding out of which kind it is.
fn open(config: &ImportConfig, cancelled: &AtomicBool) -> Result<Recording, ImportError> {
    let (source, options) = (&config.source, &config.options);
    if !source.is_dir() {
        open_file(source)?;
    }
    if donkeycar::is_tub(source) {
        return donkeycar::open(source, options);
    }
    if lerobot::is_lerobot(source) {
        return lerobot::open(source, options, cancelled);
    }
    if bag::is_bag(source) {
        return bag::open(source, options, cancelled);
    }
    if source.is_dir() {
        return images::open(source, options);
    }
    match extension(source).as_str() {
        "npy" => numpy::open(source, options),
        "npz" => npz::open(config, cancelled),
        "mp4" | "mkv" | "avi" | "mov" | "webm" => video::open(source, options, cancelled),
        _ => Err(ImportError::UnknownSource(source.clone())),
    }
}

impl ImportOptions {
    /// Checks what can be checked without the source. Errors: `OptionValue`.
    pub fn validate(&self) -> Result<(), ImportError> {
        let wrong = |option, value: &dyn Display, right: &str| {
            Err(ImportError::OptionValue {
                option,
                value: value.to_string(),
                right: right.to_owned(),
            })
        };
        if !(1..=MAX_EVERY).contains(&self.every) {
            return wrong("every", &self.every, &format!("it must be 1 to {MAX_EVERY}"));
        }
        if let Some(rate) = self.rate_hz.filter(|rate| !(0.01..=1000.0).contains(rate)) {
            return wrong("rate", &rate, "it must be 0.01 to 1000 frames per second");
        }
        if !(0.0..=3600.0).contains(&self.hold_s) {
            return wrong("hold", &self.hold_s, "it must be 0 to 3600 seconds");
        }
        let (width, height) = (self.frame_width_px, self.frame_height_px);
        let sides = 1..=MAX_SIDE_PX;
        if !(sides.contains(&width) && sides.contains(&height)) {
            let right = format!("each side must be 1 to {MAX_SIDE_PX} px");
            return wrong("size", &format!("{width}x{height}"), &right);
        }
        if let Some(unit) = self.units.iter().find(|unit| !unit.contains('=')) {
            let given = format!("\"{}\"", unit.escape_default());
            return wrong("unit", &given, "write NAME=UNIT, as in speed=m/s");
        }
        Ok(())
    }

    /// Errors: `Option` if a unit is given for a channel that the recording does not have.
    fn check_units(&self, recording: &Recording) -> Result<(), ImportError> {
        let channels = || recording.action_channels.iter().chain(&recording.state_channels);
        let mut named = self.units.iter().filter_map(|unit| unit.split_once('='));
        let Some((name, _)) = named.find(|(name, _)| channels().all(|channel| channel.name != *name)) else {
            return Ok(());
        };
        let known = listed(channels().map(|channel| channel.name.as_str()));
        Err(ImportError::Option(format!(
            "--unit names the channel \"{}\", which is not imported; there are: {}",
            name.escape_default(),
            known
        )))
    }

    /// The unit that `--unit NAME=UNIT` gives a channel; empty if none does.
    fn unit(&self, name: &str) -> String {
        let given = self.units.iter().filter_map(|unit| unit.split_once('='));
        given
            .filter(|(channel, _)| *channel == name)
            .map(|(_, unit)| unit.to_owned())
            .next()
            .unwrap_or_default()
    }
}

/// The extension in lower case; empty if there is none.
fn extension(path: &Path) -> String {
    path.extension()
        .map(|extension| extension.to_string_lossy().to_lowercase())
        .unwrap_or_default()
}
