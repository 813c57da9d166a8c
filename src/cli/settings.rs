//! The flags that go over file and environment, shared by the commands that run long.

use std::path::PathBuf;

use super::CliError;
use crate::config::{Config, ConfigError, ConfigLayer, LoadedConfig};
use crate::store::{Store, StoreError};

/// Where state is kept.
#[derive(clap::Args, Default)]
pub(super) struct StoreSettings {
    /// A TOML file of settings [default: foreframe.toml, if it is there]
    #[arg(global = true, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Where jobs keep data sets, runs and the models they train [default: data]
    #[arg(global = true, long, value_name = "DIR")]
    data_dir: Option<PathBuf>,
    /// Rows, to share them with other servers: PostgreSQL's URL [default: SQLite in the data directory]
    #[arg(global = true, long, value_name = "URL")]
    database_url: Option<String>,
    /// Files, to share them with other servers: an S3 bucket's URL [default: the data directory]
    #[arg(global = true, long, value_name = "URL")]
    objects_url: Option<String>,
    /// How log lines look: text or json [default: text]
    #[arg(global = true, long, value_name = "FORMAT")]
    log_format: Option<String>,
    /// Any other setting, as in `max_streams=64`; may be given many times
    #[arg(global = true, long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

impl StoreSettings {
    /// The configuration with these flags over everything else.
    pub(super) fn load(&self) -> Result<LoadedConfig, CliError> {
        self.load_with(Vec::new())
    }

    fn load_with(&self, mut flags: Vec<ConfigLayer>) -> Result<LoadedConfig, CliError> {
        let data_dir = self.data_dir.as_ref().map(|dir| dir.to_string_lossy().into_owned());
        flags.extend(given([
            ("--data-dir", "data_dir", data_dir),
            ("--database-url", "database_url", self.database_url.clone()),
            ("--objects-url", "objects_url", self.objects_url.clone()),
            ("--log-format", "log_format", self.log_format.clone()),
        ]));
        for setting in &self.settings {
            flags.push(ConfigLayer::setting(setting)?);
        }
        Ok(LoadedConfig::read(self.config.as_deref(), flags)?)
    }
}

/// All that `serve` takes; `foreframe config` prints every setting, with where it comes from.
#[derive(clap::Args, Default)]
pub(super) struct Settings {
    /// Where to listen [default: 127.0.0.1:8642]
    #[arg(long, value_name = "ADDRESS:PORT")]
    bind: Option<String>,
    /// The directory of the models to serve [default: models]
    #[arg(long, value_name = "DIR")]
    models: Option<PathBuf>,
    #[command(flatten)]
    store: StoreSettings,
    /// Leave jobs to workers
    #[arg(long)]
    no_jobs: bool,
    /// Listen on other than a loopback address although nobody needs a key
    #[arg(long)]
    insecure: bool,
}

impl Settings {
    /// The configuration with these flags over everything else.
    pub(super) fn load(&self) -> Result<LoadedConfig, CliError> {
        let models = self.models.as_ref().map(|dir| dir.to_string_lossy().into_owned());
        let mut flags = given([
            ("--bind", "bind", self.bind.clone()),
            ("--models", "models_dir", models),
        ]);
        flags.extend(self.no_jobs.then(|| ConfigLayer::one("--no-jobs", "no_jobs", true)));
        flags.extend(self.insecure.then(|| ConfigLayer::one("--insecure", "insecure", true)));
        self.store.load_with(flags)
    }
}

fn given<const N: usize>(flags: [(&str, &str, Option<String>); N]) -> Vec<ConfigLayer> {
    let given = |(flag, field, text): (&str, &str, Option<String>)| Some(ConfigLayer::one(flag, field, text?));
    flags.into_iter().filter_map(given).collect()
}

/// The configuration of a command that is about to begin its work in its directories.
pub(super) fn checked(loaded: LoadedConfig) -> Result<Config, CliError> {
    loaded.check_directories()?;
    Ok(loaded.config)
}

/// The store that the settings name.
pub(super) async fn open_store(config: &Config) -> Result<Store, CliError> {
    Ok(Store::open(&config.server.store()).await?)
}

impl From<ConfigError> for CliError {
    fn from(error: ConfigError) -> Self {
        Self::Usage(error.to_string())
    }
}

impl From<StoreError> for CliError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::Url { .. } | StoreError::NoTls => Self::Usage(error.to_string()),
            other => Self::failed(other),
        }
    }
}
