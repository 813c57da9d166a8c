//! Writes and verifies the files of a data set.

use std::fs::{self, File};
use std::io;
use std::path::Path;

use sha2::{Digest, Sha256};

use super::DatasetError;
use crate::files::{self, hex};

/// Writes a file atomically. Creates its directory if it is missing. Errors: `Io`.
pub(super) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), DatasetError> {
    let directory = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(directory)
        .and_then(|()| files::write_atomically(path, bytes))
        .map_err(DatasetError::io("write", path))
}

/// The SHA-256 of a file in hexadecimal. Errors: `Io`.
pub(super) fn sha256_of_file(path: &Path) -> Result<String, DatasetError> {
    let mut hasher = Sha256::new();
    File::open(path)
        .and_then(|mut file| io::copy(&mut file, &mut hasher))
        .map_err(DatasetError::io("read", path))?;
    Ok(hex(&hasher.finalize()))
}

/// Errors: `HashDiffers` unless the file has this SHA-256 (hexadecimal).
pub(super) fn verify(path: &Path, expected: &str) -> Result<(), DatasetError> {
    let found = sha256_of_file(path)?;
    if found == expected {
        return Ok(());
    }
    Err(DatasetError::HashDiffers {
        path: path.to_owned(),
        expected: expected.to_owned(),
        found,
    })
}
