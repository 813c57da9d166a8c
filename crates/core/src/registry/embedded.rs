//! The model inside the program: it stands in for the default models directory where that does not exist, so that a copied
//! program predicts and serves without any other file. A robot's own program brings its own models and has none.

use std::borrow::Cow;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use super::error::RegistryError;
use super::layout::{MANIFEST_FILE, WEIGHTS_FILE};
use crate::types::ModelName;

/// The default models directory, which the embedded model stands in for.
const STANDS_IN_FOR: &str = "models";

static EMBEDDED: OnceLock<EmbeddedModel> = OnceLock::new();

/// The files of a model that a program carries.
#[derive(Debug)]
pub struct EmbeddedModel {
    /// The model's name.
    pub name: &'static str,
    /// The bytes of its manifest.
    pub manifest: &'static [u8],
    /// The bytes of its weights.
    pub weights: &'static [u8],
}

/// Lets this model stand in for the directory `models` from now on, where that does not exist. The first call counts.
pub fn embed(model: EmbeddedModel) {
    let _ = EMBEDDED.set(model);
}

/// Name and directory of the embedded model, if it stands in for this directory of models.
pub(super) fn in_place_of(models_dir: &Path) -> Option<(ModelName, PathBuf)> {
    let model = standing_in_for(models_dir)?;
    let name = model
        .name
        .parse()
        .expect("an embedded model without a valid name is a bug");
    Some((name, models_dir.join(model.name)))
}

fn standing_in_for(models_dir: &Path) -> Option<&'static EmbeddedModel> {
    EMBEDDED
        .get()
        .filter(|_| models_dir == Path::new(STANDS_IN_FOR) && !models_dir.exists())
}

/// The manifest in a model's directory, also in that of the embedded model. Errors: `Io`, also if the file has more bytes
/// than the limit.
pub(super) fn read_manifest(model_dir: &Path, limit: u64) -> Result<Cow<'static, [u8]>, RegistryError> {
    match model_at(model_dir) {
        Some(model) => Ok(Cow::Borrowed(model.manifest)),
        None => read(&model_dir.join(MANIFEST_FILE), limit),
    }
}

/// The weights in a model's directory. As [`read_manifest`].
pub(super) fn read_weights(model_dir: &Path, limit: u64) -> Result<Cow<'static, [u8]>, RegistryError> {
    match model_at(model_dir) {
        Some(model) => Ok(Cow::Borrowed(model.weights)),
        None => read(&model_dir.join(WEIGHTS_FILE), limit),
    }
}

fn model_at(model_dir: &Path) -> Option<&'static EmbeddedModel> {
    let models_dir = model_dir.parent()?;
    standing_in_for(models_dir).filter(|model| model_dir == models_dir.join(model.name))
}

fn read(path: &Path, limit: u64) -> Result<Cow<'static, [u8]>, RegistryError> {
    let bytes = std::fs::metadata(path).and_then(|found| match found.len() {
        size if size > limit => Err(io::Error::other(format!(
            "the file has {size} bytes; at most {limit} are allowed"
        ))),
        _ => std::fs::read(path),
    });
    Ok(Cow::Owned(bytes.map_err(RegistryError::io("read", path))?))
}
