//! Settings in layers, for the server and for trainings: a later layer replaces single values of an earlier one, and every
//! value remembers its origin. Values of a file, of `--set` and of the environment are TOML.

use std::path::{Path, PathBuf};

use figment::error::{Actual, Kind};
use figment::util::nest;
use figment::value::{Dict, Map, Value};
use figment::{Figment, Metadata, Profile, Provider};
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Why settings cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The file cannot be read.
    #[error("could not read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        #[source]
        source: std::io::Error,
    },
    /// The text is not valid TOML.
    #[error("{origin} is not valid TOML in line {line}: {message}")]
    Toml {
        /// Where the text comes from.
        origin: String,
        /// Counted from 1.
        line: usize,
        /// What is wrong there.
        message: String,
    },
    /// `--set` without a key or a value.
    #[error("--set {0} is not KEY=VALUE, as in --set max_streams=64")]
    Assignment(String),
    /// There is no such setting.
    #[error(
        "unknown field `{field}`{} ({origin}); `{listing}` lists all settings",
        within(parent)
    )]
    Unknown {
        /// The last part of the key.
        field: String,
        /// The parts of the key before it; empty at the top.
        parent: String,
        /// Where it was given.
        origin: String,
        /// The command that lists all settings.
        listing: &'static str,
    },
    /// The value is of the wrong kind.
    #[error("{key} is {found} ({origin}); it must be {expected}")]
    Type {
        /// The setting.
        key: String,
        /// Where it was given.
        origin: String,
        /// Its value.
        found: String,
        /// What would be right.
        expected: String,
    },
}

impl HasErrorKind for SettingsError {
    fn kind(&self) -> ErrorKind {
        ErrorKind::Usage
    }
}

fn within(parent: &str) -> String {
    if parent.is_empty() {
        String::new()
    } else {
        format!(" in `{parent}`")
    }
}

/// Values from one origin.
#[derive(Clone, Debug)]
pub struct SettingsLayer {
    origin: String,
    values: Dict,
}

impl SettingsLayer {
    /// The origin of a value that nobody gave.
    pub const DEFAULT: &'static str = "default";

    /// One value, for example of the flag `--bind`. Dots in the key separate tables, as in `sequence.steps`.
    #[must_use]
    pub fn value(origin: impl Into<String>, key: &str, value: impl Into<Value>) -> Self {
        Self {
            origin: origin.into(),
            values: table(nest(key, value.into()).into_dict()),
        }
    }

    /// One value as text: a TOML value, or else a string. A name is always a string, also one of digits only.
    #[must_use]
    pub fn text(origin: impl Into<String>, key: &str, text: &str) -> Self {
        let value = toml_value(text).filter(|value| key != "name" || value.is_str());
        let value = value.and_then(|value| Value::serialize(value).ok());
        Self::value(origin, key, value.unwrap_or_else(|| Value::from(text.trim())))
    }

    /// The value of `--set KEY=VALUE`. Errors: `Assignment`.
    pub fn assignment(text: &str) -> Result<Self, SettingsError> {
        let is_key = |key: &str| {
            let is_part = |part: &str| !part.is_empty() && part.chars().all(|c| c.is_alphanumeric() || c == '_');
            key.split('.').all(is_part)
        };
        match text.split_once('=') {
            Some((key, value)) if is_key(key.trim()) => Ok(Self::text("--set", key.trim(), value)),
            _ => Err(SettingsError::Assignment(text.to_owned())),
        }
    }

    /// The values of a TOML text. Errors: `Toml`.
    pub fn toml(origin: impl Into<String>, text: &str) -> Result<Self, SettingsError> {
        let origin = origin.into();
        let table: toml::Table = text.parse().map_err(|error: toml::de::Error| {
            let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
            SettingsError::Toml {
                origin: origin.clone(),
                line: before.matches('\n').count() + 1,
                message: error.message().replace('\n', "; "),
            }
        })?;
        Ok(Self::serialized(origin, &table))
    }

