//! Trained models on disk, one directory each: `NAME/model.safetensors` (weights, f16) and `NAME/manifest.json` (what they
//! are and how they were made). [`manifest`] describes one, [`loader`] verifies and builds it; here they are listed, found
//! and published.

pub mod loader;
pub mod manifest;

use std::path::{Path, PathBuf};

pub use self::loader::{LoadedModel, load};
pub use self::manifest::{DatasetStamp, Manifest, ProgramStamp};
use crate::files::{sha256_hex, write_atomically};
use crate::nn::Parameters;
use crate::wording::those;

/// The weights' file in a model's directory.
pub const WEIGHTS_FILE: &str = "model.safetensors";
/// The manifest's file in a model's directory.
pub const MANIFEST_FILE: &str = "manifest.json";

/// Why a model could not be listed, loaded or published.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RegistryError {
    /// There is no model of that name.
    #[error("there is no model {name:?} in {}; there {}", dir.display(), those(known))]
    Unknown {
        /// The name asked for.
        name: String,
        /// Where it was looked for.
        dir: PathBuf,
        /// The names there are.
        known: Vec<String>,
    },
    /// A name that could leave the directory or confuse a shell.
    #[error("{0:?} is no model name; use 1 to 64 of a–z, 0–9 and '-', starting with a letter or digit")]
    Name(String),
    /// The path leads to no model.
    #[error("{} holds no model ({MANIFEST_FILE} is missing); name one that `foreframe train` made", .0.display())]
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
    /// The manifest isn't one.
    #[error("{} is no model manifest: {source}", path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
        /// Where it went wrong.
        source: serde_json::Error,
    },
    /// The weights are not those that the manifest names.
    #[error("{} has SHA-256 {found}, its manifest says {expected}: fetch the model again or train it anew", path.display())]
    Hash {
        /// The weights' file.
        path: PathBuf,
        /// As computed.
        found: String,
        /// As the manifest says.
        expected: String,
    },
    /// The weights don't fit the manifest's spec.
    #[error("the weights of {} do not fit their manifest: {source}", path.display())]
    Weights {
        /// The weights' file.
        path: PathBuf,
        /// What does not fit.
        source: crate::nn::NnError,
    },
    /// The weights' file is damaged.
    #[error("{} is no safetensors file: {source}", path.display())]
    Safetensors {
        /// The weights' file.
        path: PathBuf,
        /// Where it went wrong.
        source: candle_core::Error,
    },
}

/// Whether the name is safe as a directory's and in an address: 1 to 64 of a–z, 0–9 and '-', not starting with '-'.
#[must_use]
pub fn is_valid_name(name: &str) -> bool {
    let bytes = name.as_bytes();
    (1..=64).contains(&bytes.len())
        && bytes[0] != b'-'
        && bytes.iter().all(|b| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'-'))
}

/// The models in a directory, by name, sorted. An absent directory holds none. Errors: `Io` if it can't be listed.
pub fn list(models_dir: &Path) -> Result<Vec<(String, PathBuf)>, RegistryError> {
    if !models_dir.exists() {
        return Ok(Vec::new());
    }
    let unlisted = |source| RegistryError::Io {
        action: "list",
        path: models_dir.to_owned(),
        source,
    };
    let mut models = Vec::new();
    for entry in std::fs::read_dir(models_dir).map_err(unlisted)? {
        let path = entry.map_err(unlisted)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if is_valid_name(&name) && path.join(MANIFEST_FILE).is_file() {
            models.push((name, path));
        }
    }
    models.sort();
    Ok(models)
}

/// The directory of the model of that name. Errors: `Name`, `Unknown` with the names there are.
pub fn find(models_dir: &Path, name: &str) -> Result<PathBuf, RegistryError> {
    if !is_valid_name(name) {
        return Err(RegistryError::Name(name.to_owned()));
    }
    let path = models_dir.join(name);
    if path.join(MANIFEST_FILE).is_file() {
        return Ok(path);
    }
    let known = list(models_dir)?.into_iter().map(|(name, _)| name).collect();
    Err(RegistryError::Unknown {
        name: name.to_owned(),
        dir: models_dir.to_owned(),
        known,
    })
}

/// The directory of the model called `what`: a path that leads to one, or else a name below `models_dir`.
/// Errors: those of [`find`], `NotAModel`.
pub fn locate(models_dir: &Path, what: &str) -> Result<PathBuf, RegistryError> {
    let given = Path::new(what);
    if given.join(MANIFEST_FILE).is_file() {
        return Ok(given.to_owned());
    }
    if !is_valid_name(what) && (what.contains('/') || given.exists()) {
        return Err(RegistryError::NotAModel(given.to_owned()));
    }
    find(models_dir, what)
}

/// Writes weights (as f16) and manifest into `model_dir`, the manifest last and with the weights' hash filled in.
pub fn publish(model_dir: &Path, parameters: &Parameters, manifest: &Manifest) -> Result<Manifest, RegistryError> {
    let weights_path = model_dir.join(WEIGHTS_FILE);
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| RegistryError::Io {
            action: "write",
            path,
            source,
        }
    };
    std::fs::create_dir_all(model_dir).map_err(failed(model_dir))?;
    let weights = loader::serialize_f16(parameters).map_err(|source| RegistryError::Weights {
        path: weights_path.clone(),
        source,
    })?;
    let manifest = Manifest {
        weights_sha256: sha256_hex(&weights),
        ..manifest.clone()
    };
    write_atomically(&weights_path, &weights).map_err(failed(&weights_path))?;
    write_manifest(model_dir, &manifest)?;
    Ok(manifest)
}

/// Replaces the metrics of a model's manifest, for example by those that an evaluation measured.
pub fn record_metrics(model_dir: &Path, metrics: serde_json::Value) -> Result<(), RegistryError> {
    let mut manifest = manifest::read(model_dir)?;
    manifest.metrics = metrics;
    write_manifest(model_dir, &manifest)
}

/// Writes the manifest into a model's directory. Errors: `Manifest`, `Io`.
pub fn write_manifest(model_dir: &Path, manifest: &Manifest) -> Result<(), RegistryError> {
    let path = model_dir.join(MANIFEST_FILE);
    let mut text = serde_json::to_string_pretty(manifest).map_err(|source| RegistryError::Manifest {
        path: path.clone(),
        source,
    })?;
    text.push('\n');
    write_atomically(&path, text.as_bytes()).map_err(|source| RegistryError::Io {
        action: "write",
        path,
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_leaves_the_directory_is_refused() {
        for name in ["../paper", "", "-x", "Paper", "a/b", "a b", "ä"] {
            assert!(!is_valid_name(name), "{name:?} was accepted");
        }
        assert!(is_valid_name("moving-2"));
    }

    #[test]
    fn an_unknown_model_is_answered_with_the_names_there_are() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("paper")).unwrap();
        std::fs::write(dir.path().join("paper").join(MANIFEST_FILE), "{}").unwrap();
        let error = find(dir.path(), "papper").unwrap_err().to_string();
        assert!(
            error.contains("no model \"papper\"") && error.ends_with("there are: paper"),
            "{error}"
        );
    }
}
