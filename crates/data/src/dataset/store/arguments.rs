//! The directory of a data set that is being written: the arguments that determine its bytes are its first file, which is
//! locked while a process writes.

use std::fs::{self, File, TryLockError};
use std::io::ErrorKind;
use std::path::Path;

use serde::Serialize;
use serde_json::{Map, Value};

use super::files::{is_unused, pretty_json, write_atomically};
use super::layout::ARGUMENTS;
use crate::dataset::error::DatasetError;
use foreframe_core::files::{remove_stale_partials, try_lock};

/// The arguments that determine a data set's bytes, as they are written to its directory, with the version of the program.
pub(crate) fn arguments_text(arguments: &impl Serialize) -> String {
    #[derive(Serialize)]
    struct Versioned<'a, T> {
        program_version: &'static str,
        #[serde(flatten)]
        arguments: &'a T,
    }
    pretty_json(&Versioned {
        program_version: env!("CARGO_PKG_VERSION"),
        arguments,
    })
}

/// Whether a directory was begun with these arguments; false for an unused one. Errors: `OutExists`, `OtherArguments`, `Io`.
pub(crate) fn has_arguments(out: &Path, wanted: &str) -> Result<bool, DatasetError> {
    match read_arguments(out)? {
        Some(found) if found == wanted => Ok(true),
        Some(found) => Err(DatasetError::OtherArguments {
            path: out.to_owned(),
            differences: differences(&found, wanted),
        }),
        None if is_unused(out, ARGUMENTS)? => Ok(false),
        None => Err(DatasetError::OutExists(out.to_owned())),
    }
}

/// Writes the arguments to a new directory, and locks it while this process writes the data set. Errors: `Busy`, `Io`.
pub(crate) fn lock(out: &Path, arguments: &str) -> Result<File, DatasetError> {
    let path = out.join(ARGUMENTS);
    if !path.exists() {
        write_atomically(&path, arguments.as_bytes())?;
    }
    let lock = lock_file(&path, out)?;
    remove_stale_partials(out);
    Ok(lock)
}

/// Locks the file of the arguments of the data set in `out`. Errors: `Busy`, `Io`.
pub(crate) fn lock_file(path: &Path, out: &Path) -> Result<File, DatasetError> {
    let file = File::open(path).map_err(DatasetError::io("read", path))?;
    match try_lock(&file) {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(DatasetError::Busy(out.to_owned())),
        Err(TryLockError::Error(source)) => Err(DatasetError::io("lock", path)(source)),
    }
}

/// The arguments that a directory was begun with, if it was. Errors: `Io`.
pub(crate) fn read_arguments(out: &Path) -> Result<Option<String>, DatasetError> {
    let path = out.join(ARGUMENTS);
    match fs::read_to_string(&path) {
        Ok(text) => Ok(Some(text)),
        // If `out` is a file, `is_unused` reports it.
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(None),
        Err(error) => Err(DatasetError::io("read", &path)(error)),
    }
}

/// Every argument that differs, for example `trials: 5 in the directory, 6 requested`.
fn differences(found: &str, wanted: &str) -> String {
    // A damaged file has no arguments; then all of them differ.
    let object = |text: &str| serde_json::from_str::<Map<String, Value>>(text).unwrap_or_default();
    let (found, wanted) = (object(found), object(wanted));
    let text = |value: Option<&Value>| value.map_or_else(|| "none".to_owned(), Value::to_string);
    let differing = wanted.iter().filter(|(key, value)| found.get(*key) != Some(value));
    let differing = differing.map(|(key, value)| {
        let found = text(found.get(key));
        format!("{key}: {found} in the directory, {value} requested")
    });
    differing.collect::<Vec<_>>().join("; ")
}
