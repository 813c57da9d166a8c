//! The model inside the program: it stands in for the default models directory where that does not exist, so that a copied
//! program predicts and serves without any other file.

use std::path::{Path, PathBuf};

/// The default models directory, which the embedded model stands in for.
const STANDS_IN_FOR: &str = "models";
/// The model's name.
const NAME: &str = "moving-flow";
#[cfg(feature = "server")]
const FILES: Option<(&[u8], &[u8])> = Some((
    include_bytes!("../../models/moving-flow/manifest.json"),
    include_bytes!("../../models/moving-flow/model.safetensors"),
));
// A robot's own program brings its own models.
#[cfg(not(feature = "server"))]
const FILES: Option<(&[u8], &[u8])> = None;

/// Name and directory of the embedded model, if it stands in for this directory of models.
pub(super) fn in_place_of(models_dir: &Path) -> Option<(String, PathBuf)> {
    let stands_in = FILES.is_some() && models_dir == Path::new(STANDS_IN_FOR) && !models_dir.exists();
    stands_in.then(|| (NAME.to_owned(), models_dir.join(NAME)))
}

/// The manifest of the model in this directory, if that is the embedded model.
pub(super) fn manifest(model_dir: &Path) -> Option<&'static [u8]> {
    files(model_dir).map(|(manifest, _)| manifest)
}

/// The weights of the model in this directory, if that is the embedded model.
pub(super) fn weights(model_dir: &Path) -> Option<&'static [u8]> {
    files(model_dir).map(|(_, weights)| weights)
}

fn files(model_dir: &Path) -> Option<(&'static [u8], &'static [u8])> {
    let (_, dir) = in_place_of(model_dir.parent()?)?;
    FILES.filter(|_| dir == model_dir)
}
