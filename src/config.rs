//! The configuration of the server and of the commands that use its directories: defaults < TOML file < environment <
//! flags. Keys are flat: `max_streams` in the file, `FOREFRAME_MAX_STREAMS` in the environment, `--set max_streams=64`.

mod bind;
mod print;

use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::server::{ServerConfig, SettingError, is_origin};
use crate::telemetry::LogFormat;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::nn::{NnError, device, precision};
use foreframe_train::settings::{LayeredSettings, SettingsError, SettingsLayer};

/// The file that is read if it exists and no other is named.
pub const DEFAULT_FILE: &str = "foreframe.toml";

/// The port to listen on by default.
pub const DEFAULT_PORT: u16 = 8642;

/// The port for health checks and metrics by default.
pub const DEFAULT_ADMIN_PORT: u16 = 8643;

/// The command that lists all settings.
const LISTING: &str = "foreframe config";

const PREFIX: &str = "FOREFRAME_";
/// Variables that tell the tests where a database and an object store are. They are not settings.
const TEST_PREFIX: &str = "FOREFRAME_TEST_";

/// Why there is no configuration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A file, a key or a value cannot be used.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// A value is out of range, or it names a directory that does not exist or is a file.
    #[error("{0}")]
    Value(String),
}

impl HasErrorKind for ConfigError {
    fn kind(&self) -> ErrorKind {
        ErrorKind::Usage
    }
}

/// All settings, checked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default)]
pub struct Config {
    /// The address and port to listen on: HOST:PORT, or HOST alone for port 8642. HOST is an IP address or a name such as
    /// localhost. Port 0 takes any free port.
    #[schema(value_type = String)]
    #[serde(deserialize_with = "bind::deserialize")]
    pub bind: SocketAddr,
    /// The port to listen on; replaces the port of `bind`.
    pub port: Option<u16>,
    /// The address and port for `/livez`, `/readyz` and `/metrics` alone: HOST:PORT, HOST for port 8643, or `off`. Its
    /// connections have a limit of their own, so that probes are answered while all others are in use. No API key is asked for.
    /// If the default is in use by another program, `foreframe serve` goes on without. `foreframe worker` listens only if this is
    /// set.
    #[schema(value_type = String)]
    #[serde(
        serialize_with = "bind::serialize_or_off",
        deserialize_with = "bind::deserialize_or_off"
    )]
    pub admin_bind: Option<SocketAddr>,
    /// Whether to accept requests from other machines although no API key exists.
    pub insecure: bool,
    /// Whether to create an API key and print it once, if a key is required and none was ever created. Its scope is admin: use it
    /// to look around, then create a key for each caller and revoke it.
    pub first_key: bool,
    /// The format of log lines: `text` or `json`.
    #[schema(value_type = String)]
    pub log_format: LogFormat,
    /// Where traces are sent, for example `http://127.0.0.1:4318`; needs the Cargo feature `otlp`.
    pub otlp_endpoint: Option<String>,
    /// The server's limits and directories.
    #[serde(skip)]
    pub server: ServerConfig,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            bind: SocketAddr::from((Ipv4Addr::LOCALHOST, DEFAULT_PORT)),
            port: None,
            admin_bind: Some(SocketAddr::from((Ipv4Addr::LOCALHOST, DEFAULT_ADMIN_PORT))),
            insecure: false,
            first_key: false,
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

/// A configuration and the origin of each of its values.
#[derive(Debug)]
pub struct LoadedConfig {
    /// The settings.
    pub config: Config,
    values: LayeredSettings,
}

impl LoadedConfig {
    /// Reads the file (`file`, or [`DEFAULT_FILE`] if it exists) and the environment, and puts the flags over them.
    /// Errors: see [`LoadedConfig::from_layers`].
    pub fn read(file: Option<&Path>, flags: Vec<SettingsLayer>) -> Result<Self, ConfigError> {
        Self::read_over(file.map(SettingsLayer::file).transpose()?, flags)
    }

