//! Errors of imports: what they mean for the caller, and which of them are damage that may be left out.

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};

use super::skipped::{SkippedItem, SkippedList, moved_text};
use crate::dataset::error::DatasetError;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::files::is_transient;
use foreframe_core::frame::FrameError;

/// Errors of reading that say something about the recording, not about the machine.
const DAMAGED_INPUT: [io::ErrorKind; 6] = [
    io::ErrorKind::NotFound,
    io::ErrorKind::NotADirectory,
    io::ErrorKind::IsADirectory,
    io::ErrorKind::InvalidInput,
    io::ErrorKind::InvalidData,
    io::ErrorKind::UnexpectedEof,
];

/// Why a recording could not be imported: file and place, what was wrong, what would be right.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// The source is of no known kind.
    #[error(
        "{} is not a recording that can be imported; give a folder of PNG or JPEG images (with or without a CSV), a \
         Donkeycar tub (manifest.json), a LeRobot data set (meta/info.json), a bag of ROS 2 (.mcap, .db3 or its directory), a .npy \
         or .npz file, a video (.mp4, .mkv, .avi, .mov, .webm), or an archive of one of these (.zip, .tar, .tar.gz)",
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
        source: io::Error,
    },
    /// An archive cannot or may not be unpacked.
    #[error("the archive {} {reason}", archive.display())]
    Archive {
        /// The archive.
        archive: PathBuf,
        /// What is wrong with it or with a file in it.
        reason: String,
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
    /// What is left to import are single frames.
    #[error(
        "{} holds no two consecutive frames, since something was left out {left_out} times; a data set needs frames that follow \
         each other. The first that was left out: {first}",
        path.display()
    )]
    Scattered {
        /// The recording.
        path: PathBuf,
        /// How many items or runs of items were left out.
        left_out: u64,
        /// The first of them, and why.
        first: String,
    },
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

impl HasErrorKind for ImportError {
    fn kind(&self) -> ErrorKind {
        if is_transient(self) {
            return ErrorKind::Away;
        }
        match self {
            Self::Dataset(error) => error.kind(),
            Self::OutExists { .. } => ErrorKind::Conflict,
            Self::Cancelled { .. } | Self::Stopped => ErrorKind::Cancelled,
            Self::Program(_) => ErrorKind::Internal,
            Self::Io { source, .. } if !DAMAGED_INPUT.contains(&source.kind()) => ErrorKind::Internal,
            // Something is wrong with the recording or an option.
            _ => ErrorKind::Usage,
        }
    }
}

impl ImportError {
    pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }

    pub(super) fn image(place: &str, path: impl Into<PathBuf>) -> impl FnOnce(FrameError) -> Self {
        let (place, path) = (place.to_owned(), path.into());
        move |source| Self::Image { place, path, source }
    }

    pub(super) fn record(place: impl Display, reason: impl Display) -> Self {
        Self::Record {
            place: place.to_string(),
            reason: reason.to_string(),
        }
    }

    /// The same error with the paths below one folder as paths below another.
    pub(super) fn moved(self, from: &Path, to: &Path) -> Self {
        let moved = |path: PathBuf| match path.strip_prefix(from) {
            Ok(rest) if rest.as_os_str().is_empty() => to.to_owned(),
            Ok(rest) => to.join(rest),
            Err(_) => path,
        };
        let text = |text: String| moved_text(&text, from, to);
        match self {
            Self::UnknownSource(path) => Self::UnknownSource(moved(path)),
            Self::Option(reason) => Self::Option(text(reason)),
            Self::Program(reason) => Self::Program(text(reason)),
            Self::Empty(path) => Self::Empty(moved(path)),
            Self::Scattered { path, left_out, first } => Self::Scattered {
                path: moved(path),
                left_out,
                first: text(first),
            },
            Self::Io { action, path, source } => Self::Io {
                action,
                path: moved(path),
                source,
            },
            Self::Record { place, reason } => Self::Record {
                place: text(place),
                reason: text(reason),
            },
            Self::Image { place, path, source } => Self::Image {
                place: text(place),
                path: moved(path),
                source,
            },
            other => other,
        }
    }

    /// Lists what is damaged, if it may be left out. Errors: itself, if not, or if it is no damage of a single item.
    pub(super) fn leave_out(self, skip_bad: bool, skipped: &mut SkippedList) -> Result<(), Self> {
        skipped.push(match &self {
            Self::Record { place, reason } if skip_bad => SkippedItem::new(place, reason),
            Self::Image { place, path, source } if skip_bad => {
                SkippedItem::new(place, &format!("{} is damaged: {source}", path.display()))
            }
            _ => return Err(self),
        });
        Ok(())
    }
}
