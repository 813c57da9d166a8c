//! Errors of data sets.

use std::path::{Path, PathBuf};

use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::files::is_transient;
use foreframe_core::frame::FrameError;
use foreframe_sim::SimError;

/// Why a data set could not be written, read or sampled.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// The description, the content or the source of a data set is invalid; says what is wrong, and what would be right.
    #[error("{0}")]
    Invalid(String),
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
    /// What was asked for cannot be done with any data set, or not with this one; says what would be right.
    #[error("{0}")]
    Usage(String),
    /// No episode is long enough.
    #[error(
        "a window of {} frames (context {context}, horizon {horizon}) is longer than every episode of the {split} split; \
         the longest has {longest} frames without a gap. Record longer, or train with a smaller context or horizon",
        context + horizon
    )]
    WindowTooLong {
        /// Context frames.
        context: usize,
        /// Frames to predict.
        horizon: usize,
        /// The split.
        split: &'static str,
        /// Frames of the longest segment without a gap.
        longest: usize,
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
    /// A frame in a file is not a valid image; says where it is.
    #[error("{0} is damaged")]
    CorruptFrame(String, #[source] FrameError),
    /// A frame could not be encoded.
    #[error("could not encode a frame")]
    Encode(#[from] FrameError),
    /// A table could not be built.
    #[error("could not build a table of the data set")]
    Build(#[from] parquet::errors::ParquetError),
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
    /// There is no such data set; says what there is.
    #[error("{0}")]
    NotFound(String),
    /// The data set in this directory was not written by this program.
    #[error(
        "{path} is a LeRobot data set of another program; make one of Foreframe of it: foreframe import {path} --name NAME",
        path = .0.display()
    )]
    OtherTool(PathBuf),
    /// The directory contains something else.
    #[error("{} exists and is not a collection; use a directory that does not exist or is empty", .0.display())]
    OutExists(PathBuf),
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
    /// Another process is writing to the directory.
    #[error("another collection or import is running in {}; wait until it ends or use another directory", .0.display())]
    Busy(PathBuf),
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
    /// The simulation of this trial failed.
    #[error("could not simulate trial {0}")]
    Simulation(u64, #[source] SimError),
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
    /// A program that is needed is missing or failed.
    #[error("{0}")]
    Program(String),
    /// The episode does not exist; says which there are.
    #[error("{0}")]
    NoEpisode(String),
}

impl HasErrorKind for DatasetError {
    fn kind(&self) -> ErrorKind {
        if is_transient(self) {
            return ErrorKind::Away;
        }
        match self {
            Self::World(error) => error.kind(),
            Self::NotFound(_) | Self::NoEpisode(_) => ErrorKind::NotFound,
            Self::Usage(_) | Self::OtherTool(_) | Self::WindowTooLong { .. } => ErrorKind::Usage,
            Self::OutExists(_) | Self::OtherArguments { .. } | Self::Unfinished { .. } => ErrorKind::Conflict,
            Self::Invalid(_)
            | Self::TimeOrder { .. }
            | Self::Corrupt { .. }
            | Self::CorruptFrame(..)
            | Self::HashDiffers { .. } => ErrorKind::Unusable,
            Self::Busy(_) => ErrorKind::Busy,
            Self::Cancelled { .. } => ErrorKind::Cancelled,
            Self::Io { .. }
            | Self::FrameFile { .. }
            | Self::Encode(_)
            | Self::Build(_)
            | Self::Simulation(..)
            | Self::Program(_) => ErrorKind::Internal,
        }
    }
}

impl DatasetError {
    /// Makes a [`DatasetError::Io`] for this action and path.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }

    /// Makes a [`DatasetError::Corrupt`] of this file.
    pub(crate) fn corrupt(path: &Path, reason: &impl ToString) -> Self {
        Self::Corrupt {
            path: path.to_owned(),
            reason: reason.to_string().trim().to_owned(),
        }
    }

    /// Makes a [`DatasetError::NotFound`] of a directory without a data set.
    pub(crate) fn no_dataset(path: &Path) -> Self {
        Self::NotFound(format!(
            "{} holds no data set (meta/info.json is missing); give a directory that `foreframe collect` or `foreframe \
             import` wrote; `foreframe import` makes a data set of a recording",
            path.display()
        ))
    }
}
