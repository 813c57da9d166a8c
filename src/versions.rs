//! The versions of the models: those shipped in a directory of their own, and those that trainings published, below
//! `models/NAME/VERSION` of the data directory. The store says which were published and which one serves.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use metrics::counter;
use tokio::sync::Mutex;
use tracing::{info, warn};

use crate::files::write_atomically;
use crate::registry::{self, LoadedModel, Manifest, RegistryError};
use crate::serving::{Predictor, ServingError};
use crate::store::{Lease, Store, StoreError, unix_s};
use crate::telemetry::names;
use crate::wording;

/// Why a version could not be loaded, published, chosen or deleted.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum VersionError {
    /// There is no such model or version.
    #[error("there is no version {version} of model \"{model}\"; there are: {}", numbers(known))]
    Unknown {
        /// The model's name.
        model: String,
        /// The version asked for.
        version: u32,
        /// The versions there are.
        known: Vec<u32>,
    },
    /// It serves.
    #[error("version {version} of model \"{model}\" is active; activate another before deleting it")]
    Active {
        /// The model's name.
        model: String,
        /// The version.
        version: u32,
    },
    /// It belongs to the models that came with the program.
    #[error("version {version} of model \"{model}\" was shipped, not published by a job; it is not deleted from here")]
    Shipped {
        /// The model's name.
        model: String,
        /// The version.
        version: u32,
    },
    /// Its files are not what they should be; what served before goes on.
    #[error("version {version} of model \"{model}\" is refused: {reason}")]
    Refused {
        /// The model's name.
        model: String,
        /// The version.
        version: u32,
        /// What is wrong with it.
        reason: String,
    },
    /// Its files could not be written.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// A file could not be read or written.
    #[error("could not {action} {}: {source}", path.display())]
    Io {
        /// `read`, `write`, …
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The predictor has stopped.
    #[error(transparent)]
    Serving(ServingError),
}

fn numbers(known: &[u32]) -> String {
    let known: Vec<String> = known.iter().map(u32::to_string).collect();
    if known.is_empty() {
        "none".to_owned()
    } else {
        known.join(", ")
    }
}

/// The versions that there are; clones share them.
#[derive(Clone)]
pub struct Versions {
    store: Store,
    shipped_dir: PathBuf,
    /// Held while the active version of a model changes.
    switching: Arc<Mutex<()>>,
}

impl Versions {
    /// Those of the store, beside the models shipped in a directory.
    #[must_use]
    pub fn new(store: Store, shipped_dir: &Path) -> Self {
        Self {
            store,
            shipped_dir: shipped_dir.to_owned(),
            switching: Arc::default(),
        }
    }

    /// The shipped version of a model, if it was shipped.
    #[must_use]
    pub fn shipped(&self, model: &str) -> Option<u32> {
        let dir = registry::find(&self.shipped_dir, model).ok()?;
        registry::manifest::read(&dir).ok().map(|manifest| manifest.version)
    }

    /// Every version by model, in rising order. Errors: `Registry`, `Store`.
    pub async fn all(&self) -> Result<BTreeMap<String, Vec<u32>>, VersionError> {
        let mut all = BTreeMap::<String, BTreeSet<u32>>::new();
        for (model, _) in registry::list(&self.shipped_dir)? {
            all.entry(model.clone()).or_default().extend(self.shipped(&model));
        }
        for row in self.store.published_versions().await? {
            all.entry(row.model).or_default().insert(row.version);
        }
        let sorted = |(model, versions): (String, BTreeSet<u32>)| (model, versions.into_iter().collect());
        Ok(all.into_iter().map(sorted).collect())
    }

    /// The versions of a model, in rising order. Errors: `Registry`, `Store`.
    pub async fn of(&self, model: &str) -> Result<Vec<u32>, VersionError> {
        Ok(self.all().await?.remove(model).unwrap_or_default())
    }

