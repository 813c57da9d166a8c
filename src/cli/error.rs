//! Why a subcommand ended: the user's input cannot be carried out, or something failed.

use std::error::Error;
use std::io::{self, ErrorKind};
use std::path::Path;
use std::process::ExitCode;

use crate::dataset::DatasetError;
use crate::error_text;
use crate::evaluation::EvaluationError;
use crate::nn::NnError;
use crate::registry::RegistryError;
use crate::serving::ServingError;
use crate::sim::SimError;
use crate::telemetry::TelemetryError;
use crate::training::TrainError;

/// Why a subcommand ended, as a sentence for the user.
pub(super) enum CliError {
    /// The arguments, or what they name, cannot be used.
    Usage(String),
    /// Something failed.
    Failed(String),
    /// The user interrupted it; finished work is kept.
    Interrupted(String),
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
            ErrorKind::NotFound | ErrorKind::NotADirectory | ErrorKind::IsADirectory | ErrorKind::AlreadyExists => {
                Self::Usage(sentence)
            }
            _ => Self::Failed(sentence),
        }
    }

    /// The line for standard error and the exit code: 2 for `Usage`, 1 for `Failed`, 130 for `Interrupted`.
    pub(super) fn report(&self) -> (String, ExitCode) {
        match self {
            Self::Usage(sentence) => (format!("error: {sentence}"), ExitCode::from(2)),
            Self::Failed(sentence) => (format!("error: {sentence}"), ExitCode::from(1)),
            Self::Interrupted(sentence) => (sentence.clone(), ExitCode::from(130)),
        }
    }
}

/// An error that knows whether the user's input caused it.
pub(super) trait UsageError: Error {
    /// Whether the arguments are wrong, or what they name does not fit together.
    fn is_usage(&self) -> bool;
}

impl<E: UsageError> From<E> for CliError {
    fn from(error: E) -> Self {
        let sentence = error_text::with_causes(&error);
        if error.is_usage() {
            Self::Usage(sentence)
        } else {
            Self::Failed(sentence)
        }
    }
}

impl UsageError for TelemetryError {
    fn is_usage(&self) -> bool {
        true
    }
}

impl UsageError for SimError {
    fn is_usage(&self) -> bool {
        matches!(
            self,
            Self::UnknownScenario { .. } | Self::UnknownLook { .. } | Self::FrameSize { .. } | Self::Setting { .. }
        )
    }
}

impl UsageError for DatasetError {
    fn is_usage(&self) -> bool {
        match self {
            Self::World(error) => error.is_usage(),
            Self::Zero { .. }
            | Self::OutExists { .. }
            | Self::OtherArguments { .. }
            | Self::Unknown { .. }
            | Self::NotADataset { .. }
            | Self::OtherTool { .. }
            | Self::Unfinished { .. }
            | Self::FrameSize { .. }
            | Self::OddFrames { .. }
            | Self::Channels { .. }
            | Self::WindowTooLong { .. }
            | Self::TooFewWindows { .. } => true,
            _ => false,
        }
    }
}

impl UsageError for RegistryError {
    fn is_usage(&self) -> bool {
        matches!(self, Self::Unknown { .. } | Self::Name(_) | Self::NotAModel(_))
    }
}

impl UsageError for TrainError {
    fn is_usage(&self) -> bool {
        match self {
            Self::UnknownPreset(_)
            | Self::Config(_)
            | Self::NotARun(_)
            | Self::OtherRun { .. }
            | Self::ConstantActions { .. }
            | Self::OtherUnits { .. }
            | Self::NoWindows { .. } => true,
            Self::Dataset(error) => error.is_usage(),
            Self::Registry(error) => error.is_usage(),
            // The network's sizes come from the settings.
            Self::Network(error) => matches!(error, NnError::OutOfRange { .. } | NnError::NoChannels { .. }),
            _ => false,
        }
    }
}

impl UsageError for EvaluationError {
    fn is_usage(&self) -> bool {
        match self {
            Self::FrameSize { .. }
            | Self::FramePeriod { .. }
            | Self::Channels { .. }
            | Self::SplitSeed { .. }
            | Self::Twin { .. }
            | Self::Setting { .. }
            | Self::NothingHeldOut { .. }
            | Self::NotCalibrated { .. }
            | Self::NoContext { .. }
            | Self::OutputExists(_) => true,
            Self::Dataset(error) => error.is_usage(),
            Self::Registry(error) => error.is_usage(),
            _ => false,
        }
    }
}

impl UsageError for ServingError {
    fn is_usage(&self) -> bool {
        matches!(self, Self::Input(_))
    }
}
