//! Loads a model from its files. Hash, tensor names and shapes are checked before the model is built. Other programs that
//! read safetensors can load the same file; `docs/dense-network.md` lists the tensors of the dense network.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;

use candle_core::{DType, Device, Tensor};

use super::embedded;
use super::error::RegistryError;
use super::layout::{MANIFEST_FILE, WEIGHTS_FILE};
use super::manifest::{self, Manifest};
use crate::files::sha256_hex;
use crate::nn::{ModelSpec, Network, NnError, Parameters, precision};
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
/// `Weights`, `Device`.
pub fn load(model_dir: &Path) -> Result<Model, RegistryError> {
    let StoredWeights { manifest, parameters } = load_weights(model_dir)?;
    let network =
        Network::detached(manifest.spec.clone(), &parameters).and_then(|network| network.packed(precision::current()));
    let network = network.map_err(|source| match source {
        NnError::Device { .. } => RegistryError::Device(source),
        _ => RegistryError::Weights {
            path: model_dir.join(WEIGHTS_FILE),
            source,
        },
    })?;
    Ok(Model {
        manifest: Arc::new(manifest),
        network,
    })
}

/// As [`load`], under another name than the manifest's. Errors: as [`load`].
pub fn load_as(model_dir: &Path, name: &ModelName) -> Result<Model, RegistryError> {
    let mut loaded = load(model_dir)?;
    Arc::make_mut(&mut loaded.manifest).name = name.clone();
    Ok(loaded)
}

/// Reads and verifies the weights in a directory. Errors: as [`load`].
pub fn load_weights(model_dir: &Path) -> Result<StoredWeights, RegistryError> {
    let manifest = manifest::read(model_dir)?;
    check_values(&manifest).map_err(|reason| RegistryError::ManifestValue {
        path: model_dir.join(MANIFEST_FILE),
        reason,
    })?;
    let path = model_dir.join(WEIGHTS_FILE);
    let bytes = embedded::read_weights(model_dir, MAX_WEIGHTS_BYTES)?;
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

/// Errors: which value of the manifest is out of range, and what it must be.
fn check_values(manifest: &Manifest) -> Result<(), String> {
    manifest.spec.validate().map_err(|error| error.to_string())?;
    match &manifest.calibration {
        Some(calibration) => calibration.check(&manifest.spec),
        None => Ok(()),
    }
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
