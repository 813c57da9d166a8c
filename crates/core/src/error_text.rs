//! Texts of errors for people: an error with its causes in one line, and lists of names.

use std::collections::VecDeque;
use std::error::Error;
use std::fmt::{self, Display, Write};

/// The maximum length of a shortened text in bytes, without the mark of what was left out.
const MAX_SHORTENED_BYTES: usize = 1000;

/// The error and all its causes, joined by colons. A cause that the text already contains is not repeated.
#[must_use]
pub fn with_causes(error: &dyn Error) -> String {
    let mut joined = error.to_string();
    for cause in std::iter::successors(error.source(), |&cause| cause.source()) {
        let text = cause.to_string();
        if !joined.contains(&text) {
            joined = format!("{joined}: {text}");
        }
    }
    joined
}

/// The text; if it has more than 1000 bytes, its beginning and its end: an error may quote a long value that a client sent. Never
/// holds the whole text.
#[must_use]
pub fn without_middle(text: &dyn Display) -> String {
    let mut ends = Ends::default();
    // Nothing but a `Display` that fails gives an error here; what it wrote before is kept.
    let _ = write!(ends, "{text}");
    let mark = if ends.is_middle_lost { " … " } else { "" };
    format!("{}{mark}{}", ends.head, String::from_iter(ends.tail))
}

/// The beginning and the end of what is written into it.
#[derive(Default)]
struct Ends {
    head: String,
    tail: VecDeque<char>,
    tail_bytes: usize,
    is_middle_lost: bool,
}

impl Write for Ends {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        text.chars().try_for_each(|character| self.write_char(character))
    }

    fn write_char(&mut self, character: char) -> fmt::Result {
        let length = character.len_utf8();
        if self.tail.is_empty() && self.head.len() + length <= MAX_SHORTENED_BYTES / 2 {
            self.head.push(character);
            return Ok(());
        }
        self.tail.push_back(character);
        self.tail_bytes += length;
        while self.tail_bytes > MAX_SHORTENED_BYTES / 2 {
            self.tail_bytes -= self.tail.pop_front().map_or(0, char::len_utf8);
            self.is_middle_lost = true;
        }
        Ok(())
    }
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
pub fn existing(names: &[impl Display]) -> String {
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
    fn a_long_text_keeps_its_beginning_and_its_end() {
        assert_eq!(without_middle(&"short"), "short");
        let whole = "ä".repeat(MAX_SHORTENED_BYTES / 2);
        assert_eq!(without_middle(&whole), whole);
        for length in [1000, 1001, 100_000] {
            let long = without_middle(&format_args!("unknown field `{}` at line {}", "ä".repeat(length), 1));
            assert!(
                long.len() < MAX_SHORTENED_BYTES + 10 && long.starts_with("unknown field `ä"),
                "{long}"
            );
            assert!(long.contains("ä … ä") && long.ends_with("ä` at line 1"), "{long}");
        }
        let in_pieces = fmt::from_fn(|f| (0..2000).try_for_each(|number| write!(f, "{number},")));
        assert_eq!(without_middle(&in_pieces), without_middle(&in_pieces.to_string()));
    }

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
