//! Loads a model from its files. Hash, tensor names and shapes are checked before the model is built. Other programs that
//! read safetensors can load the same file; `models/README.md` lists the tensors.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;

use candle_core::{DType, Device, Tensor};

use super::embedded;
use super::error::RegistryError;
use super::layout::{MANIFEST_FILE, WEIGHTS_FILE};
use super::manifest::{self, Manifest};
use crate::files::sha256_hex;
use crate::nn::{ModelSpec, Network, NnError, Parameters};
use crate::types::ModelName;

/// The largest weights file that is accepted, in bytes.
const MAX_WEIGHTS_BYTES: u64 = 1 << 30;

/// A loaded model with its manifest.
#[derive(Clone)]
pub struct Model {
    /// The model's description.
    pub manifest: Arc<Manifest>,
    /// The network, ready to predict. Its tensors are those of the tensor library, so it is no part of the library's
    /// interface.
    #[doc(hidden)]
    pub network: Network,
}

impl Model {
    /// Sizes of its frames, context and horizon, and its channels.
    #[must_use]
    pub fn spec(&self) -> &ModelSpec {
        &self.manifest.spec
    }
}

/// A model's verified weights, from which a training can start.
#[derive(Clone, Debug)]
pub struct StoredWeights {
    /// The model's description.
    pub manifest: Manifest,
    /// All tensors, as f32.
    #[doc(hidden)]
    pub parameters: Parameters,
}

/// Reads, verifies and builds the model in a directory. Errors: `Io`, `Manifest`, `ManifestValue`, `Hash`, `Safetensors`,
/// `Weights`.
pub fn load(model_dir: &Path) -> Result<Model, RegistryError> {
    let StoredWeights { manifest, parameters } = load_weights(model_dir)?;
    let network = Network::detached(manifest.spec.clone(), &parameters).map_err(|source| RegistryError::Weights {
        path: model_dir.join(WEIGHTS_FILE),
        source,
    })?;
    Ok(Model {
        manifest: Arc::new(manifest),
        network,
    })
}

/// Reads and verifies the weights in a directory. Errors: as [`load`].
pub fn load_weights(model_dir: &Path) -> Result<StoredWeights, RegistryError> {
    let manifest = manifest::read(model_dir)?;
    let checked = manifest.spec.validate().map_err(|error| error.to_string());
    let calibrated = |()| (manifest.calibration.iter()).try_for_each(|calibration| calibration.check(&manifest.spec));
    checked
        .and_then(calibrated)
        .map_err(|reason| RegistryError::ManifestValue {
            path: model_dir.join(MANIFEST_FILE),
            reason,
        })?;
    let path = model_dir.join(WEIGHTS_FILE);
    let bytes = match embedded::weights(model_dir) {
        Some(bytes) => Cow::Borrowed(bytes),
        None => Cow::Owned(read_weights(&path)?),
    };
    let found = sha256_hex(&bytes);
    if found != manifest.weights_sha256 {
        return Err(RegistryError::Hash {
            path,
            found,
            expected: manifest.weights_sha256,
        });
    }
    let tensors =
        candle_core::safetensors::load_buffer(&bytes, &Device::Cpu).map_err(|source| RegistryError::Safetensors {
            path: path.clone(),
            source: source.into(),
        })?;
    let parameters = Parameters::from_tensors(&manifest.spec, tensors.into_iter().collect())
        .map_err(|source| RegistryError::Weights { path, source })?;
    Ok(StoredWeights { manifest, parameters })
}

/// The bytes of a weights file. Errors: `Io`, also if it is too large.
fn read_weights(path: &Path) -> Result<Vec<u8>, RegistryError> {
    let read_failed = |source| RegistryError::Io {
        action: "read",
        path: path.to_owned(),
        source,
    };
    let size = std::fs::metadata(path).map_err(read_failed)?.len();
    if size > MAX_WEIGHTS_BYTES {
        return Err(read_failed(std::io::Error::other(format!(
            "the file has {size} bytes; at most {MAX_WEIGHTS_BYTES} are allowed"
        ))));
    }
    std::fs::read(path).map_err(read_failed)
}

/// As [`load`], under another name than the manifest's. Errors: as [`load`].
pub fn load_as(model_dir: &Path, name: &ModelName) -> Result<Model, RegistryError> {
    let loaded = load(model_dir)?;
    let manifest = Manifest {
        name: name.clone(),
        ..(*loaded.manifest).clone()
    };
    Ok(Model {
        manifest: Arc::new(manifest),
        network: loaded.network,
    })
}

/// The parameters as the bytes of a safetensors file, in half precision, sorted by name.
pub(super) fn serialize_f16(parameters: &Parameters) -> Result<Vec<u8>, NnError> {
    let halves = parameters
        .snapshot()?
        .into_iter()
        .map(|(name, tensor)| Ok((name, tensor.to_dtype(DType::F16)?)))
        .collect::<Result<BTreeMap<String, Tensor>, NnError>>()?;
    Ok(safetensors::tensor::serialize(&halves, None::<HashMap<String, String>>).map_err(candle_core::Error::from)?)
}
