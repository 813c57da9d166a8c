//! Why a model could not be listed, loaded or published.

use std::path::{Path, PathBuf};

use super::layout::MANIFEST_FILE;
use crate::error_kind::{ErrorKind, HasErrorKind};
use crate::error_text::existing;
use crate::files::is_transient;
use crate::types::ModelName;

/// Why a model could not be listed, loaded or published.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RegistryError {
    /// No model has this name.
    #[error("there is no model {name:?} in {}; there {}", dir.display(), existing(known))]
    Unknown {
        /// The name asked for.
        name: ModelName,
        /// The directory that was searched.
        dir: PathBuf,
        /// The names of the existing models.
        known: Vec<ModelName>,
    },
    /// The name is not safe as a directory name or in a URL.
    #[error("{0:?} is not a valid model name; use 1 to 64 of a–z, 0–9 and '-', starting with a letter or digit")]
    Name(String),
    /// The directory contains no model.
    #[error("{} holds no model ({MANIFEST_FILE} is missing); give a directory that `foreframe train` wrote", .0.display())]
    NotAModel(PathBuf),
    /// A file could not be read or written.
    #[error("could not {action} {}: {source}", path.display())]
    Io {
        /// `read`, `write` or `list`.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The manifest cannot be parsed.
    #[error("{} is not a valid model manifest: {source}", path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
        /// The parser's error.
        source: serde_json::Error,
    },
    /// A value in the manifest is out of range.
    #[error("{} is not a valid model manifest: {reason}", path.display())]
    ManifestValue {
        /// The file.
        path: PathBuf,
        /// Which value, and what it must be.
        reason: String,
    },
    /// The weights file has another hash than the manifest states.
    #[error("{} has SHA-256 {found}, but its manifest states {expected}; download the model or train it again", path.display())]
    Hash {
        /// The weights file.
        path: PathBuf,
        /// Hash of the file.
        found: String,
        /// Hash in the manifest.
        expected: String,
    },
    /// The weights do not match the model specification in the manifest.
    #[error(
        "the weights of {} do not match their manifest: {source}; use the version of Foreframe that trained the model, or train it again",
        path.display()
    )]
    Weights {
        /// The weights file.
        path: PathBuf,
        /// What does not match.
        source: crate::nn::NnError,
    },
    /// The model cannot be computed on the chosen device.
    #[doc(hidden)]
    #[error(transparent)]
    Device(crate::nn::NnError),
    /// The weights file is damaged.
    #[error("{} is not a valid safetensors file: {source}", path.display())]
    Safetensors {
        /// The weights file.
        path: PathBuf,
        /// The reader's error.
        source: crate::nn::TensorError,
    },
}

impl RegistryError {
    /// Makes a [`RegistryError::Io`] of a failed `read`, `write` or `list`.
    pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}

impl HasErrorKind for RegistryError {
    fn kind(&self) -> ErrorKind {
        if is_transient(self) {
            return ErrorKind::Away;
        }
        match self {
            Self::Unknown { .. } => ErrorKind::NotFound,
            Self::Name(_) | Self::NotAModel(_) | Self::Device(_) => ErrorKind::Usage,
            Self::Manifest { .. }
            | Self::ManifestValue { .. }
            | Self::Hash { .. }
            | Self::Weights { .. }
            | Self::Safetensors { .. } => ErrorKind::Unusable,
            Self::Io { .. } => ErrorKind::Internal,
        }
    }
}
