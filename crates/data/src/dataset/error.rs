//! Errors of data sets.

use std::path::PathBuf;

use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::files::is_transient;
use foreframe_core::frame::FrameError;
use foreframe_sim::SimError;

/// Why a data set could not be written, read or sampled.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// The parts of an episode have different numbers of frames.
    #[error("episode {episode}: {part} has {found} values; {frames} frames need {expected}")]
    PartLength {
        /// Position of the episode.
        episode: usize,
        /// `pixels`, `mask`, `action` or `state`.
        part: &'static str,
        /// Number of frames of the episode, one for each timestamp.
        frames: usize,
        /// Values found.
        found: usize,
        /// Values needed.
        expected: usize,
    },
    /// An action, state or timestamp was NaN or infinite.
    #[error("episode {episode}, frame {frame}: {part} is {value}; every number must be finite")]
    NotFinite {
        /// Position of the episode.
        episode: usize,
        /// Frame within the episode.
        frame: usize,
        /// `action`, `state` or `timestamp`.
        part: &'static str,
        /// The value found.
        value: f64,
    },
    /// The timestamps of an episode do not increase.
    #[error(
        "episode {episode}, frame {frame}: the timestamp is not later than the previous one; timestamps must increase"
    )]
    TimeOrder {
        /// Position of the episode.
        episode: usize,
        /// Frame within the episode.
        frame: usize,
    },
    /// Some episodes have masks and others do not.
    #[error("episode {episode}: either every episode must have masks, or none")]
    MixedMasks {
        /// Position of the first episode that differs.
        episode: usize,
    },
    /// The data set has no frames.
    #[error("the data set \"{name}\" has no frames; at least one episode with one frame is needed")]
    Empty {
        /// The data set's name.
        name: String,
    },
    /// The description of the data set is invalid.
    #[error("{0}")]
    Description(String),
    /// A count that must be at least 1 is 0.
    #[error("{what} is 0; it must be at least 1")]
    Zero {
        /// The setting, as the user knows it.
        what: &'static str,
    },
    /// No episode is long enough.
    #[error(
        "a window of {window} frames (context {context}, horizon {horizon}) is longer than every episode of the {split} \
         split; the longest has {longest} frames without a gap. Record longer, or train with a smaller context or horizon"
    )]
    WindowTooLong {
        /// Frames of the window.
        window: usize,
        /// Context frames.
        context: usize,
        /// Frames to predict.
        horizon: usize,
        /// The split.
        split: &'static str,
        /// Frames of the longest segment without a gap.
        longest: usize,
    },
    /// The split has fewer windows than requested.
    #[error(
        "data.windows is {requested}, but the {split} split has only {available} windows; use a smaller number, use \
         data.windows=all, or collect more trials"
    )]
    TooFewWindows {
        /// Requested windows.
        requested: usize,
        /// The split.
        split: &'static str,
        /// Available windows.
        available: usize,
    },
    /// A file could not be read or written.
    #[error("could not {action} {path}", path = path.display())]
    Io {
        /// `read`, `write`, …
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The decoded frames could not be written.
    #[error(
        "could not write the decoded frames of the data set ({size_mib} MiB) to {path}; free disk space or make the directory \
         writable, or hold the frames in memory with the setting dataset_memory_mib={size_mib} \
         (FOREFRAME_DATASET_MEMORY_MIB={size_mib})",
        path = path.display()
    )]
    FrameFile {
        /// The file.
        path: PathBuf,
        /// Its size in MiB.
        size_mib: u64,
        /// The system's error.
        source: std::io::Error,
    },
    /// The content of a file is invalid.
    #[error("{path} is damaged or not a file of a Foreframe data set: {reason}", path = path.display())]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A frame in a file is not a valid image.
    #[error("{path}, row {row}: {column} is damaged", path = path.display())]
    CorruptFrame {
        /// The file.
        path: PathBuf,
        /// The column of images.
        column: &'static str,
        /// The row.
        row: usize,
        /// The image decoder's error.
        source: FrameError,
    },
    /// A frame could not be encoded.
    #[error("could not encode a frame")]
    Encode(#[source] FrameError),
    /// A table could not be built.
    #[error("could not build a table of the data set")]
    Build(#[source] parquet::errors::ParquetError),
    /// A file has changed since it was written.
    #[error(
        "{path} has the SHA-256 {found}, but its metadata states {expected}; restore the file or collect the data set \
         again",
        path = path.display()
    )]
    HashDiffers {
        /// The file.
        path: PathBuf,
        /// Hash in the metadata.
        expected: String,
        /// Hash of the file.
        found: String,
    },
    /// No data set has this name.
    #[error(
        "there is no data set {name:?} in {dir}; there {existing}; `foreframe collect` creates one",
        dir = dir.display(),
        existing = foreframe_core::error_text::existing(known)
    )]
    Unknown {
        /// The name asked for.
        name: String,
        /// The directory that was searched.
        dir: PathBuf,
        /// The names of the existing data sets.
        known: Vec<String>,
    },
    /// The directory holds no data set.
    #[error(
        "{path} holds no data set (meta/info.json is missing); give a directory that `foreframe collect` or `foreframe \
         import` wrote; `foreframe import` makes a data set of a recording",
        path = path.display()
    )]
    NotADataset {
        /// The directory.
        path: PathBuf,
    },
    /// The data set was not written by this program.
    #[error(
        "{path} is a LeRobot data set of another program; make one of Foreframe of it: foreframe import {path} --name NAME",
        path = path.display()
    )]
    OtherTool {
        /// The directory.
        path: PathBuf,
    },
    /// The directory contains something else.
    #[error(
        "{path} exists and is not a collection; use a directory that does not exist or is empty",
        path = path.display()
    )]
    OutExists {
        /// The directory.
        path: PathBuf,
    },
    /// The directory holds a collection with other arguments.
    #[error(
        "{path} holds a collection with other arguments ({differences}); use the same arguments to resume it, or use \
         another directory",
        path = path.display()
    )]
    OtherArguments {
        /// The directory.
        path: PathBuf,
        /// Each argument that differs, with both values.
        differences: String,
    },
    /// Another collection is writing to the directory.
    #[error("another collection is running in {path}; wait until it ends or use another directory", path = path.display())]
    Busy {
        /// The directory.
        path: PathBuf,
    },
    /// The collection was stopped before it was complete.
    #[error("stopped after {done} of {total} trials were saved; run the same command again to resume")]
    Cancelled {
        /// Trials in finished shards.
        done: u64,
        /// Requested trials.
        total: u64,
    },
    /// The world's settings are out of range.
    #[error(transparent)]
    World(SimError),
    /// The simulation of a trial failed.
    #[error("could not simulate trial {trial}")]
    Simulation {
        /// The trial.
        trial: u64,
        /// The simulator's error.
        source: SimError,
    },
    /// The file or folder of digits cannot be used.
    #[error("{} cannot be used as digits: {reason}", path.display())]
    Digits {
        /// The file or folder.
        path: PathBuf,
        /// What was wrong, and what would be right.
        reason: String,
    },
    /// The collection is not complete.
    #[error(
        "the data set in {path} is unfinished; run the same `foreframe collect` or `foreframe import` again to resume it: {arguments}",
        path = path.display()
    )]
    Unfinished {
        /// The directory.
        path: PathBuf,
        /// The arguments of the collection.
        arguments: String,
    },
    /// Frames with an odd side cannot be stored as video.
    #[error(
        "frames of {width}×{height} px cannot become a video, which needs even sides; export images, or import with another --size"
    )]
    OddFrames {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// A program that is needed is missing or failed.
    #[error("{0}")]
    Program(String),
    /// The episode does not exist.
    #[error("there is no episode {episode} in \"{name}\"; it has {count}, counted from 0")]
    NoEpisode {
        /// The data set's name.
        name: String,
        /// The requested episode.
        episode: usize,
        /// Number of episodes.
        count: usize,
    },
}