    /// The values of a TOML file. Errors: `Read`, `Toml`.
    pub fn file(path: &Path) -> Result<Self, SettingsError> {
        let text = std::fs::read_to_string(path).map_err(|source| SettingsError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::toml(path.display().to_string(), &text)
    }

    /// The fields of a structure or table.
    #[must_use]
    pub fn serialized(origin: impl Into<String>, fields: &impl Serialize) -> Self {
        Self {
            origin: origin.into(),
            values: table(Value::serialize(fields).ok().and_then(Value::into_dict)),
        }
    }

    /// These values, and those of another layer at the top level.
    #[must_use]
    pub fn with(mut self, other: Self) -> Self {
        self.values.extend(other.values);
        self
    }

    /// The values at the top level whose names are accepted, and the others.
    #[doc(hidden)]
    pub fn partition(mut self, is_accepted: impl Fn(&str) -> bool) -> (Self, Self) {
        let others = self.values.extract_if(.., |name, _| !is_accepted(name)).collect();
        let others = Self {
            origin: self.origin.clone(),
            values: others,
        };
        (self, others)
    }

    /// Whether it has no values.
    #[doc(hidden)]
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// The names of the top level, sorted.
    pub fn keys(&self) -> impl Iterator<Item = &String> {
        self.values.keys()
    }
}

#[expect(clippy::expect_used, reason = "keys, structures and TOML tables always give a table")]
fn table(values: Option<Dict>) -> Dict {
    values.expect("settings without a table is a bug")
}

/// A single TOML value.
fn toml_value(text: &str) -> Option<toml::Value> {
    if text.contains('\n') {
        return None;
    }
    let mut table: toml::Table = format!("value = {text}").parse().ok()?;
    table
        .remove("value")
        .filter(|value| !matches!(value, toml::Value::Datetime(_)))
}

impl Provider for SettingsLayer {
    fn metadata(&self) -> Metadata {
        Metadata::named(self.origin.clone())
    }

    fn data(&self) -> Result<Map<Profile, Dict>, figment::Error> {
        Ok(Map::from([(Profile::Default, self.values.clone())]))
    }
}

/// All layers together.
#[derive(Debug)]
pub struct LayeredSettings {
    values: Figment,
}

impl LayeredSettings {
    /// The defaults under the layers, later ones over earlier ones. The defaults hold every setting; `listing` is the
    /// command that prints them. Errors: `Unknown`.
    pub fn merge(
        defaults: SettingsLayer,
        layers: impl IntoIterator<Item = SettingsLayer>,
        listing: &'static str,
    ) -> Result<Self, SettingsError> {
        let known = defaults.values.clone();
        let mut values = Figment::from(defaults);
        for layer in layers {
            if let Some((parent, field)) = unknown(&known, &layer.values, "") {
                let origin = layer.origin;
                return Err(SettingsError::Unknown {
                    field,
                    parent,
                    origin,
                    listing,
                });
            }
            values = values.merge(layer);
        }
        Ok(Self { values })
    }

    /// The settings as a structure; `expected` says what a setting must be where its type does not say it well.
    /// Errors: `Type`.
    pub fn extract<T: DeserializeOwned>(&self, expected: impl Fn(&str) -> Option<String>) -> Result<T, SettingsError> {
        self.values.extract().map_err(|error| {
            let key = error.path.join(".");
            SettingsError::Type {
                origin: self.origin(&key),
                found: self
                    .value(&key)
                    .map_or_else(|| "not set".to_owned(), |value| value.to_string()),
                expected: expected(&key).unwrap_or_else(|| expected_kind(&error.kind)),
                key,
            }
        })
    }

    /// Where the value of a setting comes from.
    #[must_use]
    pub fn origin(&self, key: &str) -> String {
        let metadata = self.values.find_metadata(key);
        metadata.map_or_else(String::new, |metadata| metadata.name.to_string())
    }

