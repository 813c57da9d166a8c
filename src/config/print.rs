//! Values and ranges as people read them.

use std::collections::HashMap;

use figment::Figment;
use figment::error::Kind;
use figment::value::Value;
use utoipa::PartialSchema as _;
use utoipa::openapi::{RefOr, Schema};

use super::{Config, origin};
use crate::server::ServerConfig;

/// What each field means, from its documentation.
pub(super) fn meanings() -> HashMap<String, String> {
    let schemas = [Config::schema(), ServerConfig::schema()];
    let properties = schemas.into_iter().filter_map(|schema| match schema {
        RefOr::T(Schema::Object(object)) => Some(object.properties),
        _ => None,
    });
    let meaning = |(field, schema)| match schema {
        RefOr::T(Schema::Object(object)) => Some((field, object.description?)),
        RefOr::T(Schema::Array(array)) => Some((field, array.description?)),
        _ => None,
    };
    properties.flatten().filter_map(meaning).collect()
}

/// What it means, and `field = value  # where it came from; its range`. What hides a password is a remark, not to be taken
/// for a value.
pub(super) fn entry(values: &Figment, field: &str, meanings: &HashMap<String, String>) -> String {
    let meaning = meanings
        .get(field)
        .map_or_else(String::new, |meaning| format!("# {}\n", meaning.replace('\n', "\n# ")));
    let range = range(field).map_or_else(String::new, |range| format!("; {range}"));
    let origin = origin(values, field);
    let line = match values.find_value(field) {
        Ok(Value::Empty(..)) | Err(_) => format!("# {field} is not set"),
        Ok(Value::String(_, text)) if masked(&text) != text => {
            format!(
                "# {field} is {}, its password not shown  # {origin}",
                shown(values, field)
            )
        }
        Ok(_) => format!("{field} = {}  # {origin}{range}", shown(values, field)),
    };
    format!("{meaning}{line}\n")
}

/// A value as TOML, with the password in a URL masked.
pub(super) fn shown(values: &Figment, field: &str) -> String {
    let value: Option<toml::Value> = values.find_value(field).ok().and_then(|value| value.deserialize().ok());
    match value {
        Some(toml::Value::String(text)) => toml::Value::String(masked(&text)).to_string(),
        Some(value) => value.to_string(),
        None => "not set".to_owned(),
    }
}

/// What would be right for a field.
pub(super) fn right(field: &str, kind: &Kind) -> String {
    match (field, kind) {
        ("bind", _) => "ADDRESS:PORT, as in 127.0.0.1:8642".to_owned(),
        (_, Kind::UnknownVariant(_, variants)) => variants.join(" or "),
        (_, Kind::InvalidType(_, expected) | Kind::InvalidValue(_, expected)) => {
            range(field).unwrap_or_else(|| expected.clone())
        }
        (_, other) => other.to_string(),
    }
}

fn range(field: &str) -> Option<String> {
    let bounds = ServerConfig::default().bounds();
    let (_, _, range) = bounds.iter().find(|(name, _, _)| *name == field)?;
    Some(format!("{} to {}", range.start(), range.end()))
}

/// `scheme://user:***@host/…?password=***`
fn masked(text: &str) -> String {
    let Some((scheme, rest)) = text.split_once("://") else {
        return text.to_owned();
    };
    let rest = match rest.rsplit_once('@') {
        Some((user, host)) if user.contains(':') => format!("{}:***@{host}", user.split(':').next().unwrap_or("")),
        _ => rest.to_owned(),
    };
    let rest = match rest.split_once("password=") {
        Some((before, after)) => {
            let others = after
                .split_once('&')
                .map_or_else(String::new, |(_, others)| format!("&{others}"));
            format!("{before}password=***{others}")
        }
        None => rest,
    };
    format!("{scheme}://{rest}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_passwords_of_a_url_are_masked() {
        assert_eq!(masked("postgres://ada:s3:cr@t@db/f"), "postgres://ada:***@db/f");
        assert_eq!(
            masked("postgres://db/f?password=x&ssl=1"),
            "postgres://db/f?password=***&ssl=1"
        );
        assert_eq!(masked("s3://bucket/prefix"), "s3://bucket/prefix");
        assert_eq!(masked("runs"), "runs");
    }
}
