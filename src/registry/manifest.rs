//! What a trained model says of itself.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{MANIFEST_FILE, RegistryError};
use crate::nn::ModelSpec;
use crate::types::Seed;

/// The largest manifest that is read, in bytes.
const MAX_MANIFEST_BYTES: u64 = 1 << 20;

/// A model's description: what it takes and gives, where it comes from, how good it was.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// The model's name.
    pub name: String,
    /// Counts the publications of this name, from 1.
    pub version: u32,
    /// Dimensions, units, preprocessing.
    pub spec: ModelSpec,
    /// SHA-256 of the weights' file, hexadecimal; filled in when published.
    pub weights_sha256: String,
    /// What it was trained on.
    pub dataset: DatasetStamp,
    /// The seed of its training.
    pub seed: Seed,
    /// The command line that made it.
    pub command: String,
    /// The whole training configuration.
    pub training: serde_json::Value,
    /// Scores, by name: of validation when trained, of the test sets once evaluated.
    pub metrics: serde_json::Value,
    /// Trained numbers.
    pub parameters: u64,
    /// Multiply–adds to predict one frame, the context's encoding shared out.
    pub multiply_adds_per_frame: u64,
    /// The program that trained it.
    pub program: ProgramStamp,
}

/// The data set that a model was trained on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetStamp {
    /// Its name.
    pub name: String,
    /// SHA-256 of its content.
    pub content_hash: String,
    /// The scenario that was simulated, if one was.
    pub scenario: Option<String>,
    /// Windows trained on.
    pub windows: usize,
    /// The seed of the split into training, validation and test.
    pub split_seed: Seed,
}

/// Which program wrote a file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProgramStamp {
    /// Its version.
    pub version: String,
    /// The commit that it was built from, where known.
    pub git_commit: Option<String>,
}

impl ProgramStamp {
    /// This program.
    #[must_use]
    pub fn current() -> Self {
        let commit = env!("GIT_COMMIT_AT_BUILD");
        Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            git_commit: (!commit.is_empty()).then(|| commit.to_owned()),
        }
    }
}

/// Reads the manifest in a model's directory. Errors: `Io`, `Manifest`.
pub fn read(model_dir: &Path) -> Result<Manifest, RegistryError> {
    let path = model_dir.join(MANIFEST_FILE);
    let failed = |source| RegistryError::Io {
        action: "read",
        path: path.clone(),
        source,
    };
    let size = std::fs::metadata(&path).map_err(failed)?.len();
    if size > MAX_MANIFEST_BYTES {
        let source = std::io::Error::other(format!("{size} bytes, over the limit of {MAX_MANIFEST_BYTES}"));
        return Err(RegistryError::Io {
            action: "read",
            path,
            source,
        });
    }
    let text = std::fs::read(&path).map_err(failed)?;
    serde_json::from_slice(&text).map_err(|source| RegistryError::Manifest { path, source })
}