    /// The same with the settings of a file that was read already.
    pub fn read_over(file: Option<SettingsLayer>, flags: Vec<SettingsLayer>) -> Result<Self, ConfigError> {
        let default = Path::new(DEFAULT_FILE);
        let file = match file {
            None if default.is_file() => Some(SettingsLayer::file(default)?),
            file => file,
        };
        // A variable that is not Unicode cannot be a setting.
        let variables = std::env::vars_os();
        let texts = variables.filter_map(|(name, text)| Some((name.into_string().ok()?, text.into_string().ok()?)));
        Self::from_layers(file.into_iter().chain(environment_layers(texts)).chain(flags))
    }

    /// The defaults under the layers, later ones over earlier ones. Errors: `Settings`, `Value`.
    pub fn from_layers(layers: impl IntoIterator<Item = SettingsLayer>) -> Result<Self, ConfigError> {
        let values = LayeredSettings::merge(defaults(), layers, LISTING)?;
        let mut server: ServerConfig = values.extract(expected)?;
        server.validate().map_err(|error| {
            let SettingError { field, value, range } = error;
            let (origin, least, most) = (values.origin(field), range.start(), range.end());
            ConfigError::Value(format!("{field} is {value} ({origin}); it must be {least} to {most}"))
        })?;
        if let Some(wrong) = server.cors_origins.iter().find(|origin| !is_origin(origin)) {
            let origin = values.origin("cors_origins");
            return Err(ConfigError::Value(format!(
                "cors_origins holds \"{wrong}\" ({origin}); an origin is http:// or https://, a host and perhaps a port, as in \
                 https://robots.example"
            )));
        }
        let mut config: Config = values.extract(expected)?;
        for url in [
            &mut server.database_url,
            &mut server.objects_url,
            &mut config.otlp_endpoint,
        ] {
            url.take_if(|url| url.is_empty());
        }
        for path in [&mut server.import_dir, &mut server.tls_certificate, &mut server.tls_key] {
            path.take_if(|path| path.as_os_str().is_empty());
        }
        if let Some(port) = config.port {
            config.bind.set_port(port);
        }
        server.job_log_format = config.log_format;
        config.server = server;
        Ok(Self { config, values })
    }

    /// Whether no file, variable or flag gives the setting.
    #[must_use]
    pub fn is_default(&self, field: &str) -> bool {
        self.values.origin(field) == SettingsLayer::DEFAULT
    }

    /// Checks the directories. The data directory is created later if it does not exist. The models directory may be
    /// missing only if it is the default. Errors: `Value`.
    pub fn check_directories(&self) -> Result<(), ConfigError> {
        let server = &self.config.server;
        let is_wrong = |path: &Path, may_be_absent: bool| !path.is_dir() && (path.exists() || !may_be_absent);
        let (field, path, right) = if is_wrong(&server.data_dir, true) {
            let right = "name a directory; it is created if it does not exist";
            ("data_dir", &server.data_dir, right)
        } else if is_wrong(&server.models_dir, self.is_default("models_dir")) {
            let right = "name a directory that holds models, or leave the setting out to serve those in ./models";
            ("models_dir", &server.models_dir, right)
        } else if let Some(import_dir) = server.import_dir.as_ref().filter(|dir| is_wrong(dir, false)) {
            let right = "name the directory with the recordings, or leave the setting out to turn imports off";
            ("import_dir", import_dir, right)
        } else {
            return Ok(());
        };
        let wrong = if path.exists() { "is a file" } else { "does not exist" };
        let (origin, path) = (self.values.origin(field), path.display());
        let sentence = format!("{field} is \"{path}\" ({origin}), which {wrong}; {right}");
        Err(ConfigError::Value(sentence))
    }

