//! The flags that set values of the configuration. Each flag has the name of its setting.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use clap::builder::NonEmptyStringValueParser;
use serde::Serialize;

use super::error::CliError;
use super::next_step::shell_word;
use crate::config::{Config, LoadedConfig};
use crate::telemetry;
use foreframe_jobs::store::Store;
use foreframe_train::settings::SettingsLayer;

/// The heading of these flags in every help text.
const HEADING: &str = "Settings";

/// Where data sets, models and state are.
#[derive(clap::Args, Default, Serialize)]
pub(super) struct DirectoryArgs {
    /// The data directory: data sets, published models and the database [default: data]
    #[arg(global = true, long, value_name = "DIR", value_parser = NonEmptyStringValueParser::new(), help_heading = HEADING)]
    data_dir: Option<String>,
    /// The directory of the models that came with the program [default: models]
    #[arg(global = true, long, value_name = "DIR", value_parser = NonEmptyStringValueParser::new(), help_heading = HEADING)]
    models_dir: Option<String>,
    /// A PostgreSQL URL, to share the database with other servers [default: SQLite in the data directory]
    #[arg(global = true, long, value_name = "URL", help_heading = HEADING, hide_short_help = true)]
    database_url: Option<String>,
    /// A directory or the URL of an S3 bucket, to share files with other servers [default: the data directory]
    #[arg(global = true, long, value_name = "URL", help_heading = HEADING, hide_short_help = true)]
    objects_url: Option<String>,
    /// The format of log lines: text or json [default: text]
    #[arg(global = true, long, value_name = "FORMAT", help_heading = HEADING, hide_short_help = true)]
    log_format: Option<String>,
}

impl DirectoryArgs {
    /// The directories and URLs that were given as flags, each with a space before it, for a command to be run next.
    pub(super) fn repeated(&self) -> String {
        let flags = [
            ("--data-dir", &self.data_dir),
            ("--models-dir", &self.models_dir),
            ("--database-url", &self.database_url),
            ("--objects-url", &self.objects_url),
        ];
        let given = flags
            .iter()
            .filter_map(|(flag, value)| Some(format!(" {flag} {}", shell_word(value.as_deref()?))));
        given.collect()
    }

    /// The configuration with a file's settings instead of those of foreframe.toml, if there are any, and with these flags and
    /// the single settings over everything else; starts the log.
    pub(super) fn start(&self, file: Option<SettingsLayer>, settings: Vec<SettingsLayer>) -> Result<Config, CliError> {
        let flags = flag_layers(self).into_iter().chain(settings).collect();
        start(LoadedConfig::read_over(file.filter(|file| !file.is_empty()), flags)?)
    }
}

/// The settings of every command but `train`, which has settings of its own.
#[derive(clap::Args, Default)]
pub(super) struct CommonArgs {
    /// A TOML file of settings [default: foreframe.toml, if it exists]
    #[arg(global = true, long, value_name = "FILE", help_heading = HEADING, hide_short_help = true)]
    config: Option<PathBuf>,
    /// Any setting, as in `max_streams=64`; may be repeated. `foreframe config` lists all settings
    #[arg(global = true, long = "set", value_name = "KEY=VALUE", help_heading = HEADING, hide_short_help = true)]
    settings: Vec<String>,
    #[command(flatten)]
    directories: DirectoryArgs,
}

impl CommonArgs {
    /// The configuration with these flags over everything else; starts the log.
    pub(super) fn start(&self) -> Result<Config, CliError> {
        start(self.load()?)
    }

    /// See [`DirectoryArgs::repeated`].
    pub(super) fn repeated(&self) -> String {
        self.directories.repeated()
    }

    /// The configuration with these flags over everything else.
    pub(super) fn load(&self) -> Result<LoadedConfig, CliError> {
        self.load_with(Vec::new())
    }

    fn load_with(&self, mut flags: Vec<SettingsLayer>) -> Result<LoadedConfig, CliError> {
        flags.extend(flag_layers(&self.directories));
        for setting in &self.settings {
            flags.push(SettingsLayer::assignment(setting)?);
        }
        Ok(LoadedConfig::read(self.config.as_deref(), flags)?)
    }
}

/// The settings of a server.
#[derive(clap::Args, Default, Serialize)]
pub(super) struct ServerArgs {
    /// The address to listen on: an IP address or a name, with or without a port [default: 127.0.0.1:8642]
    #[arg(long, value_name = "HOST:PORT", help_heading = HEADING)]
    bind: Option<String>,
    /// The port to listen on; replaces the port of --bind
    #[arg(long, value_name = "PORT", help_heading = HEADING)]
    port: Option<u16>,
    /// Whether to run jobs: true, or false to accept them and leave the work to `foreframe worker` [default: true]
    #[arg(long, value_name = "BOOL", help_heading = HEADING)]
    run_jobs: Option<bool>,
    /// Accept requests from other machines although no API key exists
    #[arg(long, help_heading = HEADING)]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    insecure: bool,
    #[command(flatten)]
    #[serde(skip)]
    common: CommonArgs,
}

impl ServerArgs {
    /// The configuration with these flags over everything else.
    pub(super) fn load(&self) -> Result<LoadedConfig, CliError> {
        self.common.load_with(flag_layers(self))
    }
}

/// A layer for each flag that was given. Its origin is the flag, as `--data-dir` for the setting `data_dir`.
fn flag_layers(flags: &impl Serialize) -> Vec<SettingsLayer> {
    let flags = serde_json::to_value(flags).expect("a flag that is not JSON is a bug");
    let given = flags
        .as_object()
        .into_iter()
        .flatten()
        .filter(|(_, value)| !value.is_null());
    given
        .map(|(key, value)| {
            let flag = format!("--{}", key.replace('_', "-"));
            SettingsLayer::serialized(flag, &BTreeMap::from([(key, value)]))
        })
        .collect()
}

fn start(loaded: LoadedConfig) -> Result<Config, CliError> {
    // Short commands send no traces.
    let _ = telemetry::init(loaded.config.log_format, None)?;
    loaded.choose_computation()?;
    Ok(loaded.config)
}

/// The configuration of a command that is about to work in its directories, on its device and in its precision. Errors: `Usage` if one
/// of them cannot be used.
pub(super) fn with_checked_directories(loaded: LoadedConfig) -> Result<Config, CliError> {
    loaded.check_directories()?;
    loaded.choose_computation()?;
    Ok(loaded.config)
}

/// The store of the configuration.
pub(super) async fn open_store(config: &Config) -> Result<Store, CliError> {
    Ok(Store::open(&config.server.store()).await?)
}

/// The store of the configuration; waits for its PostgreSQL.
pub(super) async fn open_store_waiting(config: &Config) -> Result<Store, CliError> {
    let limit = Duration::from_secs(config.server.database_wait_s);
    Ok(Store::open_waiting(&config.server.store(), limit).await?)
}
