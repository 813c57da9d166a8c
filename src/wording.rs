//! How errors are put to a person: with what caused them, in one sentence, and with the names there are.

use std::error::Error;
use std::fmt::Display;

/// The error and each of its causes, joined by colons; a cause that an error tells itself is not told twice.
#[must_use]
pub fn sentence(error: &dyn Error) -> String {
    let mut sentence = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let text = cause.to_string();
        if !sentence.contains(&text) {
            sentence = format!("{sentence}: {text}");
        }
        source = cause.source();
    }
    sentence
}

/// The items with commas between.
#[must_use]
pub fn listed<T: Display>(items: &[T]) -> String {
    items.iter().map(T::to_string).collect::<Vec<_>>().join(", ")
}

/// `are: a, b`, or `are none`: what follows "there" where a name was not known.
#[must_use]
pub(crate) fn those(names: &[String]) -> String {
    if names.is_empty() {
        "are none".to_owned()
    } else {
        format!("are: {}", listed(names))
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("could not write the file")]
    struct Silent(#[source] io::Error);

    #[derive(Debug, thiserror::Error)]
    #[error("the shard is lost: {0}")]
    struct Telling(#[source] Silent);

    #[test]
    fn every_cause_is_told_once() {
        let full = Silent(io::ErrorKind::StorageFull.into());
        assert_eq!(sentence(&full), "could not write the file: no storage space");
        assert_eq!(
            sentence(&Telling(full)),
            "the shard is lost: could not write the file: no storage space"
        );
    }
}
