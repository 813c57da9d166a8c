//! The configuration of the long-running commands: defaults < TOML file < environment < flags, each value with where it
//! came from. Keys are flat: `max_streams` in the file, `FOREFRAME_MAX_STREAMS` in the environment, `--set max_streams=64`.

mod layer;
mod print;

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use figment::Figment;
use figment::value::Dict;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::server::ServerConfig;
use crate::telemetry::LogFormat;

pub use layer::ConfigLayer;

/// The file that is read where none is named and it is there.
pub const DEFAULT_FILE: &str = "foreframe.toml";

/// Why there is no configuration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("could not read the configuration {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The file is no TOML.
    #[error("{} is not TOML: {message}", path.display())]
    Toml {
        /// The file.
        path: PathBuf,
        /// Where and why.
        message: String,
    },
    /// `--set` without a key and a value.
    #[error("--set {0} is not KEY=VALUE, as in --set max_streams=64")]
    Setting(String),
    /// There is no such field.
    #[error("{field} ({origin}) is no field of the configuration; foreframe config prints all of them")]
    Unknown {
        /// The name given.
        field: String,
        /// Where it was given.
        origin: String,
    },
    /// The value has not the field's type.
    #[error("{field} is {found} ({origin}); it must be {right}")]
    Type {
        /// The field.
        field: String,
        /// Where it was given.
        origin: String,
        /// Its value.
        found: String,
        /// What would be right.
        right: String,
    },
    /// The value is out of range.
    #[error("{field} is {value} ({origin}); it must be {least} to {most}")]
    Range {
        /// The field.
        field: &'static str,
        /// Where it was given.
        origin: String,
        /// Its value.
        value: u64,
        /// The least it may be.
        least: u64,
        /// The most it may be.
        most: u64,
    },
    /// The directory is not there, or is none.
    #[error("{field} is \"{}\" ({origin}), {wrong}; {right}", path.display())]
    Directory {
        /// The field.
        field: &'static str,
        /// Where it was given.
        origin: String,
        /// Its value.
        path: PathBuf,
        /// What is wrong with it.
        wrong: &'static str,
        /// What would be right.
        right: &'static str,
    },
}

/// All settings, checked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default)]
pub struct Config {
    /// Where to listen.
    #[schema(value_type = String)]
    pub bind: SocketAddr,
    /// Listen on other than a loopback address although nobody needs a key.
    pub insecure: bool,
    /// `text` or `json`.
    #[schema(value_type = String)]
    pub log_format: LogFormat,
    /// Where traces go, for example `http://127.0.0.1:4318`; needs the feature `otlp`.
    pub otlp_endpoint: Option<String>,
    /// The server's limits, and its data directory.
    #[serde(skip)]
    pub server: ServerConfig,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            bind: SocketAddr::from((Ipv4Addr::LOCALHOST, 8642)),
            insecure: false,
            log_format: LogFormat::Text,
            otlp_endpoint: None,
            server: ServerConfig::default(),
        }
    }
}

impl Config {
    /// Whether other machines can reach the address.
    #[must_use]
    pub fn is_exposed(&self) -> bool {
        !self.bind.ip().to_canonical().is_loopback()
    }
}

/// A configuration and where each of its values came from.
#[derive(Debug)]
pub struct LoadedConfig {
    /// The settings.
    pub config: Config,
    values: Figment,
}

impl LoadedConfig {
    /// Reads the file (`file`, else [`DEFAULT_FILE`] if it is there) and the environment, and puts the flags over them.
    /// Errors: every [`ConfigError`].
    pub fn read(file: Option<&Path>, flags: Vec<ConfigLayer>) -> Result<Self, ConfigError> {
        let default = Path::new(DEFAULT_FILE);
        let file = file.or_else(|| default.is_file().then_some(default));
        let file = file.map(ConfigLayer::file).transpose()?;
        // A variable that is no text is none of ours.
        let variables = std::env::vars_os();
        let texts = variables.filter_map(|(name, text)| Some((name.into_string().ok()?, text.into_string().ok()?)));
        Self::from_layers(file.into_iter().chain(ConfigLayer::environment(texts)).chain(flags))
    }

    /// The defaults under the layers, later ones over earlier ones. Errors: `Unknown`, `Type`, `Range`.
    pub fn from_layers(layers: impl IntoIterator<Item = ConfigLayer>) -> Result<Self, ConfigError> {
        let defaults = ConfigLayer::defaults();
        let known: Vec<String> = defaults.keys().cloned().collect();
        let values = layers.into_iter().fold(Figment::from(defaults), Figment::merge);
        let given: Dict = extract(&values)?;
        if let Some(field) = given.keys().find(|field| !known.contains(field)) {
            return Err(ConfigError::Unknown {
                field: field.clone(),
                origin: origin(&values, field),
            });
        }
        let mut server: ServerConfig = extract(&values)?;
        if let Some((field, value, range)) = server.out_of_bounds() {
            return Err(ConfigError::Range {
                field,
                origin: origin(&values, field),
                value,
                least: *range.start(),
                most: *range.end(),
            });
        }
        let mut config: Config = extract(&values)?;
        for url in [
            &mut server.database_url,
            &mut server.objects_url,
            &mut config.otlp_endpoint,
        ] {
            url.take_if(|url| url.is_empty());
        }
        config.server = server;
        Ok(Self { config, values })
    }

    /// Looks at the directories: a data directory is made where it is not there, and so may the default one of models not
    /// be, but one that was asked for must. Errors: `Directory`.
    pub fn check_directories(&self) -> Result<(), ConfigError> {
        let ServerConfig {
            data_dir, models_dir, ..
        } = &self.config.server;
        let is_asked_for = origin(&self.values, "models_dir") != ConfigLayer::DEFAULT;
        let (field, path, right) = if data_dir.exists() && !data_dir.is_dir() {
            let right = "name a directory, which is made if it is not there";
            ("data_dir", data_dir, right)
        } else if !models_dir.is_dir() && (is_asked_for || models_dir.exists()) {
            let right = "name a directory that holds models, or none to serve those in ./models";
            ("models_dir", models_dir, right)
        } else {
            return Ok(());
        };
        Err(ConfigError::Directory {
            field,
            origin: origin(&self.values, field),
            path: path.clone(),
            wrong: if path.exists() {
                "which is a file"
            } else {
                "which is not there"
            },
            right,
        })
    }

    /// The settings as a TOML text, each with what it means and where it came from; passwords in URLs are not shown.
    #[must_use]
    pub fn to_toml(&self) -> String {
        let (fields, meanings) = (ConfigLayer::defaults(), print::meanings());
        let entry = |field| print::entry(&self.values, field, &meanings);
        fields.keys().map(|field| entry(field)).collect::<Vec<_>>().join("\n")
    }
}

fn extract<T: DeserializeOwned>(values: &Figment) -> Result<T, ConfigError> {
    values.extract().map_err(|error| {
        let field = error.path.first().cloned().unwrap_or_default();
        ConfigError::Type {
            origin: origin(values, &field),
            found: print::shown(values, &field),
            right: print::right(&field, &error.kind),
            field,
        }
    })
}

/// Where a value came from.
fn origin(values: &Figment, field: &str) -> String {
    let metadata = values.find_metadata(field);
    metadata.map_or_else(String::new, |metadata| metadata.name.to_string())
}