    /// Every model that is to serve, loaded: the version chosen, or else the best there is. One that is refused is logged.
    /// Errors: `Registry`, `Store`.
    pub async fn serving(&self) -> Result<Vec<LoadedModel>, VersionError> {
        let active: BTreeMap<String, u32> = self.store.active_versions().await?.into_iter().collect();
        let mut serving = Vec::new();
        for (model, mut versions) in self.all().await? {
            // The newest first, but before them the shipped one, and before all the one that was chosen.
            if versions.is_empty() {
                warn!(model, "its manifest cannot be read");
            }
            versions.reverse();
            let shipped = self.shipped(&model);
            versions.sort_by_key(|&version| (active.get(&model) != Some(&version), shipped != Some(version)));
            for version in versions {
                match counted(self.load(&model, version).await) {
                    Ok(loaded) => {
                        serving.push(loaded);
                        break;
                    }
                    Err(error) => warn!(model, version, %error, "a version was not loaded"),
                }
            }
        }
        Ok(serving)
    }

    /// Loads the version that serves, or else the one that would. Errors: `Unknown`, `Refused`, `Store`.
    pub async fn load_active(&self, model: &str) -> Result<LoadedModel, VersionError> {
        let active = self.store.active_versions().await?;
        let chosen = active
            .into_iter()
            .find(|(name, _)| name == model)
            .map(|(_, version)| version);
        let version = match chosen.or_else(|| self.shipped(model)) {
            Some(version) => version,
            None => self.of(model).await?.last().copied().unwrap_or_default(),
        };
        self.load(model, version).await
    }

    /// Loads a version, fetched into the data directory if need be, after checking hash and shapes.
    /// Errors: `Unknown`, `Refused`, `Store`.
    pub async fn load(&self, model: &str, version: u32) -> Result<LoadedModel, VersionError> {
        let dir = self.directory(model, version).await?;
        let refused = |reason: String| VersionError::Refused {
            model: model.to_owned(),
            version,
            reason,
        };
        let loaded = tokio::task::spawn_blocking(move || registry::load(&dir)).await;
        let loaded = loaded
            .map_err(|error| refused(error.to_string()))?
            .map_err(|error| refused(wording::sentence(&error)))?;
        let Manifest {
            name, version: found, ..
        } = &*loaded.manifest;
        if (name.as_str(), *found) != (model, version) {
            return Err(refused(format!(
                "its manifest says that it is version {found} of \"{name}\""
            )));
        }
        Ok(loaded)
    }

    async fn directory(&self, model: &str, version: u32) -> Result<PathBuf, VersionError> {
        let known = self.of(model).await?;
        if !known.contains(&version) {
            return Err(VersionError::Unknown {
                model: model.to_owned(),
                version,
                known,
            });
        }
        if self.shipped(model) == Some(version) {
            return Ok(registry::find(&self.shipped_dir, model)?);
        }
        let objects = self.store.objects();
        let dir = objects.data_dir().join(key(model, version));
        if !dir.join(registry::MANIFEST_FILE).is_file() {
            objects.pull(&key(model, version), registry::MANIFEST_FILE).await?;
        }
        Ok(dir)
    }

    /// Writes a trained model as the version of its name that is its job's, and returns the version and whether it is the
    /// first of its name; it counts once the job's end is written. `None` if the lease is lost.
    /// Errors: `Registry`, `Io`, `Store`.
    pub async fn write(
        &self,
        lease: Lease,
        model: &str,
        trained_dir: &Path,
    ) -> Result<Option<(u32, bool)>, VersionError> {
        let shipped = self.shipped(model);
        let reserved = self.store.reserve_version(lease, model, shipped.unwrap_or(0)).await?;
        let Some(version) = reserved else { return Ok(None) };
        let objects = self.store.objects();
        let dir = objects.data_dir().join(key(model, version));
        let failed = |action, path: &Path| {
            let path = path.to_owned();
            move |source| VersionError::Io { action, path, source }
        };
        std::fs::create_dir_all(&dir).map_err(failed("make", &dir))?;
        let (from, to) = (
            trained_dir.join(registry::WEIGHTS_FILE),
            dir.join(registry::WEIGHTS_FILE),
        );
        let weights = std::fs::read(&from).map_err(failed("read", &from))?;
        write_atomically(&to, &weights).map_err(failed("write", &to))?;
        let manifest = Manifest {
            name: model.to_owned(),
            version,
            ..registry::manifest::read(trained_dir)?
        };
        registry::write_manifest(&dir, &manifest)?;
        registry::load(&dir)?;
        objects.push(&key(model, version), registry::MANIFEST_FILE).await?;
        Ok(Some((version, shipped.is_none())))
    }

