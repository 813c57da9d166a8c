//! The trained tensors of a model by name.

use std::collections::BTreeMap;

use candle_core::{DType, Tensor, Var};

use super::error::NnError;
use super::init;
use super::options::ArchitectureKind;
use super::spec::ModelSpec;
use super::tensors::with_values;
use crate::types::Seed;

/// The trained tensors of a model. Names are sorted, so every pass over them has one order.
#[derive(Clone, Debug)]
pub struct Parameters(BTreeMap<String, Var>);

impl Parameters {
    /// Initial weights, f32: the same seed gives the same bits. Errors: those of [`ModelSpec::validate`].
    pub fn initialize(spec: &ModelSpec, seed: Seed) -> Result<Self, NnError> {
        spec.validate()?;
        let tensors = spec
            .tensor_shapes()
            .into_iter()
            .map(|(name, shape)| Ok((name.clone(), Var::from_tensor(&init::tensor(&name, &shape, seed)?)?)))
            .collect::<Result<_, NnError>>()?;
        Ok(Self(tensors))
    }

    /// Weights from stored tensors of any float type, converted to f32. Errors: `OtherArchitecture`, `TensorMissing`, `TensorUnknown`, `TensorShape`,
    /// `TensorNotFinite`, and those of [`ModelSpec::validate`].
    pub fn from_tensors(spec: &ModelSpec, mut tensors: BTreeMap<String, Tensor>) -> Result<Self, NnError> {
        spec.validate()?;
        let expected = spec.architecture.kind();
        if let Some(found) = architecture_of(&tensors).filter(|&found| found != expected) {
            return Err(NnError::OtherArchitecture { found, expected });
        }
        let mut vars = BTreeMap::new();
        for (name, expected) in spec.tensor_shapes() {
            let found = tensors.remove(&name);
            let tensor = of_shape(&name, &expected, found.as_ref())?;
            let tensor = tensor.to_dtype(DType::F32)?.force_contiguous()?;
            if !with_values(&tensor, |values| values.iter().all(|value| value.is_finite()))? {
                return Err(NnError::TensorNotFinite { name });
            }
            vars.insert(name, Var::from_tensor(&tensor)?);
        }
        match tensors.into_keys().next() {
            Some(name) => Err(NnError::TensorUnknown { name }),
            None => Ok(Self(vars)),
        }
    }

    /// Every tensor with its name, sorted by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.0.iter().map(|(name, var)| (name.as_str(), var))
    }

    /// The tensor with this name.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&Var> {
        self.0.get(name)
    }

    /// The tensor with this name, which the caller cannot do without. Errors: `TensorMissing`.
    pub fn require(&self, name: &str) -> Result<&Var, NnError> {
        self.get(name).ok_or_else(|| NnError::TensorMissing {
            name: name.to_owned(),
            expected: Vec::new(),
        })
    }

    /// Copies of the current tensors. Later updates do not change the copies.
    pub fn snapshot(&self) -> Result<BTreeMap<String, Tensor>, NnError> {
        self.0
            .iter()
            .map(|(name, var)| Ok((name.clone(), var.as_detached_tensor().copy()?)))
            .collect()
    }

    /// Sets every tensor to its value in `snapshot`, in place: models that share the storage see the change.
    /// Errors: `TensorMissing`, `TensorShape`.
    pub fn restore(&self, snapshot: &BTreeMap<String, Tensor>) -> Result<(), NnError> {
        let mut changes = Vec::new();
        for (name, var) in &self.0 {
            changes.push((var, of_shape(name, var.dims(), snapshot.get(name))?));
        }
        for (var, tensor) in changes {
            var.set(&tensor.to_dtype(var.dtype())?)?;
        }
        Ok(())
    }

    /// Number of parameters.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.0.values().map(|var| var.elem_count() as u64).sum()
    }
}

/// The architecture that these tensors belong to, if their names show it.
fn architecture_of(tensors: &BTreeMap<String, Tensor>) -> Option<ArchitectureKind> {
    let has = |prefix: &str| tensors.keys().any(|name| name.starts_with(prefix));
    match (has("flow."), has("frame_encoder."), has("sprites.")) {
        (true, false, false) => Some(ArchitectureKind::Flow),
        (false, true, false) => Some(ArchitectureKind::Dense),
        (false, false, true) => Some(ArchitectureKind::Sprites),
        _ => None,
    }
}

/// The tensor that was found under a name, if it has the expected shape. Errors: `TensorMissing`, `TensorShape`.
pub(super) fn of_shape<'a>(name: &str, expected: &[usize], found: Option<&'a Tensor>) -> Result<&'a Tensor, NnError> {
    let (name, expected) = (name.to_owned(), expected.to_vec());
    match found {
        None => Err(NnError::TensorMissing { name, expected }),
        Some(tensor) if tensor.dims() != expected => Err(NnError::TensorShape {
            name,
            found: tensor.dims().to_vec(),
            expected,
        }),
        Some(tensor) => Ok(tensor),
    }
}
