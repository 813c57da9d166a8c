//! Trained models on disk. Each model has a directory with `model.safetensors` (weights, f16) and `manifest.json`
//! (description and origin). In a directory of models, the name of a model's directory is its name, whatever the manifest
//! says. [`manifest`] describes a model, [`loader`] verifies and builds it. This module lists, finds and publishes models.

pub mod calibration;
mod embedded;
mod error;
mod layout;
pub mod loader;
pub mod manifest;

use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

pub use self::calibration::Calibration;
pub use self::embedded::{EmbeddedModel, embed};
pub use self::error::RegistryError;
pub use self::layout::{MANIFEST_FILE, WEIGHTS_FILE};
pub use self::loader::{Model, StoredWeights, load, load_as, load_weights};
pub use self::manifest::{DatasetShare, DatasetStamp, Manifest, ProgramStamp, set_git_commit};
use crate::files::{sha256_hex, write_atomically};
use crate::nn::Parameters;
use crate::types::ModelName;

/// Names and directories of the models in a directory, sorted by name. A missing directory contains none; if it is the
/// default one, the embedded model stands in for it. Errors: `Io` if the directory cannot be listed.
pub fn list(models_dir: &Path) -> Result<Vec<(ModelName, PathBuf)>, RegistryError> {
    let paths = directories(models_dir)?.into_iter();
    let mut models: Vec<_> = paths
        .filter_map(|path| Some((directory_name(&path).ok()?, path)))
        .chain(embedded::in_place_of(models_dir))
        .collect();
    models.sort();
    Ok(models)
}

/// The directories that hold a model but have no valid name, sorted, each with its error: [`list`] leaves them out.
/// Errors: `Io`.
pub fn misnamed(models_dir: &Path) -> Result<Vec<(PathBuf, RegistryError)>, RegistryError> {
    let misnamed = |path: PathBuf| directory_name(&path).err().map(|error| (path, error));
    Ok(directories(models_dir)?.into_iter().filter_map(misnamed).collect())
}

/// The directories that hold a model, sorted; an absent directory of models holds none. Errors: `Io`.
fn directories(models_dir: &Path) -> Result<Vec<PathBuf>, RegistryError> {
    if !models_dir.exists() {
        return Ok(Vec::new());
    }
    let mut paths: Vec<PathBuf> = std::fs::read_dir(models_dir)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect())
        .map_err(RegistryError::io("list", models_dir))?;
    paths.retain(|path| path.join(MANIFEST_FILE).is_file());
    paths.sort();
    Ok(paths)
}

/// The name of the model in this directory. Errors: `Name`.
fn directory_name(path: &Path) -> Result<ModelName, RegistryError> {
    model_name(&path.file_name().unwrap_or_default().to_string_lossy())
}

/// The text as the name of a model. Errors: `Name`.
pub fn model_name(text: &str) -> Result<ModelName, RegistryError> {
    text.parse().map_err(|_| RegistryError::Name(text.to_owned()))
}

/// The directory of the model with this name. Errors: `Unknown` with the existing names.
pub fn find(models_dir: &Path, name: &ModelName) -> Result<PathBuf, RegistryError> {
    let path = models_dir.join(name);
    if path.join(MANIFEST_FILE).is_file() {
        return Ok(path);
    }
    if let Some((_, path)) = embedded::in_place_of(models_dir).filter(|(embedded, _)| embedded == name) {
        return Ok(path);
    }
    let known = list(models_dir)?.into_iter().map(|(name, _)| name).collect();
    Err(RegistryError::Unknown {
        name: name.clone(),
        dir: models_dir.to_owned(),
        known,
    })
}

/// The directory of a model that the user gave as a path; none if the text can only be a name. Errors: `NotAModel` for a
/// path without a model.
pub fn directory_of(model: &str) -> Result<Option<PathBuf>, RegistryError> {
    let path = Path::new(model);
    if path.join(MANIFEST_FILE).is_file() {
        return Ok(Some(path.to_owned()));
    }
    if model_name(model).is_err() && (model.contains('/') || path.exists()) {
        return Err(RegistryError::NotAModel(path.to_owned()));
    }
    Ok(None)
}

