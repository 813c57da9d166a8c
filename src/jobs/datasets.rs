//! The data sets that jobs make and use: directories below `datasets`, here and where objects are kept.

use std::path::{Path, PathBuf};

use super::JobError;
use crate::dataset::{self, DatasetInfo};
use crate::registry::is_valid_name;
use crate::store::Objects;

/// The file that says that a data set is whole.
pub(super) const LAST_FILE: &str = "info.json";

/// A data set's directory among the objects.
#[must_use]
pub(super) fn key(name: &str) -> String {
    format!("datasets/{name}")
}

/// The finished data sets, by name. Errors: `Store`, `Dataset`.
pub async fn names(objects: &Objects) -> Result<Vec<String>, JobError> {
    let mut names = objects.directories("datasets").await?;
    names.extend(dataset::list(&objects.data_dir().join("datasets"))?);
    names.retain(|name| is_valid_name(name));
    names.sort();
    names.dedup();
    Ok(names)
}

/// The directory of a data set in the data directory, fetched there if need be.
/// Errors: `NotFound` with the names there are, `Store`, `Dataset`.
pub async fn fetch(objects: &Objects, name: &str) -> Result<PathBuf, JobError> {
    if is_valid_name(name) {
        let dir = objects.data_dir().join(key(name));
        if !dataset::is_finished(&dir) {
            objects.pull(&key(name), LAST_FILE).await?;
        }
        if dataset::is_finished(&dir) {
            return Ok(dir);
        }
    }
    Err(unknown(objects, name).await?)
}

/// What a finished data set is, without fetching it. Errors: `NotFound` with the names there are, `Store`, `Dataset`.
pub async fn describe(objects: &Objects, name: &str) -> Result<DatasetInfo, JobError> {
    if is_valid_name(name) && is_kept(objects, name).await? {
        let path = format!("{}/{}", key(name), dataset::STAMP);
        if let Some(text) = objects.read(&path).await? {
            return Ok(dataset::describe_stamp(Path::new(&path), &text)?);
        }
    }
    Err(unknown(objects, name).await?)
}

/// Whether the data set lies, finished, where objects are kept.
async fn is_kept(objects: &Objects, name: &str) -> Result<bool, JobError> {
    Ok(objects.has(&format!("{}/{}", key(name), dataset::INFO)).await?)
}

async fn unknown(objects: &Objects, name: &str) -> Result<JobError, JobError> {
    Ok(JobError::NotFound {
        field: "dataset",
        kind: "data set",
        name: name.to_owned(),
        known: names(objects).await?,
    })
}

/// Deletes a data set, finished or not. Errors: `NotFound` with the names there are, `Store`, `Dataset`.
pub async fn delete(objects: &Objects, name: &str) -> Result<(), JobError> {
    if is_valid_name(name) && is_begun(objects, name).await? {
        return Ok(objects.delete(&key(name)).await?);
    }
    Err(unknown(objects, name).await?)
}

/// Whether anything of the data set is there, here or where objects are kept.
async fn is_begun(objects: &Objects, name: &str) -> Result<bool, JobError> {
    let is_here = objects.data_dir().join(key(name)).is_dir();
    Ok(is_here || objects.directories("datasets").await?.iter().any(|known| known == name))
}
