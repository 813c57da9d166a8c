//! The names of models and data sets.

use std::borrow::Borrow;
use std::fmt;
use std::path::Path;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::ValueError;

/// Whether the name is safe as a directory name and in a URL: 1 to 64 of a–z, 0–9 and '-', not starting with '-'.
fn is_valid(name: &str) -> bool {
    let bytes = name.as_bytes();
    (1..=64).contains(&bytes.len())
        && bytes[0] != b'-'
        && bytes.iter().all(|b| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'-'))
}

/// A message quotes only the start of a long text.
fn not_a_name(text: &str) -> ValueError {
    const MOST: usize = 80;
    let start: String = text.chars().take(MOST).collect();
    let end = if start.len() < text.len() { "…" } else { "" };
    ValueError::Name(start + end)
}

macro_rules! name {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        pub struct $name(String);

        impl $name {
            /// The name as text.
            #[must_use]
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl TryFrom<String> for $name {
            type Error = ValueError;

            fn try_from(text: String) -> Result<Self, ValueError> {
                if is_valid(&text) { Ok(Self(text)) } else { Err(not_a_name(&text)) }
            }
        }

        impl FromStr for $name {
            type Err = ValueError;

            fn from_str(text: &str) -> Result<Self, ValueError> {
                text.to_owned().try_into()
            }
        }

        impl From<$name> for String {
            fn from(name: $name) -> Self {
                name.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Display::fmt(&self.0, f)
            }
        }

        /// In quotation marks, as in messages.
        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Debug::fmt(&self.0, f)
            }
        }

        impl Borrow<str> for $name {
            fn borrow(&self) -> &str {
                &self.0
            }
        }

        impl AsRef<Path> for $name {
            fn as_ref(&self) -> &Path {
                self.0.as_ref()
            }
        }

        impl PartialEq<str> for $name {
            fn eq(&self, text: &str) -> bool {
                self.0 == text
            }
        }

        impl PartialEq<&str> for $name {
            fn eq(&self, text: &&str) -> bool {
                self.0 == *text
            }
        }
    };
}

name!(
    /// The name of a model: 1 to 64 characters of a to z, 0 to 9 and `-`, not starting with `-`. So it can be a directory and
    /// a part of a URL.
    ModelName
);
name!(
    /// The name of a data set in the data directory, by the rule of a [`ModelName`].
    DatasetName
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_leaves_the_directory_is_refused() {
        for name in ["", ".", "..", "../x", "-x", "Paper", "a/b", "a b", "ä", &"a".repeat(65)] {
            assert!(name.parse::<ModelName>().is_err(), "{name:?} was accepted");
            assert!(
                serde_json::from_value::<DatasetName>(name.into()).is_err(),
                "{name:?} was accepted"
            );
        }
        let error = "a".repeat(1_000_000).parse::<ModelName>().unwrap_err().to_string();
        assert!(error.len() < 250 && error.contains("a…"), "{error}");
        assert_eq!("moving-2".parse::<ModelName>().unwrap(), "moving-2");
    }
}
