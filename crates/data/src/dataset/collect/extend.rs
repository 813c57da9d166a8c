//! A collection that grows: the same arguments with more trials.

use std::fs;

use serde_json::{Map, Value};

use super::config::CollectConfig;
use crate::dataset::DatasetError;
use crate::dataset::store::arguments::{arguments_text, lock_file, read_arguments};
use crate::dataset::store::files::write_atomically;
use crate::dataset::store::layout::{ARGUMENTS, INFO, METADATA};

/// Prepares the directory for more trials if it holds the same collection with fewer: then it is like one that was stopped. A
/// collection of the first trials is the beginning of one with more, so the result is the same as if all were collected at once.
/// Errors: `Busy`, `Io`.
pub(super) fn extend(config: &CollectConfig) -> Result<(), DatasetError> {
    let (out, wanted) = (&config.out, arguments_text(config));
    let Some(found) = read_arguments(out)? else {
        return Ok(());
    };
    if !has_fewer_trials(&found, &wanted) {
        return Ok(());
    }
    // The file is replaced, so the old one is locked first: another process may still write these trials.
    let path = out.join(ARGUMENTS);
    let _lock = lock_file(&path, out)?;
    // Without its description, the directory is no complete data set until the new trials are there.
    for file in [INFO, METADATA].map(|name| out.join(name)) {
        if file.exists() {
            fs::remove_file(&file).map_err(DatasetError::io("delete", &file))?;
        }
    }
    write_atomically(&path, wanted.as_bytes())
}

/// Whether the arguments are the same, but for fewer trials.
fn has_fewer_trials(found: &str, wanted: &str) -> bool {
    let object = |text: &str| serde_json::from_str::<Map<String, Value>>(text).ok();
    let (Some(mut found), Some(mut wanted)) = (object(found), object(wanted)) else {
        return false;
    };
    let trials = |arguments: &mut Map<String, Value>| arguments.remove("trials").and_then(|count| count.as_u64());
    let is_fewer = trials(&mut found) < trials(&mut wanted);
    is_fewer && found == wanted
}
