//! The data sets that jobs make and use: directories below `datasets`, here and where objects are kept.

use std::path::{Path, PathBuf};

use futures_util::{StreamExt as _, TryStreamExt as _, stream};

use super::JobError;
use crate::dataset::{self, CollectConfig, CollectionStatus, DatasetError, DatasetInfo};
use crate::registry::is_valid_name;
use crate::store::Objects;

/// The file that says that a data set is whole.
pub(super) const LAST_FILE: &str = "info.json";
/// Questions to where objects are kept at a time.
const LOOKUPS: usize = 16;

/// A data set's directory among the objects.
#[must_use]
pub(super) fn key(name: &str) -> String {
    format!("datasets/{name}")
}

/// The finished data sets, by name: where objects are shared, those kept there, whatever is here.
/// Errors: `Store`, `Dataset`.
pub async fn names(objects: &Objects) -> Result<Vec<String>, JobError> {
    let mut names = if objects.are_shared() {
        kept(objects).await?
    } else {
        dataset::list(&objects.data_dir().join("datasets"))?
    };
    names.retain(|name| is_valid_name(name));
    names.sort();
    Ok(names)
}

/// The finished data sets where objects are kept.
async fn kept(objects: &Objects) -> Result<Vec<String>, JobError> {
    let dirs = objects.directories("datasets").await?.into_iter();
    let finished = stream::iter(dirs.filter(|name| is_valid_name(name)))
        .map(async |name| Ok::<_, JobError>(is_kept(objects, &name).await?.then_some(name)))
        .buffered(LOOKUPS)
        .try_collect::<Vec<_>>();
    Ok(finished.await?.into_iter().flatten().collect())
}

/// The directory of a data set in the data directory, fetched there if need be: where objects are shared, it is the one
/// kept there. Errors: `NotFound` with the names there are, `Store`, `Dataset`.
pub async fn fetch(objects: &Objects, name: &str) -> Result<PathBuf, JobError> {
    if is_valid_name(name) && is_kept(objects, name).await? {
        let dir = objects.data_dir().join(key(name));
        if objects.are_shared() && !(dataset::is_finished(&dir) && is_current(objects, name).await?) {
            objects.pull_same(&key(name), dataset::METADATA, LAST_FILE).await?;
        }
        if dataset::is_finished(&dir) {
            return Ok(dir);
        }
    }
    Err(unknown(objects, name).await?)
}

/// Whether the data set here is the one kept where objects are.
async fn is_current(objects: &Objects, name: &str) -> Result<bool, JobError> {
    Ok(objects.is_same(&format!("{}/{}", key(name), dataset::METADATA)).await?)
}

/// Has the data directory hold nothing else under the name of a data set that is to be collected: where objects are shared,
/// the set that is kept there, or what was begun with the same arguments. Errors: `Store`, `Dataset`.
pub(super) async fn make_way(objects: &Objects, name: &str, config: &CollectConfig) -> Result<(), JobError> {
    if !objects.are_shared() {
        return Ok(());
    }
    if is_kept(objects, name).await? {
        return fetch(objects, name).await.map(drop);
    }
    let is_of_a_deleted_set = config.out.join(dataset::METADATA).is_file();
    match CollectionStatus::of(config) {
        Err(DatasetError::OutExists { .. }) if is_of_a_deleted_set => Ok(objects.delete(&key(name)).await?),
        Err(DatasetError::OtherArguments { .. }) => Ok(objects.delete(&key(name)).await?),
        // What else is wrong comes to light when it is collected.
        _ => Ok(()),
    }
}

/// What a finished data set is, without fetching it. Errors: `NotFound` with the names there are, `Store`, `Dataset`.
pub async fn describe(objects: &Objects, name: &str) -> Result<DatasetInfo, JobError> {
    if is_valid_name(name) && is_kept(objects, name).await? {
        let path = format!("{}/{}", key(name), dataset::METADATA);
        if let Some(text) = objects.read(&path).await? {
            return Ok(dataset::describe_metadata(Path::new(&path), &text)?);
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
