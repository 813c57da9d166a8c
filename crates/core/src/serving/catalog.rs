//! The active version of each model, by name. A handle keeps its version loaded after another version becomes active.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, PoisonError, RwLock};

use super::error::ServingError;
use crate::registry::Model;
use crate::types::ModelName;

/// Number of panics in a row after which the predictor is not ready.
const MAX_PANICS: u32 = 3;

pub(super) struct Catalog {
    models: RwLock<BTreeMap<ModelName, Arc<Model>>>,
    ready: AtomicBool,
    /// Panics of the inference thread since its last batch.
    panics: AtomicU32,
}

impl Catalog {
    pub(super) fn new(models: Vec<Model>) -> Self {
        let named = models
            .into_iter()
            .map(|model| (model.manifest.name.clone(), Arc::new(model)));
        Self {
            models: RwLock::new(named.collect()),
            ready: AtomicBool::new(false),
            panics: AtomicU32::new(0),
        }
    }

    pub(super) fn insert(&self, model: Model) {
        let mut models = self.models.write().unwrap_or_else(PoisonError::into_inner);
        models.insert(model.manifest.name.clone(), Arc::new(model));
    }

    pub(super) fn all(&self) -> Vec<Arc<Model>> {
        let models = self.models.read().unwrap_or_else(PoisonError::into_inner);
        models.values().cloned().collect()
    }

    pub(super) fn find(&self, name: &str) -> Result<Arc<Model>, ServingError> {
        let models = self.models.read().unwrap_or_else(PoisonError::into_inner);
        models.get(name).cloned().ok_or_else(|| ServingError::UnknownModel {
            name: name.to_owned(),
            available: models.keys().cloned().collect(),
        })
    }

    pub(super) fn set_ready(&self) {
        self.ready.store(true, Ordering::Release);
    }

    pub(super) fn is_ready(&self) -> bool {
        self.ready.load(Ordering::Acquire) && self.panics.load(Ordering::Acquire) < MAX_PANICS
    }

    pub(super) fn record_panic(&self) {
        self.panics.fetch_add(1, Ordering::AcqRel);
    }

    pub(super) fn reset_panics(&self) {
        self.panics.store(0, Ordering::Release);
    }
}
