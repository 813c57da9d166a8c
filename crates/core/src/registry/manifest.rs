//! The manifest: the description of a trained model.

use std::path::Path;
use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

use super::calibration::Calibration;
use super::embedded;
use super::error::RegistryError;
use super::layout::MANIFEST_FILE;
use crate::nn::ModelSpec;
use crate::types::{ModelName, Seed};

/// The largest manifest that is accepted, in bytes.
const MAX_MANIFEST_BYTES: u64 = 1 << 20;

static GIT_COMMIT: OnceLock<&'static str> = OnceLock::new();

/// A model's description: its inputs and outputs, its origin and its scores.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// The model's name.
    pub name: ModelName,
    /// The version of this model name, counted from 1.
    pub version: u32,
    /// Dimensions, channels and preprocessing.
    pub spec: ModelSpec,
    /// SHA-256 of the weights file in hexadecimal; filled in when the model is published.
    pub weights_sha256: String,
    /// The data set of the training.
    pub dataset: DatasetStamp,
    /// The seed of the training.
    pub seed: Seed,
    /// The command line of the training.
    pub command: String,
    /// The complete training configuration.
    pub training: serde_json::Value,
    /// Scores by name: of the validation split after training, of the test splits after an evaluation.
    pub metrics: serde_json::Value,
    /// What the validation split says about the errors of its predictions; absent if the model was never calibrated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<Calibration>,
    /// Number of trained parameters.
    pub parameters: u64,
    /// Multiply–add operations per predicted frame. The cost of encoding the context is divided by the horizon.
    pub multiply_adds_per_frame: u64,
    /// The program that trained it.
    pub program: ProgramStamp,
}

/// The data set on which a model was trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetStamp {
    /// Its title: any text, also the names of several data sets.
    pub name: String,
    /// SHA-256 of its content.
    pub content_hash: String,
    /// The simulated scenario; none for recordings.
    pub scenario: Option<String>,
    /// Number of training windows.
    pub windows: usize,
    /// The seed of the split into training, validation and test parts.
    pub split_seed: Seed,
    /// The data sets that were joined; none if it is a single one.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub parts: Vec<DatasetShare>,
    /// Marks of a sample of the training frames, also of those of the model that the training started from, in increasing order: the
    /// 512 smallest of all. A frame's mark is the first 6 bytes of the SHA-256 of its pixels. None in models of earlier programs, and in
    /// those whose training started from one.
    #[doc(hidden)]
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub frame_marks: Vec<u64>,
}

impl DatasetStamp {
    /// Whether the model was trained on the data set with this content, alone or among others.
    #[must_use]
    pub fn includes(&self, content_hash: &str) -> bool {
        self.content_hash == content_hash || self.parts.iter().any(|part| part.content_hash == content_hash)
    }
}

/// One of several data sets on which a model was trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetShare {
    /// Its title: any text.
    pub name: String,
    /// SHA-256 of its content.
    pub content_hash: String,
    /// The simulated scenario; none for recordings.
    pub scenario: Option<String>,
    /// Number of training windows.
    pub windows: usize,
    /// Its share of the windows that the training drew, 0 to 1.
    pub share: f64,
}

/// Version of the program that wrote a file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProgramStamp {
    /// Its version.
    pub version: String,
    /// The Git commit from which it was built, if known.
    pub git_commit: Option<String>,
}

impl ProgramStamp {
    /// The version of this program.
    #[must_use]
    pub fn current() -> Self {
        Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            git_commit: GIT_COMMIT.get().map(|&commit| commit.to_owned()),
        }
    }
}

/// Sets the commit that [`ProgramStamp::current`] tells from now on. The first call counts.
pub fn set_git_commit(commit: &'static str) {
    let _ = GIT_COMMIT.set(commit);
}

/// Reads the manifest in a model's directory. Errors: `Io`, `Manifest`.
pub fn read(model_dir: &Path) -> Result<Manifest, RegistryError> {
    let text = embedded::read_manifest(model_dir, MAX_MANIFEST_BYTES)?;
    serde_json::from_slice(&text).map_err(|source| RegistryError::Manifest {
        path: model_dir.join(MANIFEST_FILE),
        source,
    })
}
