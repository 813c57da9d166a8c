//! Why a subcommand ended: the user's input cannot be carried out, or something failed. The exit code follows from the kind
//! of the error.

use std::error::Error;
use std::io;
use std::path::Path;
use std::process::ExitCode;

use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::error_text;
use foreframe_train::evaluation::EvaluationError;

/// Why a subcommand ended, as a sentence for the user.
pub(super) enum CliError {
    /// The arguments, or what they name, cannot be used.
    Usage(String),
    /// Something failed.
    Failed(String),
    /// The user interrupted it; finished work is kept.
    Interrupted(String),
    /// Nobody reads its output any more, as after `| head -1`.
    OutputClosed,
}

impl CliError {
    /// A failure with its causes.
    pub(super) fn failed(error: impl Error) -> Self {
        Self::Failed(error_text::with_causes(&error))
    }

    /// The calibration failed, or was interrupted, which is no failure.
    pub(super) fn not_calibrated(error: EvaluationError) -> Self {
        match error {
            EvaluationError::Cancelled => Self::Interrupted("stopped; the model has no new calibration".to_owned()),
            other => other.into(),
        }
    }

    /// A file that cannot be used: `Usage` if the path leads to nothing of the right kind.
    pub(super) fn io(action: &str, path: &Path, source: &io::Error) -> Self {
        let sentence = format!("could not {action} {}: {source}", path.display());
        match source.kind() {
            io::ErrorKind::NotFound
            | io::ErrorKind::NotADirectory
            | io::ErrorKind::IsADirectory
            | io::ErrorKind::AlreadyExists => Self::Usage(sentence),
            _ => Self::Failed(sentence),
        }
    }

    /// The line for standard error and the exit code: 2 for `Usage`, 1 for `Failed`, 130 for `Interrupted`. None if there is
    /// nothing to report.
    pub(super) fn report(&self) -> Option<(String, ExitCode)> {
        match self {
            Self::Usage(sentence) => Some((format!("error: {sentence}"), ExitCode::from(2))),
            Self::Failed(sentence) => Some((format!("error: {sentence}"), ExitCode::from(1))),
            Self::Interrupted(sentence) => Some((sentence.clone(), ExitCode::from(130))),
            Self::OutputClosed => None,
        }
    }
}

impl<E: HasErrorKind> From<E> for CliError {
    fn from(error: E) -> Self {
        let sentence = error_text::with_causes(&error);
        match error.kind() {
            ErrorKind::Usage | ErrorKind::NotFound | ErrorKind::Conflict => Self::Usage(sentence),
            ErrorKind::Cancelled => Self::Interrupted(sentence),
            ErrorKind::Unusable | ErrorKind::Busy | ErrorKind::Away | ErrorKind::Internal => Self::Failed(sentence),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("an error")]
    struct ErrorOfKind(ErrorKind);

    impl HasErrorKind for ErrorOfKind {
        fn kind(&self) -> ErrorKind {
            self.0
        }
    }

    #[test]
    fn the_way_a_command_ends_follows_from_the_kind() {
        for kind in [ErrorKind::Usage, ErrorKind::NotFound, ErrorKind::Conflict] {
            assert!(matches!(CliError::from(ErrorOfKind(kind)), CliError::Usage(_)));
        }
        for kind in [
            ErrorKind::Unusable,
            ErrorKind::Busy,
            ErrorKind::Away,
            ErrorKind::Internal,
        ] {
            assert!(matches!(CliError::from(ErrorOfKind(kind)), CliError::Failed(_)));
        }
        let cancelled = CliError::from(ErrorOfKind(ErrorKind::Cancelled));
        assert!(matches!(cancelled, CliError::Interrupted(_)));
    }
}
