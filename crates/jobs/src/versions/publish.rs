//! What an operator does with versions: publish a trained model, choose the active version, remove versions. It works on
//! the store alone, so it works beside running servers and without one.

use std::path::Path;

use super::{VersionError, Versions, key};
use crate::store::{Author, unix_s};
use foreframe_core::registry::{self, RegistryError};
use foreframe_core::types::ModelName;

impl Versions {
    /// Publishes the model in a directory as the next version of a name, and returns the version. If it becomes the active
    /// version, a running server of the same store serves it within seconds. Errors: `Registry`, `Store`.
    pub async fn publish(&self, model: &ModelName, trained_dir: &Path, activates: bool) -> Result<u32, VersionError> {
        registry::load(trained_dir)?;
        self.sweep_unpublished().await?;
        let _publishing = self.begin_publication()?;
        let shipped = self.shipped(model).unwrap_or(0);
        let version = self.store.reserve_next_version(model, shipped).await?;
        if let Err(error) = self.write_files(model, version, trained_dir).await {
            self.store.objects().delete(&key(model, version)).await?;
            return Err(error);
        }
        let by = Author::CommandLine;
        self.store.publish_version(model, version, unix_s(), &by).await?;
        if activates {
            self.store.set_active(model, version, unix_s(), &by).await?;
        }
        Ok(version)
    }

    /// Makes a version the active one, for servers of the store to load. Errors: `Unknown`, `Refused`, `Store`.
    pub async fn choose(&self, model: &ModelName, version: u32) -> Result<(), VersionError> {
        self.load(model, version).await?;
        let by = Author::CommandLine;
        Ok(self.store.set_active(model, version, unix_s(), &by).await?)
    }

    /// Deletes one published version that is not active, or all published versions of a model; then the shipped one is
    /// active, if there is one. Returns the deleted versions. Errors: `Unknown`, `Active`, `Shipped`, `Store`.
    pub async fn remove(&self, model: &ModelName, version: Option<u32>) -> Result<Vec<u32>, VersionError> {
        let (known, shipped) = (self.of(model).await?, self.shipped(model));
        if known.is_empty() {
            return Err(RegistryError::Unknown {
                name: model.clone(),
                dir: self.shipped_dir.clone(),
                known: self.all().await?.into_keys().collect(),
            }
            .into());
        }
        let published = known.iter().copied().filter(|&known| shipped != Some(known));
        let doomed: Vec<u32> = version.map_or_else(|| published.collect(), |version| vec![version]);
        // Without a published version, the shipped one is refused.
        for &version in if doomed.is_empty() { &known } else { &doomed } {
            self.check_removable(model, version, &known)?;
        }
        let by = Author::CommandLine;
        if version.is_none() {
            match shipped {
                Some(shipped) => self.store.set_active(model, shipped, unix_s(), &by).await?,
                None => self.store.clear_active(model).await?,
            }
        }
        for &version in &doomed {
            self.delete_published(model, version, &by).await?;
        }
        Ok(doomed)
    }
}