impl HasErrorKind for DatasetError {
    fn kind(&self) -> ErrorKind {
        if is_transient(self) {
            return ErrorKind::Away;
        }
        match self {
            Self::World(error) => error.kind(),
            Self::Unknown { .. } | Self::NotADataset { .. } | Self::NoEpisode { .. } => ErrorKind::NotFound,
            Self::Zero { .. }
            | Self::OtherTool { .. }
            | Self::OddFrames { .. }
            | Self::WindowTooLong { .. }
            | Self::TooFewWindows { .. } => ErrorKind::Usage,
            Self::OutExists { .. } | Self::OtherArguments { .. } | Self::Unfinished { .. } => ErrorKind::Conflict,
            Self::PartLength { .. }
            | Self::NotFinite { .. }
            | Self::TimeOrder { .. }
            | Self::MixedMasks { .. }
            | Self::Empty { .. }
            | Self::Description(_)
            | Self::Corrupt { .. }
            | Self::CorruptFrame { .. }
            | Self::HashDiffers { .. }
            | Self::Digits { .. } => ErrorKind::Unusable,
            Self::Busy { .. } => ErrorKind::Busy,
            Self::Cancelled { .. } => ErrorKind::Cancelled,
            Self::Io { .. }
            | Self::FrameFile { .. }
            | Self::Encode(_)
            | Self::Build(_)
            | Self::Simulation { .. }
            | Self::Program(_) => ErrorKind::Internal,
        }
    }
}

impl DatasetError {
    /// Makes a [`DatasetError::Io`] for this action and path.
    pub fn io(action: &'static str, path: &std::path::Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }

    /// Makes a [`DatasetError::Corrupt`] of this file.
    pub(crate) fn corrupt(path: &std::path::Path, reason: &impl ToString) -> Self {
        Self::Corrupt {
            path: path.to_owned(),
            reason: reason.to_string().trim().to_owned(),
        }
    }
}
