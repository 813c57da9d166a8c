//! Reads and writes `MessagePack`: structures are maps with the fields' names, images are binary. For streams and bodies.

use serde::de::{DeserializeOwned, IgnoredAny};
use serde::{Deserialize as _, Serialize};

/// The maximum depth of nesting; our messages have five levels.
const MAX_DEPTH: usize = 16;

/// Why bytes could not be read.
#[derive(Debug, thiserror::Error)]
pub(super) enum MsgpackError {
    /// Not `MessagePack`, or not such a value; names the field.
    #[error("{0}")]
    Invalid(#[from] serde_path_to_error::Error<rmp_serde::decode::Error>),
    #[error("bytes follow it")]
    Trailing,
}

impl MsgpackError {
    /// Whether it is `MessagePack`, but not the value that is wanted.
    pub(super) fn is_of_a_field(&self) -> bool {
        use rmp_serde::decode::Error;
        matches!(self, Self::Invalid(error) if !matches!(
            error.inner(),
            Error::InvalidMarkerRead(_) | Error::InvalidDataRead(_) | Error::DepthLimitExceeded
        ))
    }
}

/// Reads a value.
pub(super) fn read<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, MsgpackError> {
    // Borrows from the bytes, so that a length in them allocates nothing before its bytes are there.
    let mut deserializer = rmp_serde::Deserializer::from_read_ref(bytes);
    deserializer.set_max_depth(MAX_DEPTH);
    let value = serde_path_to_error::deserialize(&mut deserializer)?;
    // Only the end of the bytes gives this error; any other byte gives a value or another error.
    deserializer.set_max_depth(1);
    match IgnoredAny::deserialize(&mut deserializer) {
        Err(rmp_serde::decode::Error::InvalidMarkerRead(_)) => Ok(value),
        _ => Err(MsgpackError::Trailing),
    }
}

/// Writes a value.
pub(super) fn write<T: Serialize>(value: &T) -> Vec<u8> {
    rmp_serde::to_vec_named(value).expect("a value that is not MessagePack is a bug")
}
