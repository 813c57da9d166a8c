//! What an error of an import means for the caller.

use std::io;

use super::ImportError;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::files::is_transient;

/// Errors of reading that say something about the recording, not about the machine.
const DAMAGED_INPUT: [io::ErrorKind; 6] = [
    io::ErrorKind::NotFound,
    io::ErrorKind::NotADirectory,
    io::ErrorKind::IsADirectory,
    io::ErrorKind::InvalidInput,
    io::ErrorKind::InvalidData,
    io::ErrorKind::UnexpectedEof,
];

impl HasErrorKind for ImportError {
    fn kind(&self) -> ErrorKind {
        if is_transient(self) {
            return ErrorKind::Away;
        }
        match self {
            Self::Dataset(error) => error.kind(),
            Self::UnknownSource(_)
            | Self::Option(_)
            | Self::OptionValue { .. }
            | Self::Record { .. }
            | Self::Image { .. }
            | Self::Disk { .. }
            | Self::Empty(_) => ErrorKind::Usage,
            Self::OutExists { .. } => ErrorKind::Conflict,
            Self::Io { source, .. } if DAMAGED_INPUT.contains(&source.kind()) => ErrorKind::Usage,
            Self::Cancelled { .. } | Self::Stopped => ErrorKind::Cancelled,
            Self::Io { .. } | Self::Program(_) => ErrorKind::Internal,
        }
    }
}