    /// The value of a setting, if it has one.
    #[must_use]
    pub fn value(&self, key: &str) -> Option<toml::Value> {
        match self.values.find_value(key) {
            Ok(Value::Empty(..)) | Err(_) => None,
            Ok(value) => value.deserialize().ok(),
        }
    }
}

/// The first key that is not among the known ones: its parent and its name.
fn unknown(known: &Dict, given: &Dict, parent: &str) -> Option<(String, String)> {
    given.iter().find_map(|(field, value)| match (known.get(field), value) {
        (None, _) => Some((parent.to_owned(), field.clone())),
        (Some(Value::Dict(_, known)), Value::Dict(_, given)) => {
            let key = if parent.is_empty() {
                field.clone()
            } else {
                format!("{parent}.{field}")
            };
            unknown(known, given, &key)
        }
        _ => None,
    })
}

/// What a value must be, by the type of its field.
fn expected_kind(kind: &Kind) -> String {
    match kind {
        Kind::UnknownVariant(_, variants) => variants.join(" or "),
        // TOML has no larger ones.
        Kind::InvalidType(Actual::Str(digits), expected)
            if expected.starts_with('u') && digits.bytes().all(|digit| digit.is_ascii_digit()) =>
        {
            format!("a whole number, 0 to {}", i64::MAX)
        }
        Kind::InvalidType(_, expected) | Kind::InvalidValue(_, expected) => match expected.as_str() {
            "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number, 0 or more".to_owned(),
            "f32" | "f64" => "a number".to_owned(),
            "a boolean" => "true or false".to_owned(),
            "a string" | "path string" => "a string".to_owned(),
            "a sequence" => "a list, as in [\"a\", \"b\"]".to_owned(),
            other if other.starts_with("struct ") => "a table".to_owned(),
            other => other.to_owned(),
        },
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn merged(layers: &[&str]) -> Result<LayeredSettings, SettingsError> {
        let defaults = SettingsLayer::toml("default", "size = 1\n[sequence]\nrate = 1e-3\nname = \"a\"\n")?;
        let layers: Result<Vec<_>, _> = layers.iter().map(|text| SettingsLayer::assignment(text)).collect();
        LayeredSettings::merge(defaults, layers?, "the program")
    }

    #[test]
    fn a_name_of_digits_is_text() {
        for (key, expected) in [("name", json!("20241130")), ("seed", json!(20_241_130))] {
            let layer = SettingsLayer::assignment(&format!("{key}=20241130")).unwrap();
            assert_eq!(serde_json::to_value(&layer.values[key]).unwrap(), expected, "{key}");
        }
    }

    #[test]
    fn a_value_is_toml_or_else_a_string() {
        let settings = merged(&["sequence.rate=2e-3", "sequence.name=runs/x y", "size = 7"]).unwrap();
        assert_eq!(settings.value("sequence.rate"), Some(toml::Value::Float(2e-3)));
        assert_eq!(
            settings.value("sequence.name"),
            Some(toml::Value::String("runs/x y".to_owned()))
        );
        assert_eq!(settings.value("size"), Some(toml::Value::Integer(7)));
    }

    #[test]
    fn an_integer_that_toml_cannot_hold_is_told_the_largest() {
        #[derive(Debug, serde::Deserialize)]
        struct Sizes {
            #[serde(rename = "size")]
            _size: u64,
        }
        let told = |value: &str| {
            let settings = merged(&[&format!("size={value}")]).unwrap();
            settings.extract::<Sizes>(|_| None).unwrap_err().to_string()
        };
        let largest = told("18446744073709551615");
        assert!(
            largest.ends_with("a whole number, 0 to 9223372036854775807"),
            "{largest}"
        );
        assert!(told("many").ends_with("a whole number, 0 or more"));
    }

    #[test]
    fn every_value_remembers_its_origin() {
        let settings = merged(&["sequence.rate=2"]).unwrap();
        assert_eq!(
            (settings.origin("sequence.rate"), settings.origin("sequence.name")),
            ("--set".to_owned(), "default".to_owned())
        );
    }

    #[test]
    fn an_unknown_key_is_refused_with_its_table_and_origin() {
        let message = |text| merged(&[text]).unwrap_err().to_string();
        assert_eq!(
            message("sequence.rat=1"),
            "unknown field `rat` in `sequence` (--set); `the program` lists all settings"
        );
        assert_eq!(
            message("fits.rate=1"),
            "unknown field `fits` (--set); `the program` lists all settings"
        );
    }

    #[test]
    fn an_assignment_without_key_or_value_is_refused() {
        for text in ["size", "=1", "sequence steps=3", "sequence.=3", ""] {
            assert!(
                matches!(SettingsLayer::assignment(text), Err(SettingsError::Assignment(_))),
                "{text}"
            );
        }
    }

    #[test]
    fn a_damaged_text_is_refused_with_its_line() {
        let error = SettingsLayer::toml("mine.toml", "seed = 5\n[sequence\n")
            .unwrap_err()
            .to_string();
        assert!(error.starts_with("mine.toml is not valid TOML in line 2: "), "{error}");
    }
}
