//! One file of an evaluation's directory.

use std::path::Path;

use super::EvaluationError;
use foreframe_core::files::write_atomically;

/// Writes the file: it is complete or absent. Errors: `Io`.
pub(super) fn save(path: &Path, bytes: &[u8]) -> Result<(), EvaluationError> {
    write_atomically(path, bytes).map_err(|source| EvaluationError::Io {
        path: path.to_owned(),
        source,
    })
}
