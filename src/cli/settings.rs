//! The flags that go over file and environment, shared by the commands that run long.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use super::CliError;
use crate::config::{ConfigError, Layer, Loaded};

/// Settings; `foreframe config` prints all of them, with where each comes from.
#[derive(clap::Args, Default)]
pub(super) struct Settings {
    /// A TOML file of settings [default: foreframe.toml, if it is there]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Where to listen [default: 127.0.0.1:8642]
    #[arg(long, value_name = "ADDRESS:PORT")]
    bind: Option<SocketAddr>,
    /// The directory of the models to serve [default: models]
    #[arg(long, value_name = "DIR")]
    models: Option<PathBuf>,
    /// Where jobs keep data sets, runs and the models they train [default: data]
    #[arg(long, value_name = "DIR")]
    data_dir: Option<PathBuf>,
    /// postgres://USER:PASSWORD@HOST/NAME, to share jobs and keys with other servers [default: SQLite in the data directory]
    #[arg(long, value_name = "URL")]
    database_url: Option<String>,
    /// s3://BUCKET/PREFIX, to share data sets and models with other servers [default: the data directory]
    #[arg(long, value_name = "URL")]
    objects_url: Option<String>,
    /// How log lines look: text or json [default: text]
    #[arg(long, value_name = "FORMAT")]
    log_format: Option<String>,
    /// Leave jobs to workers
    #[arg(long)]
    no_jobs: bool,
    /// Listen on other than a loopback address although nobody needs a key
    #[arg(long)]
    insecure: bool,
    /// Any other setting, as in max_streams=64; may be given many times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl Settings {
    /// The configuration with these flags over everything else.
    pub(super) fn load(&self) -> Result<Loaded, CliError> {
        let path = |path: &Option<PathBuf>| path.as_deref().map(|path| Path::to_string_lossy(path).into_owned());
        let texts = [
            ("--bind", "bind", self.bind.map(|bind| bind.to_string())),
            ("--models", "models_dir", path(&self.models)),
            ("--data-dir", "data_dir", path(&self.data_dir)),
            ("--database-url", "database_url", self.database_url.clone()),
            ("--objects-url", "objects_url", self.objects_url.clone()),
            ("--log-format", "log_format", self.log_format.clone()),
        ];
        let switches = [
            ("--no-jobs", "no_jobs", self.no_jobs),
            ("--insecure", "insecure", self.insecure),
        ];
        let mut layers: Vec<Layer> = texts
            .into_iter()
            .filter_map(|(flag, field, text)| Some(Layer::one(flag, field, text?)))
            .collect();
        let switches = switches.into_iter().filter(|(_, _, is_given)| *is_given);
        layers.extend(switches.map(|(flag, field, _)| Layer::one(flag, field, true)));
        for setting in &self.set {
            layers.push(Layer::setting(setting)?);
        }
        Ok(Loaded::read(self.config.as_deref(), layers)?)
    }
}

impl From<ConfigError> for CliError {
    fn from(error: ConfigError) -> Self {
        Self::Usage(error.to_string())
    }
}
