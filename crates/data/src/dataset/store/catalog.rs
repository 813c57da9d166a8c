//! Finds data sets by name in a directory.

use std::path::{Path, PathBuf};

use super::layout::INFO;
use crate::dataset::error::DatasetError;
use foreframe_core::error_text::existing;

/// Whether a directory holds a finished data set. The file that it checks is written last.
#[must_use]
pub fn is_finished(dir: &Path) -> bool {
    dir.join(INFO).is_file()
}

/// Names of the finished data sets in a directory, sorted. A missing directory contains none. Errors: `Io`.
pub fn list(datasets_dir: &Path) -> Result<Vec<String>, DatasetError> {
    if !datasets_dir.exists() {
        return Ok(Vec::new());
    }
    let list_failed = DatasetError::io("list", datasets_dir);
    let entries = std::fs::read_dir(datasets_dir).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let mut names: Vec<String> = entries
        .map_err(list_failed)?
        .into_iter()
        .filter(|entry| is_finished(&entry.path()))
        .filter_map(|entry| entry.file_name().into_string().ok())
        // A data set that is being deleted has a hidden name.
        .filter(|name| !name.starts_with('.'))
        .collect();
    names.sort();
    Ok(names)
}

/// The directory of a data set that the user gave as a path or as a name below `datasets_dir`. A path is tried first. The
/// data set may be unfinished. Errors: `NotFound`, with the existing names; `Io`.
pub fn find(datasets_dir: &Path, what: &Path) -> Result<PathBuf, DatasetError> {
    if what.join("meta").is_dir() {
        return Ok(what.to_owned());
    }
    let is_name = what.file_name() == Some(what.as_os_str());
    let named = datasets_dir.join(what);
    if is_name && named.is_dir() {
        return Ok(named);
    }
    if !is_name || what.exists() {
        return Err(DatasetError::no_dataset(what));
    }
    Err(DatasetError::NotFound(format!(
        "there is no data set {:?} in {}; there {}; `foreframe collect` creates one",
        what.display().to_string(),
        datasets_dir.display(),
        existing(&list(datasets_dir)?)
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_sets_are_found_by_path_or_name() {
        let dir = tempfile::tempdir().unwrap();
        let datasets = dir.path().join("datasets");
        for name in ["b", "a", "unfinished"] {
            std::fs::create_dir_all(datasets.join(name).join("meta")).unwrap();
        }
        for name in ["b", "a"] {
            std::fs::write(datasets.join(name).join(INFO), "{}").unwrap();
        }
        let found = |what: &Path| find(&datasets, what).map_err(|error| error.to_string());
        assert_eq!(found(Path::new("a")), Ok(datasets.join("a")));
        assert_eq!(found(&datasets.join("b")), Ok(datasets.join("b")));
        assert_eq!(found(Path::new("unfinished")), Ok(datasets.join("unfinished")));
        let unknown = found(Path::new("c")).unwrap_err();
        assert!(
            unknown.contains("no data set \"c\"") && unknown.contains("there are: a, b"),
            "{unknown}"
        );
        let empty = found(dir.path()).unwrap_err();
        assert!(empty.contains("holds no data set"), "{empty}");
    }
}
