//! Finds data sets and models by path or by name, as a server with the same settings does.

use std::collections::BTreeSet;
use std::future::Future;
use std::path::{Path, PathBuf};

use super::error::CliError;
use super::settings::open_store;
use crate::config::Config;
use crate::server::ServerConfig;
use foreframe_core::registry::{self, Model, RegistryError, StoredWeights};
use foreframe_core::types::{DatasetName, ModelName};
use foreframe_data::dataset::{self, Dataset};
use foreframe_jobs::jobs;
use foreframe_jobs::versions::{VersionError, Versions};

/// The directories of a configuration.
pub(super) struct Workspace {
    pub(super) config: Config,
}

impl Workspace {
    pub(super) fn new(config: Config) -> Self {
        Self { config }
    }

    fn server(&self) -> &ServerConfig {
        &self.config.server
    }

    /// Where data sets are kept by name.
    pub(super) fn datasets_dir(&self) -> PathBuf {
        self.server().data_dir.join("datasets")
    }

    /// Reads a data set by its directory or its name.
    pub(super) fn open_dataset(&self, dataset: &Path) -> Result<(PathBuf, Dataset), CliError> {
        let dir = self.find_dataset(dataset)?;
        let dataset = self.read_dataset(&dir)?;
        Ok((dir, dataset))
    }

    /// Reads the data set in a directory.
    pub(super) fn read_dataset(&self, dir: &Path) -> Result<Dataset, CliError> {
        Ok(Dataset::open_within(dir, self.server().dataset_memory_mib)?)
    }

    /// The directory of a data set, by its directory or its name; fetched if data sets are shared with other servers.
    pub(super) fn find_dataset(&self, dataset: &Path) -> Result<PathBuf, CliError> {
        let name = dataset.to_str().and_then(|name| name.parse::<DatasetName>().ok());
        if let (Some(name), true) = (name, self.server().objects_url.is_some() && !dataset.exists()) {
            return block_on(async {
                let store = open_store(&self.config).await?;
                Ok(jobs::datasets::fetch(store.objects(), &name).await?)
            });
        }
        Ok(dataset::find(&self.datasets_dir(), dataset)?)
    }

    /// The weights of a model, found as by [`Workspace::load_model`].
    pub(super) fn load_weights(&self, model: &str) -> Result<StoredWeights, CliError> {
        let (dir, loaded) = self.load_model(model)?;
        let mut weights = registry::load_weights(&dir)?;
        weights.manifest.name.clone_from(&loaded.manifest.name);
        Ok(weights)
    }

    /// Loads a model by its directory, its name or NAME@VERSION. A name alone is the version that a server would serve.
    pub(super) fn load_model(&self, model: &str) -> Result<(PathBuf, Model), CliError> {
        if let Some(dir) = registry::directory_of(model)? {
            let loaded = registry::load(&dir)?;
            return Ok((dir, loaded));
        }
        let (name, version) = split_version(model)?;
        if !self.server().store().exists() {
            return self.load_shipped(&name, version);
        }
        block_on(async {
            let versions = self.versions().await?;
            let active = versions.active(&name).await?;
            let Some(version) = version.or(active) else {
                return Err(RegistryError::Unknown {
                    name,
                    dir: self.server().models_dir.clone(),
                    known: versions.all().await?.into_keys().collect(),
                }
                .into());
            };
            Ok((
                versions.directory(&name, version).await?,
                versions.load(&name, version).await?,
            ))
        })
    }

    fn load_shipped(&self, name: &ModelName, version: Option<u32>) -> Result<(PathBuf, Model), CliError> {
        let dir = registry::find(&self.server().models_dir, name)?;
        let loaded = registry::load_as(&dir, name)?;
        let found = loaded.manifest.version;
        match version {
            Some(version) if version != found => Err(VersionError::Unknown {
                model: name.to_string(),
                version,
                available: vec![found],
            }
            .into()),
            _ => Ok((dir, loaded)),
        }
    }

    /// The versions of all models; opens the store.
    pub(super) async fn versions(&self) -> Result<Versions, CliError> {
        Ok(Versions::new(
            open_store(&self.config).await?,
            &self.server().models_dir,
        ))
    }

    /// The names of all models, shipped and published, sorted.
    pub(super) fn model_names(&self) -> Result<Vec<ModelName>, CliError> {
        let shipped = registry::list(&self.server().models_dir)?
            .into_iter()
            .map(|(name, _)| name);
        let mut names: BTreeSet<ModelName> = shipped.collect();
        if self.server().store().exists() {
            let published = block_on(async { Ok(self.versions().await?.all().await?) })?;
            names.extend(published.into_keys());
        }
        Ok(names.into_iter().collect())
    }
}

/// The name of a data set that was given with `--name`. Errors: `Usage` if it is not valid.
pub(super) fn dataset_name(name: &str) -> Result<DatasetName, CliError> {
    name.parse().map_err(|_| {
        CliError::Usage(format!(
            "--name is {name:?}; a name has 1 to 64 characters of a to z, 0 to 9 and -, and does not start with -"
        ))
    })
}

/// The scenario that the model was trained on: the default name of its data set.
pub(super) fn trained_on(loaded: &Model) -> Result<PathBuf, CliError> {
    let manifest = &loaded.manifest;
    manifest.dataset.scenario.as_ref().map(PathBuf::from).ok_or_else(|| {
        CliError::Usage(format!(
            "--dataset is missing; model {:?} was trained on {:?}, which is not a simulated scenario",
            manifest.name, manifest.dataset.name
        ))
    })
}

/// A model's name and, after an `@`, its version.
pub(super) fn split_version(model: &str) -> Result<(ModelName, Option<u32>), CliError> {
    let Some((name, version)) = model.split_once('@') else {
        return Ok((registry::model_name(model)?, None));
    };
    match version.parse() {
        Ok(version) => Ok((registry::model_name(name)?, Some(version))),
        Err(_) => Err(CliError::Usage(format!(
            "{model:?} is not NAME or NAME@VERSION; a version is a whole number, as in paper@2"
        ))),
    }
}

/// Runs a short task of the store to its end.
pub(super) fn block_on<T>(task: impl Future<Output = Result<T, CliError>>) -> Result<T, CliError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(CliError::failed)?;
    runtime.block_on(task)
}
