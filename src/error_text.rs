//! Texts of errors for people: an error with its causes in one line, and lists of names.

use std::error::Error;
use std::fmt::Display;

/// The error and all its causes, joined by colons. A cause that the text already contains is not repeated.
#[must_use]
pub fn with_causes(error: &dyn Error) -> String {
    let mut joined = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let text = cause.to_string();
        if !joined.contains(&text) {
            joined = format!("{joined}: {text}");
        }
        source = cause.source();
    }
    joined
}

/// The text as a terminal may show it: control characters other than line breaks and tabs are written as escapes, which JSON
/// and TOML understand too. Names from a recording could otherwise change what is on the screen.
#[must_use]
pub fn printable(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for character in text.chars() {
        if character.is_control() && !['\n', '\t'].contains(&character) {
            let escape = format!("\\u{:04x}", u32::from(character));
            shown.push_str(&escape);
        } else {
            shown.push(character);
        }
    }
    shown
}

/// The items, separated by commas.
#[must_use]
pub fn comma_separated<T: Display>(items: &[T]) -> String {
    items.iter().map(T::to_string).collect::<Vec<_>>().join(", ")
}

/// `are: a, b` or `are none`. Messages about an unknown name write it after "there".
#[must_use]
pub(crate) fn existing(names: &[String]) -> String {
    if names.is_empty() {
        "are none".to_owned()
    } else {
        format!("are: {}", comma_separated(names))
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("could not write the file")]
    struct WithoutCause(#[source] io::Error);

    #[derive(Debug, thiserror::Error)]
    #[error("the shard is lost: {0}")]
    struct WithCause(#[source] WithoutCause);

    #[test]
    fn control_characters_are_shown_as_escapes() {
        assert_eq!(printable("a\u{1b}[2Jü\tb\r\n"), "a\\u001b[2Jü\tb\\u000d\n");
    }

    #[test]
    fn every_cause_appears_once() {
        let full = WithoutCause(io::ErrorKind::StorageFull.into());
        assert_eq!(with_causes(&full), "could not write the file: no storage space");
        assert_eq!(
            with_causes(&WithCause(full)),
            "the shard is lost: could not write the file: no storage space"
        );
    }
}
