//! The data sets that jobs make and use: directories below `datasets`, in the data directory and in the object store.

use std::path::{Path, PathBuf};

use futures_util::{StreamExt as _, TryStreamExt as _, stream};
use tracing::warn;

use super::JobError;
use crate::store::{Author, Objects, Store};
use foreframe_core::types::DatasetName;
use foreframe_data::dataset::{self, DatasetInfo};

/// The file that is written last: it marks a complete data set.
pub(super) const LAST_FILE: &str = "info.json";
/// Concurrent requests to the object store.
const LOOKUPS: usize = 16;

/// The key of a data set's directory.
#[must_use]
pub(super) fn key(name: &DatasetName) -> String {
    format!("datasets/{name}")
}

/// The names of the finished data sets. With a shared object store, only that store counts. Errors: `Store`, `Dataset`.
pub async fn names(objects: &Objects) -> Result<Vec<DatasetName>, JobError> {
    let mut names = if objects.are_shared() {
        list_shared(objects).await?
    } else {
        let found = dataset::list(&objects.data_dir().join("datasets"))?.into_iter();
        found.filter_map(|name| name.parse().ok()).collect()
    };
    names.sort();
    Ok(names)
}

/// The finished data sets in the object store.
async fn list_shared(objects: &Objects) -> Result<Vec<DatasetName>, JobError> {
    let dirs = objects.directories("datasets").await?.into_iter();
    let finished = stream::iter(dirs.filter_map(|name| name.parse::<DatasetName>().ok()))
        .map(async |name| Ok::<_, JobError>(is_finished(objects, &name).await?.then_some(name)))
        .buffered(LOOKUPS)
        .try_collect::<Vec<_>>();
    Ok(finished.await?.into_iter().flatten().collect())
}

/// The local directory of a data set. With a shared object store, it is fetched from there unless the local copy is the
/// same. Errors: `NotFound` with the existing names, `Store`, `Dataset`.
pub async fn fetch(objects: &Objects, name: &DatasetName) -> Result<PathBuf, JobError> {
    if is_finished(objects, name).await? {
        let dir = objects.data_dir().join(key(name));
        if objects.are_shared() && !(dataset::is_finished(&dir) && is_current(objects, name).await?) {
            objects.pull_same(&key(name), dataset::METADATA, LAST_FILE).await?;
        }
        if dataset::is_finished(&dir) {
            return Ok(dir);
        }
    }
    Err(not_found(objects, name.to_string()).await?)
}

/// Whether the local data set is the same as the one in the object store.
async fn is_current(objects: &Objects, name: &DatasetName) -> Result<bool, JobError> {
    Ok(objects.is_same(&format!("{}/{}", key(name), dataset::METADATA)).await?)
}

/// Prepares the local directory of a data set that is to be made. With a shared object store, a local data set that `is_stale` is
/// deleted; it is told whether the data set was deleted in the store. The work itself reports everything else. Errors: `Store`,
/// `Dataset`.
pub(super) async fn clear_stale(
    objects: &Objects,
    name: &DatasetName,
    is_stale: impl FnOnce(bool) -> bool,
) -> Result<(), JobError> {
    if !objects.are_shared() {
        return Ok(());
    }
    if is_finished(objects, name).await? {
        return fetch(objects, name).await.map(drop);
    }
    let was_deleted = objects.data_dir().join(key(name)).join(dataset::METADATA).is_file();
    if is_stale(was_deleted) {
        objects.delete(&key(name)).await?;
    }
    Ok(())
}

/// Describes a finished data set without fetching it. Errors: `NotFound` with the existing names, `Store`, `Dataset`.
pub async fn describe(objects: &Objects, name: &DatasetName) -> Result<DatasetInfo, JobError> {
    if is_finished(objects, name).await? {
        let path = format!("{}/{}", key(name), dataset::METADATA);
        if let Some(text) = objects.read(&path).await? {
            return Ok(dataset::describe_metadata(Path::new(&path), &text)?);
        }
    }
    Err(not_found(objects, name.to_string()).await?)
}

/// Whether the data set is complete in the object store.
async fn is_finished(objects: &Objects, name: &DatasetName) -> Result<bool, JobError> {
    Ok(objects.has(&format!("{}/{}", key(name), dataset::INFO)).await?)
}

/// The name that a caller gave. Errors: `NotFound` with the existing names if it is no valid name, `Store`, `Dataset`.
pub async fn named(objects: &Objects, text: &str) -> Result<DatasetName, JobError> {
    match text.parse() {
        Ok(name) => Ok(name),
        Err(_) => Err(not_found(objects, text.to_owned()).await?),
    }
}

async fn not_found(objects: &Objects, name: String) -> Result<JobError, JobError> {
    let available = names(objects).await?;
    Ok(JobError::NotFound {
        field: "dataset",
        kind: "data set",
        name,
        available: available.iter().map(DatasetName::to_string).collect(),
    })
}

/// Deletes a data set, finished or not, and records it in the audit trail. Errors: `NotFound` with the existing names, `Store`,
/// `Dataset`.
pub async fn delete(store: &Store, name: &DatasetName, by: &Author) -> Result<(), JobError> {
    let objects = store.objects();
    if !exists(objects, name).await? {
        return Err(not_found(objects, name.to_string()).await?);
    }
    // Files are not part of a transaction, so the entry comes first.
    store.record_dataset_deletion(name, by).await?;
    let deleted = objects.delete(&key(name)).await;
    if deleted.is_err()
        && let Err(error) = store.record_failed_deletion(name, by).await
    {
        warn!(dataset = %name, %error, "could not record that a deletion failed");
    }
    Ok(deleted?)
}

/// Whether any part of the data set exists, locally or in the object store.
async fn exists(objects: &Objects, name: &DatasetName) -> Result<bool, JobError> {
    if objects.data_dir().join(key(name)).is_dir() {
        return Ok(true);
    }
    let shared = objects.directories("datasets").await?;
    Ok(shared.iter().any(|known| name == known.as_str()))
}
