//! The versions of the models: shipped ones in the models' directory, and those that trainings published, in
//! `models/NAME/VERSION` below the data directory. The store knows which versions are published and which are active.

mod publish;
mod sweep;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use metrics::counter;
use tokio::sync::Mutex;
use tracing::{info, warn};

use crate::store::{Author, JobId, Lease, PublishedVersion, Store, StoreError, unix_s};
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::error_text;
use foreframe_core::files::{is_transient, write_atomically};
use foreframe_core::metric_names;
use foreframe_core::registry::{self, Manifest, Model, RegistryError};
use foreframe_core::serving::{Predictor, ServingError};
use foreframe_core::types::ModelName;

/// Why a version could not be loaded, published, activated or deleted.
#[derive(Debug, thiserror::Error)]
pub enum VersionError {
    /// There is no such model or version.
    #[error(
        "there is no version {version} of model \"{model}\"; there are: {}",
        numbers(available)
    )]
    Unknown {
        /// The model's name.
        model: String,
        /// The requested version.
        version: u32,
        /// The existing versions.
        available: Vec<u32>,
    },
    /// It is active.
    #[error("version {version} of model \"{model}\" is active; activate another before deleting it")]
    Active {
        /// The model's name.
        model: ModelName,
        /// The version.
        version: u32,
    },
    /// It is a shipped version.
    #[error(
        "version {version} of model \"{model}\" was not published: it lies in the models directory; delete its directory there"
    )]
    Shipped {
        /// The model's name.
        model: ModelName,
        /// The version.
        version: u32,
    },
    /// A queued or running job needs it.
    #[error("version {version} of model \"{model}\" is in use by {job}; wait until that job has ended, or cancel it")]
    InUse {
        /// The model's name.
        model: ModelName,
        /// The version.
        version: u32,
        /// The job's id.
        job: JobId,
    },
    /// Its files are not valid. The active version stays active.
    #[error("version {version} of model \"{model}\" is refused: {reason}")]
    Refused {
        /// The model's name.
        model: ModelName,
        /// The version.
        version: u32,
        /// What is wrong with it.
        reason: String,
    },
    /// Its files could not be written.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// The store failed, or a file could not be read or written.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The predictor has stopped.
    #[error(transparent)]
    Serving(ServingError),
}

impl HasErrorKind for VersionError {
    fn kind(&self) -> ErrorKind {
        if is_transient(self) {
            return ErrorKind::Away;
        }
        match self {
            Self::Unknown { .. } => ErrorKind::NotFound,
            Self::Active { .. } | Self::Shipped { .. } | Self::InUse { .. } => ErrorKind::Conflict,
            Self::Refused { .. } => ErrorKind::Unusable,
            Self::Registry(error) => error.kind(),
            Self::Store(error) => error.kind(),
            Self::Serving(error) => error.kind(),
        }
    }
}

impl VersionError {
    fn unknown(model: &ModelName, version: u32, available: Vec<u32>) -> Self {
        let model = model.to_string();
        Self::Unknown {
            model,
            version,
            available,
        }
    }

    fn refused(model: &ModelName, version: u32, reason: String) -> Self {
        let model = model.clone();
        Self::Refused { model, version, reason }
    }
}

fn numbers(available: &[u32]) -> String {
    let available: Vec<String> = available.iter().map(u32::to_string).collect();
    if available.is_empty() {
        "none".to_owned()
    } else {
        available.join(", ")
    }
}

/// All versions of all models. Clones share their state.
#[derive(Clone)]
pub struct Versions {
    store: Store,
    shipped_dir: PathBuf,
    /// Held while the active version of a model changes.
    switching: Arc<Mutex<()>>,
}

impl Versions {
    /// The versions in the store and the models shipped in a directory.
    #[must_use]
    pub fn new(store: Store, shipped_dir: &Path) -> Self {
        Self {
            store,
            shipped_dir: shipped_dir.to_owned(),
            switching: Arc::default(),
        }
    }

    /// The shipped version of a model, if there is one.
    #[must_use]
    pub fn shipped(&self, model: &ModelName) -> Option<u32> {
        let dir = registry::find(&self.shipped_dir, model).ok()?;
        registry::manifest::read(&dir).ok().map(|manifest| manifest.version)
    }

