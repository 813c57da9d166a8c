//! What is known of the loaded models without owning them: read by the handles, written by the worker.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, PoisonError, RwLock};

use super::ServingError;
use crate::registry::Manifest;

pub(super) struct Catalog {
    manifests: RwLock<BTreeMap<String, Arc<Manifest>>>,
    ready: AtomicBool,
}

impl Catalog {
    pub(super) fn of(manifests: impl Iterator<Item = Manifest>) -> Self {
        let named = manifests.map(|manifest| (manifest.name.clone(), Arc::new(manifest)));
        Self {
            manifests: RwLock::new(named.collect()),
            ready: AtomicBool::new(false),
        }
    }

    pub(super) fn insert(&self, manifest: Manifest) {
        let mut manifests = self.manifests.write().unwrap_or_else(PoisonError::into_inner);
        manifests.insert(manifest.name.clone(), Arc::new(manifest));
    }

    pub(super) fn all(&self) -> Vec<Arc<Manifest>> {
        let manifests = self.manifests.read().unwrap_or_else(PoisonError::into_inner);
        manifests.values().cloned().collect()
    }

    pub(super) fn find(&self, name: &str) -> Result<Arc<Manifest>, ServingError> {
        let manifests = self.manifests.read().unwrap_or_else(PoisonError::into_inner);
        manifests.get(name).cloned().ok_or_else(|| ServingError::UnknownModel {
            name: name.to_owned(),
            known: manifests.keys().cloned().collect(),
        })
    }

    pub(super) fn set_ready(&self) {
        self.ready.store(true, Ordering::Release);
    }

    pub(super) fn is_ready(&self) -> bool {
        self.ready.load(Ordering::Acquire)
    }
}
