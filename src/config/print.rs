//! Settings as people read them.

use std::collections::HashMap;

use utoipa::PartialSchema as _;
use utoipa::openapi::{RefOr, Schema};

use super::{Config, range};
use crate::server::ServerConfig;
use foreframe_train::settings::LayeredSettings;

/// What each setting means, from its documentation.
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

/// The meaning of a setting, then `field = value  # origin; range`. A value with a hidden password is a comment, so that
/// it is not read back as the value.
pub(super) fn entry(values: &LayeredSettings, field: &str, meanings: &HashMap<String, String>) -> String {
    let meaning = meanings
        .get(field)
        .map_or_else(String::new, |meaning| format!("# {}\n", meaning.replace('\n', "\n# ")));
    let range = range(field).map_or_else(String::new, |range| format!("; {range}"));
    let origin = values.origin(field);
    let line = match values.value(field) {
        None => format!("# {field} is not set"),
        Some(toml::Value::String(text)) if masked(&text) != text => {
            let shown = toml::Value::String(masked(&text));
            format!("# {field} is {shown}, with the password hidden  # {origin}")
        }
        Some(value) => format!("{field} = {value}  # {origin}{range}"),
    };
    format!("{meaning}{line}\n")
}

/// The setting's value with its origin, for programs. A password in a URL is hidden.
pub(super) fn json_entry(values: &LayeredSettings, field: &str) -> serde_json::Value {
    let value = values.value(field).map(|value| match value {
        toml::Value::String(text) => toml::Value::String(masked(&text)),
        value => value,
    });
    serde_json::json!({"value": value, "origin": values.origin(field)})
}

/// `scheme://user:***@host/…?password=***`
fn masked(text: &str) -> String {
    let Some((scheme, rest)) = text.split_once("://") else {
        return text.to_owned();
    };
    let mut shown = rest.to_owned();
    if let Some((login, host)) = rest.rsplit_once('@')
        && let Some((user, _)) = login.split_once(':')
    {
        shown = format!("{user}:***@{host}");
    }
    if let Some((before, after)) = shown.split_once("password=") {
        let others = after.find('&').map_or("", |end| &after[end..]);
        shown = format!("{before}password=***{others}");
    }
    format!("{scheme}://{shown}")
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