    /// Makes the networks of this process compute on the configured device, in the configured precision. Errors: `Value`.
    pub fn choose_computation(&self) -> Result<(), ConfigError> {
        let origin = |field| self.values.origin(field);
        let refused = |error| match error {
            NnError::Device { device, reason } => format!("device is \"{device}\" ({}): {reason}", origin("device")),
            NnError::Precision { precision, reason } => {
                format!("precision is \"{precision}\" ({}): {reason}", origin("precision"))
            }
            other => other.to_string(),
        };
        let server = &self.config.server;
        let chosen = device::choose(server.device).and_then(|()| precision::choose(server.precision));
        chosen.map_err(|error| ConfigError::Value(refused(error)))
    }

    /// The settings as TOML, each with its meaning and origin; passwords in URLs are hidden.
    #[must_use]
    pub fn to_toml(&self) -> String {
        let (fields, meanings) = (defaults(), print::meanings());
        let entry = |field| print::entry(&self.values, field, &meanings);
        fields.keys().map(|field| entry(field)).collect::<Vec<_>>().join("\n")
    }

    /// The settings as a JSON object, each with its value and origin; passwords in URLs are hidden.
    #[must_use]
    pub fn to_json(&self) -> serde_json::Value {
        let fields = defaults();
        let entry = |field: &str| (field.to_owned(), print::json_entry(&self.values, field));
        fields.keys().map(|field| entry(field)).collect()
    }
}

/// Whether there is a setting of that name.
#[must_use]
pub fn is_setting(name: &str) -> bool {
    defaults().keys().any(|setting| setting == name)
}

/// Every setting with its default.
fn defaults() -> SettingsLayer {
    let origin = SettingsLayer::DEFAULT;
    SettingsLayer::serialized(origin, &Config::default())
        .with(SettingsLayer::serialized(origin, &ServerConfig::default()))
}

/// The variables whose names start with `FOREFRAME_`, each as a layer of its own.
pub fn environment_layers(variables: impl Iterator<Item = (String, String)>) -> impl Iterator<Item = SettingsLayer> {
    variables.filter_map(|(name, text)| {
        let field = name.strip_prefix(PREFIX)?.to_ascii_lowercase();
        let is_setting = !name.starts_with(TEST_PREFIX);
        let origin = if is_service_link(&field, &text) {
            format!("environment {name}, which Kubernetes sets for a Service; set enableServiceLinks: false in the pod")
        } else {
            format!("environment {name}")
        };
        is_setting.then(|| SettingsLayer::text(origin, &field, &text))
    })
}

/// Whether Kubernetes made the variable for a Service of our name: `…_SERVICE_HOST`, `…_PORT_80_TCP_ADDR` and the like.
fn is_service_link(field: &str, text: &str) -> bool {
    let is_address = field.ends_with("port") && (text.starts_with("tcp://") || text.starts_with("udp://"));
    let parts = ["service_host", "service_port", "_tcp", "_udp"];
    is_address || parts.iter().any(|part| field.contains(part))
}

/// What a setting must be, where its type does not say it well.
fn expected(field: &str) -> Option<String> {
    let what = match field {
        "bind" => "HOST:PORT, as in 127.0.0.1:8642 or localhost:8642",
        "admin_bind" => "HOST:PORT, as in 127.0.0.1:8643, or off",
        "device" => "cpu, cuda or cuda:N",
        "precision" => "f32, bf16 or int8",
        "port" => "0 to 65535",
        _ => return whole_number(field),
    };
    Some(what.to_owned())
}

/// The range of a number.
fn range(field: &str) -> Option<String> {
    let bounds = ServerConfig::default().bounds();
    let (_, _, range) = bounds.iter().find(|(name, _, _)| *name == field)?;
    Some(format!("{} to {}", range.start(), range.end()))
}

/// What a setting with a range must be: a whole number of the unit that its name ends with.
fn whole_number(field: &str) -> Option<String> {
    let units = [
        ("_bytes", " of bytes"),
        ("_mib", " of MiB"),
        ("_ms", " of milliseconds"),
        ("_s", " of seconds"),
    ];
    let of_unit = units
        .iter()
        .find(|(end, _)| field.ends_with(end))
        .map_or("", |(_, unit)| unit);
    range(field).map(|range| format!("a whole number{of_unit}, {range}"))
}