    /// All versions by model, in rising order. Errors: `Registry`, `Store`.
    pub async fn all(&self) -> Result<BTreeMap<ModelName, Vec<u32>>, VersionError> {
        let mut all = BTreeMap::<ModelName, BTreeSet<u32>>::new();
        for (model, _) in registry::list(&self.shipped_dir)? {
            all.entry(model.clone()).or_default().extend(self.shipped(&model));
        }
        for (model, version) in self.store.published_versions().await? {
            all.entry(model).or_default().insert(version);
        }
        let sorted = |(model, versions): (ModelName, BTreeSet<u32>)| (model, versions.into_iter().collect());
        Ok(all.into_iter().map(sorted).collect())
    }

    /// The versions of a model, in rising order. Errors: `Registry`, `Store`.
    pub async fn of(&self, model: &ModelName) -> Result<Vec<u32>, VersionError> {
        Ok(self.all().await?.remove(model).unwrap_or_default())
    }

    /// The metrics of a model: from its latest evaluation job with these weights on its training data, else from the manifest. If
    /// the manifest has no test scores, any data set counts.
    /// Errors: `Store`.
    pub async fn metrics(&self, manifest: &Manifest) -> Result<serde_json::Value, VersionError> {
        let measured = self.store.model_metrics().await?.into_iter().find(|measured| {
            (&measured.model, measured.version) == (&manifest.name, manifest.version)
                && measured.weights_sha256 == manifest.weights_sha256
        });
        let parsed = measured.and_then(|measured| serde_json::from_str(&measured.metrics).ok());
        Ok(parsed.unwrap_or_else(|| manifest.metrics.clone()))
    }

    /// Loads one version of every model: the active one, else the shipped one, else the newest that can be loaded. Versions
    /// that cannot be loaded are logged. Errors: `Registry`, `Store`.
    pub async fn load_serving(&self) -> Result<Vec<Model>, VersionError> {
        self.sweep().await?;
        let active: BTreeMap<ModelName, u32> = self.store.active_versions().await?.into_iter().collect();
        for (path, error) in registry::misnamed(&self.shipped_dir)? {
            warn!(directory = %path.display(), %error, "a model is not loaded");
        }
        let mut serving = Vec::new();
        for (model, mut versions) in self.all().await? {
            if versions.is_empty() {
                warn!(%model, "the model's manifest cannot be read");
            }
            // The active one, then the shipped one, then the newest.
            versions.reverse();
            let shipped = self.shipped(&model);
            versions.sort_by_key(|&version| (active.get(&model) != Some(&version), shipped != Some(version)));
            for version in versions {
                match count_load(self.load(&model, version).await) {
                    Ok(loaded) => {
                        serving.push(loaded);
                        break;
                    }
                    Err(error) => warn!(%model, version, %error, "a version was not loaded"),
                }
            }
        }
        Ok(serving)
    }

    /// Loads the active version, else the shipped one, else the newest. Errors: `Unknown`, `Refused`, `Store`.
    pub async fn load_active(&self, model: &ModelName) -> Result<Model, VersionError> {
        let version = self.active(model).await?.unwrap_or_default();
        self.load(model, version).await
    }

    /// Loads a version after checking its hash and shapes. Fetches it into the data directory if necessary.
    /// Errors: `Unknown`, `Refused`, `Store`.
    pub async fn load(&self, model: &ModelName, version: u32) -> Result<Model, VersionError> {
        let dir = self.directory(model, version).await?;
        let refused = |reason| VersionError::refused(model, version, reason);
        // The name of a shipped model is that of its directory.
        let name = (self.shipped(model) == Some(version)).then(|| model.clone());
        let load = move || match name {
            Some(name) => registry::load_as(&dir, &name),
            None => registry::load(&dir),
        };
        let loaded = tokio::task::spawn_blocking(load).await;
        let loaded = loaded
            .map_err(|error| refused(error.to_string()))?
            .map_err(|error| refused(error_text::with_causes(&error)))?;
        let (name, found) = (&loaded.manifest.name, loaded.manifest.version);
        if (name, found) != (model, version) {
            return Err(refused(format!("its manifest is of version {found} of \"{name}\"")));
        }
        Ok(loaded)
    }

