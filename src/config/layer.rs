//! Values from one place.

use std::path::Path;

use figment::value::{Dict, Map, Value};
use figment::{Metadata, Profile, Provider};
use serde::Serialize;

use super::{Config, ConfigError};
use crate::server::ServerConfig;

const PREFIX: &str = "FOREFRAME_";
/// Variables that tell the tests where a database and an object store are; the program has no such fields.
const TEST_PREFIX: &str = "FOREFRAME_TEST_";

/// Values from one place, which errors and `foreframe config` name.
#[derive(Clone, Debug)]
pub struct ConfigLayer {
    origin: String,
    values: Dict,
}

impl ConfigLayer {
    /// Where a value comes from that nobody gave.
    pub(super) const DEFAULT: &'static str = "default";

    /// One value, for example of the flag `--bind`.
    #[must_use]
    pub fn one(origin: impl Into<String>, field: &str, value: impl Into<Value>) -> Self {
        Self {
            origin: origin.into(),
            values: Dict::from([(field.to_owned(), value.into())]),
        }
    }

    /// One value as a text: a number, `true`, `false`, `["a", "b"]`, or else a string.
    #[must_use]
    pub fn text(origin: impl Into<String>, field: &str, text: &str) -> Self {
        let Ok(value) = text.parse::<Value>();
        Self::one(origin, field, value)
    }

    /// The value of `--set KEY=VALUE`. Errors: `Setting`.
    pub fn setting(setting: &str) -> Result<Self, ConfigError> {
        match setting.split_once('=') {
            Some((field, text)) if !field.is_empty() => Ok(Self::text("--set", field, text)),
            _ => Err(ConfigError::Setting(setting.to_owned())),
        }
    }

    /// The fields of a TOML file. Errors: `Read`, `Toml`.
    pub fn file(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Read {
            path: path.to_owned(),
            source,
        })?;
        let table: toml::Table = toml::from_str(&text).map_err(|error| ConfigError::Toml {
            path: path.to_owned(),
            message: error.to_string().trim().replace('\n', " "),
        })?;
        Ok(Self {
            origin: path.display().to_string(),
            values: dict(&table),
        })
    }

    /// The variables that begin with `FOREFRAME_`, each a layer of its own.
    pub fn environment(variables: impl Iterator<Item = (String, String)>) -> impl Iterator<Item = Self> {
        variables.filter_map(|(name, text)| {
            let field = name.strip_prefix(PREFIX)?.to_ascii_lowercase();
            let is_ours = !name.starts_with(TEST_PREFIX);
            is_ours.then(|| Self::text(format!("environment {name}"), &field, &text))
        })
    }

    /// Every field with its default.
    pub(super) fn defaults() -> Self {
        let mut values = dict(&Config::default());
        values.extend(dict(&ServerConfig::default()));
        Self {
            origin: Self::DEFAULT.to_owned(),
            values,
        }
    }

    pub(super) fn keys(&self) -> impl Iterator<Item = &String> {
        self.values.keys()
    }
}

/// Only structures and tables are given here, and they always become a dictionary.
fn dict(fields: &impl Serialize) -> Dict {
    Value::serialize(fields)
        .ok()
        .and_then(Value::into_dict)
        .unwrap_or_default()
}

impl Provider for ConfigLayer {
    fn metadata(&self) -> Metadata {
        Metadata::named(self.origin.clone())
    }

    fn data(&self) -> Result<Map<Profile, Dict>, figment::Error> {
        Ok(Map::from([(Profile::Default, self.values.clone())]))
    }
}
