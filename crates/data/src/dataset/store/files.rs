//! Writes and verifies the files of a data set.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use serde::Serialize;
use sha2::{Digest, Sha256};

use crate::dataset::error::DatasetError;
use foreframe_core::files::{self, is_partial_of};

/// Writes a file atomically. Creates its directory if it is missing. Errors: `Io`.
pub(crate) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), DatasetError> {
    let directory = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(directory)
        .and_then(|()| files::write_atomically(path, bytes))
        .map_err(DatasetError::io("write", path))
}

/// A value as JSON in one line.
pub(crate) fn json_text(value: &impl Serialize) -> String {
    serde_json::to_string(value).expect("a value without JSON is a bug")
}

/// A value as JSON with line breaks.
pub(crate) fn pretty_json(value: &impl Serialize) -> String {
    serde_json::to_string_pretty(value).expect("a value without JSON is a bug") + "\n"
}

/// Writes a file that appears when it is whole. Creates its directory if it is missing. `write` gets the name of the file to
/// write, which ends with `ending`. Errors: `Io`, and those of `write`.
pub(crate) fn write_whole(
    path: &Path,
    ending: &str,
    write: impl FnOnce(&Path) -> Result<(), DatasetError>,
) -> Result<(), DatasetError> {
    let directory = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(directory).map_err(DatasetError::io("make", directory))?;
    let partial = path.with_extension(ending);
    let written = write(&partial).and_then(|()| fs::rename(&partial, path).map_err(DatasetError::io("write", path)));
    if written.is_err() {
        // A later run overwrites it if it stays.
        let _ = fs::remove_file(&partial);
    }
    written
}

/// Whether a directory is missing, empty, or contains only what was left by a program that was killed while it wrote the first
/// file, `meta/…`. Errors: `Io`.
pub(crate) fn is_unused(out: &Path, first: &str) -> Result<bool, DatasetError> {
    if !out.exists() {
        return Ok(true);
    }
    if !out.is_dir() {
        return Ok(false);
    }
    let names = |path: &Path| -> Result<Vec<PathBuf>, DatasetError> {
        fs::read_dir(path)
            .and_then(Iterator::collect::<Result<Vec<_>, _>>)
            .map(|entries| entries.iter().map(fs::DirEntry::path).collect())
            .map_err(DatasetError::io("read", path))
    };
    for path in names(out)? {
        let is_meta = path == out.join("meta") && path.is_dir();
        let only_half = is_meta && names(&path)?.iter().all(|inner| is_partial_of(&out.join(first), inner));
        if !only_half {
            return Ok(false);
        }
    }
    Ok(true)
}

/// The SHA-256 of a file in hexadecimal. Errors: `Io`.
pub(crate) fn sha256_of_file(path: &Path) -> Result<String, DatasetError> {
    let mut hasher = Sha256::new();
    File::open(path)
        .and_then(|mut file| io::copy(&mut file, &mut hasher))
        .map_err(DatasetError::io("read", path))?;
    Ok(format!("{:x}", hasher.finalize()))
}

/// Errors: `HashDiffers` unless the file has this SHA-256 (hexadecimal).
pub(crate) fn verify(path: &Path, expected: &str) -> Result<(), DatasetError> {
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