    /// Describes a version, by default the one that [`Self::load_active`] would load. Errors: `Unknown`, `Refused`, `Store`.
    pub async fn manifest(&self, model: &ModelName, version: Option<u32>) -> Result<Manifest, VersionError> {
        let version = match version {
            Some(version) => version,
            None => self.active(model).await?.unwrap_or_default(),
        };
        let dir = self.directory(model, version).await?;
        let refused = |reason| VersionError::refused(model, version, reason);
        let read = tokio::task::spawn_blocking(move || registry::manifest::read(&dir)).await;
        let manifest = read.map_err(|error| refused(error.to_string()))?;
        let mut manifest = manifest.map_err(|error| refused(error_text::with_causes(&error)))?;
        // The name of a shipped model is that of its directory.
        manifest.name.clone_from(model);
        Ok(manifest)
    }

    /// The directory of a version, fetched into the data directory if it is not there. Errors: `Unknown`, `Store`.
    pub async fn directory(&self, model: &ModelName, version: u32) -> Result<PathBuf, VersionError> {
        let available = self.of(model).await?;
        if !available.contains(&version) {
            return Err(VersionError::unknown(model, version, available));
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

    /// Writes a trained model as its job's version, which becomes active if the model was not shipped and no version is. It is
    /// published when the job's outcome is written. `None` if the lease is lost. Errors: `Registry`, `Store`.
    pub async fn write(
        &self,
        lease: Lease,
        model: &ModelName,
        trained_dir: &Path,
    ) -> Result<Option<PublishedVersion>, VersionError> {
        let shipped = self.shipped(model);
        let reserved = self.store.reserve_version(lease, model, shipped.unwrap_or(0)).await?;
        let Some(version) = reserved else { return Ok(None) };
        self.write_files(model, version, trained_dir).await?;
        Ok(Some(PublishedVersion {
            model: model.clone(),
            version,
            activates: shipped.is_none(),
        }))
    }

    /// The version that serves, or else the one that would: the chosen one, the shipped one, the newest.
    /// Errors: `Registry`, `Store`.
    pub async fn active(&self, model: &ModelName) -> Result<Option<u32>, VersionError> {
        let active = self.store.active_versions().await?;
        let chosen = active.into_iter().find(|(name, _)| name == model);
        match chosen.map(|(_, version)| version).or_else(|| self.shipped(model)) {
            Some(version) => Ok(Some(version)),
            None => Ok(self.of(model).await?.last().copied()),
        }
    }

    /// Copies a model's files into the directory of a version and checks them there. Errors: `Registry`, `Store`.
    async fn write_files(&self, model: &ModelName, version: u32, trained_dir: &Path) -> Result<(), VersionError> {
        let objects = self.store.objects();
        let dir = objects.data_dir().join(key(model, version));
        std::fs::create_dir_all(&dir).map_err(StoreError::io("make", &dir))?;
        let [from, to] = [trained_dir, &dir].map(|dir| dir.join(registry::WEIGHTS_FILE));
        let weights = std::fs::read(&from).map_err(StoreError::io("read", &from))?;
        write_atomically(&to, &weights).map_err(StoreError::io("write", &to))?;
        let manifest = Manifest {
            name: model.clone(),
            version,
            ..registry::manifest::read(trained_dir)?
        };
        registry::write_manifest(&dir, &manifest)?;
        registry::load(&dir)?;
        Ok(objects.push(&key(model, version), registry::MANIFEST_FILE).await?)
    }

    /// Makes a version active: here at once, on other servers of the store soon, and after a restart. Open streams keep
    /// their version. A refused version changes nothing. Errors: `Unknown`, `Refused`, `Serving`, `Store`.
    pub async fn activate(
        &self,
        predictor: &Predictor,
        model: &ModelName,
        version: u32,
        by: &Author,
    ) -> Result<(), VersionError> {
        let _switching = self.switching.lock().await;
        let before = predictor.model(model.as_str()).map(|manifest| manifest.version);
        count_load(self.load_model(predictor, model, version).await)?;
        if let Err(error) = self.store.set_active(model, version, unix_s(), by).await {
            if let Ok(before) = before {
                self.load_model(predictor, model, before).await?;
            }
            return Err(error.into());
        }
        info!(%model, version, "version activated");
        Ok(())
    }

    /// Deletes a published version. Errors: `Unknown`, `Active`, `Shipped`, `Store`.
    pub async fn delete(
        &self,
        predictor: &Predictor,
        model: &ModelName,
        version: u32,
        by: &Author,
    ) -> Result<(), VersionError> {
        let _switching = self.switching.lock().await;
        self.check_removable(model, version, &self.of(model).await?)?;
        if serves(predictor, model, version) {
            let model = model.clone();
            return Err(VersionError::Active { model, version });
        }
        self.delete_published(model, version, by).await
    }

    /// Errors: `Unknown`, `Shipped`.
    fn check_removable(&self, model: &ModelName, version: u32, available: &[u32]) -> Result<(), VersionError> {
        if !available.contains(&version) {
            return Err(VersionError::unknown(model, version, available.to_vec()));
        }
        if self.shipped(model) == Some(version) {
            let model = model.clone();
            return Err(VersionError::Shipped { model, version });
        }
        Ok(())
    }

    /// Deletes a version with its files. Errors: `Active`, `Store`.
    async fn delete_published(&self, model: &ModelName, version: u32, by: &Author) -> Result<(), VersionError> {
        if !self.store.delete_version(model, version, unix_s(), by).await? {
            let model = model.clone();
            return Err(VersionError::Active { model, version });
        }
        Ok(self.store.objects().delete(&key(model, version)).await?)
    }

    /// Loads versions that other servers activated. A refused version is logged and added to `refused`, so that it is not
    /// tried again; a version that could not be read is tried again at the next call. Errors: `Registry`, `Store`.
    pub async fn load_activated(
        &self,
        predictor: &Predictor,
        refused: &mut BTreeSet<(ModelName, u32)>,
    ) -> Result<(), VersionError> {
        let _switching = self.switching.lock().await;
        for (model, version) in self.store.active_versions().await? {
            if serves(predictor, &model, version) || refused.contains(&(model.clone(), version)) {
                continue;
            }
            match count_load(self.load_model(predictor, &model, version).await) {
                Ok(()) => info!(%model, version, "version loaded"),
                Err(error) => {
                    warn!(%model, version, %error, "a version was not loaded");
                    if let VersionError::Refused { .. } = error {
                        refused.insert((model, version));
                    }
                }
            }
        }
        Ok(())
    }

    /// Loads a version into the predictor.
    async fn load_model(&self, predictor: &Predictor, model: &ModelName, version: u32) -> Result<(), VersionError> {
        let loaded = self.load(model, version).await?;
        let predictor = predictor.clone();
        let result = tokio::task::spawn_blocking(move || predictor.load(loaded)).await;
        match result.unwrap_or(Err(ServingError::Stopped)) {
            Ok(()) => Ok(()),
            Err(error @ ServingError::Stopped) => Err(VersionError::Serving(error)),
            Err(error) => Err(VersionError::refused(model, version, error_text::with_causes(&error))),
        }
    }
}

/// Whether the predictor serves that version.
fn serves(predictor: &Predictor, model: &ModelName, version: u32) -> bool {
    let serving = predictor.model(model.as_str());
    serving.is_ok_and(|manifest| manifest.version == version)
}

fn key(model: &ModelName, version: u32) -> String {
    format!("models/{model}/{version}")
}

/// Counts the load of a version, unless it failed for a reason outside the version.
fn count_load<T>(loaded: Result<T, VersionError>) -> Result<T, VersionError> {
    let outcome = match &loaded {
        Ok(_) => "ok",
        Err(VersionError::Refused { .. }) => "refused",
        Err(_) => return loaded,
    };
    counter!(metric_names::MODEL_LOADS, "outcome" => outcome).increment(1);
    loaded
}
