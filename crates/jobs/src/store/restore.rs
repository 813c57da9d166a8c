//! Restores a backup. A restore that was killed is noticed by a marker in the data directory, and finished by the next one.

use std::collections::BTreeSet;
use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::backup::{BackupError, BackupIndex, RESTORING, copy, inside, is_empty_but, no_backup, read_index};
use super::{DATABASE_FILE, StoreConfig};
use foreframe_core::files::{is_partial_of, none_if_missing, open_lock, remove_partials, try_lock, write_atomically};

/// The file that is locked while a restore runs.
const RESTORE_LOCK: &str = "restore.lock";

/// Restores a backup into a new or empty data directory. No server may use the directory meanwhile. Errors: `NoBackup`,
/// `Damaged`, `NotEmpty`, `Restoring`, `OtherDatabase`, `Io`, `Store`.
pub fn restore(from: &Path, config: &StoreConfig) -> Result<BackupIndex, BackupError> {
    let index = read_index(from)?;
    let data_dir = &config.data_dir;
    let database = config.database_file()?;
    if index.has_database && database.is_none() {
        return Err(BackupError::OtherDatabase);
    }
    std::fs::create_dir_all(data_dir).map_err(BackupError::io("make", data_dir))?;
    let absolute = |path: &Path| std::path::absolute(path).map_err(BackupError::io("find", path));
    let data_dir = &absolute(data_dir)?;
    let database = database.map(|path| absolute(&path)).transpose()?;
    let _lock = RestoreLock::take(data_dir)?;
    let marker = begin_restore(data_dir, database.as_deref(), &index)?;
    for (name, expected) in &index.files {
        let places = inside(from, name).zip(restored_path(data_dir, database.as_deref(), name));
        let (source, to) = places.ok_or_else(|| no_backup(from, "names a file outside of it"))?;
        let found = none_if_missing(copy(&source, &to)).map_err(BackupError::io("copy", &source))?;
        if found.as_ref() != Some(expected) {
            return Err(BackupError::Damaged(source));
        }
    }
    remove_partials(data_dir);
    std::fs::remove_file(&marker).map_err(BackupError::io("delete", &marker))?;
    Ok(index)
}

/// What an unfinished restore copies: the content of its marker.
#[derive(Default, Serialize, Deserialize)]
struct UnfinishedRestore {
    /// Where the database is restored.
    database: Option<PathBuf>,
    /// The files that are copied, by their names in the backup.
    files: BTreeSet<String>,
}

/// The lock of a directory that is being restored. Dropping it removes its file.
struct RestoreLock {
    path: PathBuf,
    _file: File,
}

impl RestoreLock {
    /// Errors: `Restoring`, `Io`.
    fn take(data_dir: &Path) -> Result<Self, BackupError> {
        let path = data_dir.join(RESTORE_LOCK);
        let file = open_lock(&path).map_err(BackupError::io("open", &path))?;
        match try_lock(&file) {
            Ok(()) => Ok(Self { path, _file: file }),
            Err(TryLockError::WouldBlock) => Err(BackupError::Restoring(data_dir.to_owned())),
            Err(TryLockError::Error(source)) => Err(BackupError::io("lock", &path)(source)),
        }
    }
}

impl Drop for RestoreLock {
    fn drop(&mut self) {
        // A file that stays is no lock.
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Marks the directory as one that is being restored, and removes what an earlier restore that did not finish has written there.
/// Returns the marker. Errors: `NotEmpty`, `Io`.
fn begin_restore(data_dir: &Path, database: Option<&Path>, index: &BackupIndex) -> Result<PathBuf, BackupError> {
    let marker = data_dir.join(RESTORING);
    let is_taken = |path: &Path| BackupError::NotEmpty(path.to_owned());
    let is_begun = marker.exists();
    let text = none_if_missing(std::fs::read(&marker)).map_err(BackupError::io("read", &marker))?;
    // An empty marker: no file was copied yet. An older version's marker holds a sentence: its files are not known, and those
    // that this backup does not replace stay.
    let unfinished: UnfinishedRestore = serde_json::from_slice(&text.unwrap_or_default()).unwrap_or_default();
    let is_own = |path: &Path| is_begun && (path.starts_with(data_dir) || unfinished.database.as_deref() == Some(path));
    if let Some(path) = database.filter(|path| path.exists() && !is_own(path)) {
        return Err(is_taken(path));
    }
    if !is_begun {
        // Older versions wrote the marker under another name first, and left it there if they were killed.
        let is_left = |path: &PathBuf| is_partial_of(&marker, path) || path.ends_with(RESTORE_LOCK);
        if !is_empty_but(data_dir, is_left)? {
            return Err(is_taken(data_dir));
        }
        // The first step in the directory: whatever is killed after it, the directory is known as unfinished.
        let created = File::create_new(&marker).and_then(|file| file.sync_all());
        created.map_err(BackupError::io("write", &marker))?;
    }
    // A database elsewhere can be in use by now.
    let may_be_deleted = |path: &PathBuf| path.starts_with(data_dir) || database == Some(path);
    let path_of = |name: &String| restored_path(data_dir, unfinished.database.as_deref(), name).filter(may_be_deleted);
    let stale: Vec<PathBuf> = unfinished.files.iter().filter_map(path_of).collect();
    let now = UnfinishedRestore {
        database: database.map(Path::to_owned),
        files: unfinished.files.iter().chain(index.files.keys()).cloned().collect(),
    };
    let text = serde_json::to_vec(&now).map_err(io::Error::other);
    let written = text.and_then(|text| write_atomically(&marker, &text));
    written.map_err(BackupError::io("write", &marker))?;
    for path in stale {
        none_if_missing(std::fs::remove_file(&path)).map_err(BackupError::io("delete", &path))?;
    }
    Ok(marker)
}

/// Where a file of a backup is restored; `None` if that would be outside of the data directory.
fn restored_path(data_dir: &Path, database: Option<&Path>, name: &str) -> Option<PathBuf> {
    match database {
        Some(database) if name == DATABASE_FILE => Some(database.to_owned()),
        _ => inside(data_dir, name),
    }
}
