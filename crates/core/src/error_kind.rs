//! One classification of errors. The command line's exit codes, HTTP statuses, the error codes of streams and retries follow
//! from it.

use std::error::Error;

/// What an error means for the caller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorKind {
    /// What the caller gave is wrong, or does not fit together.
    Usage,
    /// What the caller names does not exist.
    NotFound,
    /// The request contradicts the present state; it may succeed when that has changed.
    Conflict,
    /// What the caller names exists, but is damaged or does not suit the request.
    Unusable,
    /// Too much is waiting or running; the same request may succeed later.
    Busy,
    /// A store or a file system is not available now; the same request may succeed later.
    Away,
    /// The caller cancelled it.
    Cancelled,
    /// Something failed that the caller cannot change.
    Internal,
}

impl ErrorKind {
    /// The kind of an error in data that the caller did not name: only waiting can help.
    #[must_use]
    pub fn of_own_data(self) -> Self {
        match self {
            Self::Busy | Self::Away => self,
            Self::Usage | Self::NotFound | Self::Conflict | Self::Unusable | Self::Cancelled | Self::Internal => {
                Self::Internal
            }
        }
    }
}

/// An error of a known kind.
pub trait HasErrorKind: Error {
    /// What the error means for the caller.
    fn kind(&self) -> ErrorKind;
}