    /// Has a version serve, here at once and on other servers of the store soon, and after a restart. Streams that run keep
    /// theirs. One that is refused changes nothing. Errors: `Unknown`, `Refused`, `Serving`, `Store`.
    pub async fn activate(&self, predictor: &Predictor, model: &str, version: u32) -> Result<(), VersionError> {
        let _switching = self.switching.lock().await;
        let before = predictor.model(model).map(|manifest| manifest.version);
        counted(self.load_model(predictor, model, version).await)?;
        if let Err(error) = self.store.set_active(model, version, unix_s()).await {
            if let Ok(before) = before {
                self.load_model(predictor, model, before).await?;
            }
            return Err(error.into());
        }
        info!(model, version, "version activated");
        Ok(())
    }

    /// Deletes a published version. Errors: `Unknown`, `Active`, `Shipped`, `Store`.
    pub async fn delete(&self, predictor: &Predictor, model: &str, version: u32) -> Result<(), VersionError> {
        let _switching = self.switching.lock().await;
        let (model_name, known) = (model.to_owned(), self.of(model).await?);
        let serves = predictor.model(model).is_ok_and(|manifest| manifest.version == version);
        if !known.contains(&version) {
            return Err(VersionError::Unknown {
                model: model_name,
                version,
                known,
            });
        }
        if self.shipped(model) == Some(version) {
            return Err(VersionError::Shipped {
                model: model_name,
                version,
            });
        }
        if serves || !self.store.delete_version(model, version, unix_s()).await? {
            return Err(VersionError::Active {
                model: model_name,
                version,
            });
        }
        self.store.objects().delete(&key(model, version)).await?;
        Ok(())
    }

    /// Loads what was chosen since, here or by another server. What is refused is logged and put into `refused`, so as not
    /// to be tried again and again; what could not be looked at is tried again the next time. Errors: `Registry`, `Store`.
    pub async fn follow(
        &self,
        predictor: &Predictor,
        refused: &mut BTreeSet<(String, u32)>,
    ) -> Result<(), VersionError> {
        let _switching = self.switching.lock().await;
        for (model, version) in self.store.active_versions().await? {
            let serves = predictor
                .model(&model)
                .is_ok_and(|manifest| manifest.version == version);
            if serves || refused.contains(&(model.clone(), version)) {
                continue;
            }
            match counted(self.load_model(predictor, &model, version).await) {
                Ok(()) => info!(model, version, "version loaded"),
                Err(error) => {
                    warn!(model, version, %error, "a version was not loaded");
                    if let VersionError::Refused { .. } = error {
                        refused.insert((model, version));
                    }
                }
            }
        }
        Ok(())
    }

    /// Has the predictor answer with a version.
    async fn load_model(&self, predictor: &Predictor, model: &str, version: u32) -> Result<(), VersionError> {
        let loaded = self.load(model, version).await?;
        let predictor = predictor.clone();
        let taken = tokio::task::spawn_blocking(move || predictor.load(loaded)).await;
        match taken.unwrap_or(Err(ServingError::Stopped)) {
            Ok(()) => Ok(()),
            Err(ServingError::Stopped) => Err(VersionError::Serving(ServingError::Stopped)),
            Err(error) => Err(VersionError::Refused {
                model: model.to_owned(),
                version,
                reason: wording::sentence(&error),
            }),
        }
    }
}

fn key(model: &str, version: u32) -> String {
    format!("models/{model}/{version}")
}

/// Counts a version that was to serve, unless it had nothing to do with the version that it does not.
fn counted<T>(taken: Result<T, VersionError>) -> Result<T, VersionError> {
    let outcome = match &taken {
        Ok(_) => "ok",
        Err(VersionError::Refused { .. }) => "refused",
        Err(_) => return taken,
    };
    counter!(names::MODEL_LOADS, "outcome" => outcome).increment(1);
    taken
}