/// Writes the weights (as f16) and then the manifest into `model_dir`. Fills in the weights' hash and returns the manifest.
/// Errors: `Weights`, `Manifest`, `Io`.
pub fn publish(model_dir: &Path, parameters: &Parameters, manifest: &Manifest) -> Result<Manifest, RegistryError> {
    let weights_path = model_dir.join(WEIGHTS_FILE);
    std::fs::create_dir_all(model_dir).map_err(RegistryError::io("write", model_dir))?;
    let weights = loader::serialize_f16(parameters).map_err(|source| RegistryError::Weights {
        path: weights_path.clone(),
        source,
    })?;
    let manifest = Manifest {
        weights_sha256: sha256_hex(&weights),
        ..manifest.clone()
    };
    write_atomically(&weights_path, &weights).map_err(RegistryError::io("write", &weights_path))?;
    write_manifest(model_dir, &manifest)?;
    Ok(manifest)
}

/// Writes metrics into a model's manifest, for example the results of an evaluation. Other metrics stay; a metric given as
/// null is removed (JSON merge patch, RFC 7396). Errors: `Manifest`, `Io`.
pub fn record_metrics(model_dir: &Path, metrics: Value) -> Result<(), RegistryError> {
    let mut manifest = manifest::read(model_dir)?;
    merge(&mut manifest.metrics, metrics);
    write_manifest(model_dir, &manifest)
}

/// Writes a calibration into a model's manifest, in place of an earlier one. Errors: `Manifest`, `Io`.
pub fn record_calibration(model_dir: &Path, calibration: Calibration) -> Result<(), RegistryError> {
    let mut manifest = manifest::read(model_dir)?;
    manifest.calibration = Some(calibration);
    write_manifest(model_dir, &manifest)
}

fn merge(target: &mut Value, patch: Value) {
    let Value::Object(patch) = patch else {
        *target = patch;
        return;
    };
    let mut merged = match target.take() {
        Value::Object(object) => object,
        _ => Map::new(),
    };
    for (key, value) in patch {
        if value.is_null() {
            merged.remove(&key);
        } else {
            merge(merged.entry(key).or_insert(Value::Null), value);
        }
    }
    *target = Value::Object(merged);
}

/// Writes the manifest into a model's directory. Errors: `Manifest`, `Io`.
pub fn write_manifest(model_dir: &Path, manifest: &Manifest) -> Result<(), RegistryError> {
    let path = model_dir.join(MANIFEST_FILE);
    let mut text = serde_json::to_string_pretty(manifest).map_err(|source| RegistryError::Manifest {
        path: path.clone(),
        source,
    })?;
    text.push('\n');
    write_atomically(&path, text.as_bytes()).map_err(RegistryError::io("write", &path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recording_test_scores_keeps_the_validation_score() {
        let mut metrics = serde_json::json!({"validation": {"mse": 1, "step": 7}, "test": {"mse": 2}, "old": 3});
        merge(
            &mut metrics,
            serde_json::json!({"test": {"mse": 4}, "validation": {"mse": 5}, "old": null}),
        );
        let expected = serde_json::json!({"validation": {"mse": 5, "step": 7}, "test": {"mse": 4}});
        assert_eq!(metrics, expected);
    }

    #[test]
    fn a_directory_with_an_invalid_name_is_reported() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["my_model", "paper"] {
            std::fs::create_dir(dir.path().join(name)).unwrap();
            std::fs::write(dir.path().join(name).join(MANIFEST_FILE), "{}").unwrap();
        }
        std::fs::create_dir(dir.path().join("Pictures")).unwrap();
        let misnamed = misnamed(dir.path()).unwrap();
        assert_eq!((misnamed.len(), &misnamed[0].0), (1, &dir.path().join("my_model")));
        assert_eq!(list(dir.path()).unwrap().len(), 1);
    }

    #[test]
    fn the_error_for_an_unknown_model_lists_the_existing_ones() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("paper")).unwrap();
        std::fs::write(dir.path().join("paper").join(MANIFEST_FILE), "{}").unwrap();
        let error = find(dir.path(), &"papper".parse().unwrap()).unwrap_err().to_string();
        assert!(
            error.contains("no model \"papper\"") && error.ends_with("there are: paper"),
            "{error}"
        );
    }
}
