//! Copies of the data directory: the database in one consistent state, and all files that belong to it.
//!
//! The database is copied first. A version or data set that it knows is complete on disk at that time. If a file disappears
//! while the files are copied, the backup begins again, because the database may still know what was deleted.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io;
use std::path::{Component, Path, PathBuf};
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use super::{DATABASE_FILE, Store, StoreError, WRITE_PROBE, unix_s};
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::files::{files_below, is_hidden, is_partial, none_if_missing, write_atomically};

/// The list of files in a backup. It is written last, so a directory without it is no backup.
const INDEX_FILE: &str = "backup.json";
/// The file in a data directory that a restore has not finished.
pub(super) const RESTORING: &str = "restore-unfinished";
/// The form of backups that this program writes and reads.
const FORMAT: u32 = 1;
/// How often a backup begins again because files disappeared.
const ROUNDS: usize = 5;
/// How often the files are listed until two lists are equal.
const LISTS: usize = 100;
const LIST_AGAIN_AFTER: Duration = Duration::from_millis(50);

/// Why a backup could not be written or restored.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BackupError {
    /// The directory holds files.
    #[error("{} is not empty; name a new directory", .0.display())]
    NotEmpty(PathBuf),
    /// The backup would contain itself.
    #[error("{} is in the data directory {}; name a directory outside of it", path.display(), data_dir.display())]
    Inside {
        /// The directory.
        path: PathBuf,
        /// The data directory.
        data_dir: PathBuf,
    },
    /// The directory holds no complete backup.
    #[error("{} holds no complete backup ({INDEX_FILE} {reason})", path.display())]
    NoBackup {
        /// The directory.
        path: PathBuf,
        /// What is wrong with the list of files.
        reason: String,
    },
    /// A file of the backup is not as it was written.
    #[error("{} is damaged or missing; restore another backup", .0.display())]
    Damaged(PathBuf),
    /// The backup holds SQLite's database, but the settings name PostgreSQL.
    #[error("the backup holds an SQLite database, but database_url names PostgreSQL; restore it without database_url")]
    OtherDatabase,
    /// Another process restores into this data directory.
    #[error("another restore into {} is running; wait for its end", .0.display())]
    Restoring(PathBuf),
    /// Files of this data directory were deleted each time while they were copied.
    #[error("files in {} are being deleted all the time; try again later", .0.display())]
    Unstable(PathBuf),
    /// The database could not be copied, or a file could not be read or written.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl HasErrorKind for BackupError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::NoBackup { .. } => ErrorKind::NotFound,
            Self::Inside { .. } | Self::OtherDatabase => ErrorKind::Usage,
            Self::NotEmpty(_) | Self::Restoring(_) => ErrorKind::Conflict,
            Self::Damaged(_) => ErrorKind::Unusable,
            Self::Unstable(_) => ErrorKind::Busy,
            Self::Store(StoreError::Io { .. }) => ErrorKind::Internal,
            Self::Store(error) => error.kind().of_own_data(),
        }
    }
}

impl BackupError {
    pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self + use<> {
        let failed = StoreError::io(action, path);
        move |source| Self::Store(failed(source))
    }
}

/// What a backup holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BackupIndex {
    /// The form of the backup.
    pub format: u32,
    /// The version of the program that wrote it.
    pub program: String,
    /// When it was written, in seconds since 1970.
    pub created_unix_s: f64,
    /// Whether it holds the database. It does not if the database is PostgreSQL.
    pub has_database: bool,
    /// The files by their path in the data directory, with `/` between the parts.
    pub files: BTreeMap<String, BackupFile>,
}

/// A file of a backup.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BackupFile {
    /// Its size in bytes.
    pub bytes: u64,
    /// Its SHA-256.
    pub sha256: String,
}

impl BackupIndex {
    /// The size of all files in bytes.
    #[must_use]
    pub fn total_bytes(&self) -> u64 {
        self.files.values().map(|file| file.bytes).sum()
    }
}

impl Store {
    /// Writes a backup into a new or empty directory, also while servers use the store. It holds the data directory and, with
    /// SQLite, the database; not PostgreSQL, and not a shared object store. Errors: `NotEmpty`, `Inside`, `Unstable`, `Io`,
    /// `Store`.
    pub async fn back_up(&self, to: &Path) -> Result<BackupIndex, BackupError> {
        let data_dir = self.objects.data_dir();
        std::fs::create_dir_all(to).map_err(BackupError::io("make", to))?;
        let full = |path: &Path| std::fs::canonicalize(path).map_err(BackupError::io("read", path));
        if full(to)?.starts_with(full(data_dir)?) {
            let (path, data_dir) = (to.to_owned(), data_dir.to_owned());
            return Err(BackupError::Inside { path, data_dir });
        }
        if !is_empty_but(to, |_| false)? {
            return Err(BackupError::NotEmpty(to.to_owned()));
        }
        let mut copied = Copied::default();
        for _ in 0..ROUNDS {
            let database = to.join(DATABASE_FILE);
            none_if_missing(std::fs::remove_file(&database)).map_err(BackupError::io("delete", &database))?;
            let has_database = self.database.copy_to(&database).await?;
            let files = settled_files(data_dir).await?;
            copied.update(data_dir, to, &files)?;
            if !files.is_subset(&listed_files(data_dir)?) {
                continue;
            }
            let mut files = copied.into_files();
            if has_database {
                let synced = File::open(&database).and_then(|file| file.sync_all());
                let hashed = synced.and_then(|()| hash(&database));
                let file = hashed.map_err(BackupError::io("read", &database))?;
                files.insert(DATABASE_FILE.to_owned(), file);
            }
            let index = BackupIndex {
                format: FORMAT,
                program: env!("CARGO_PKG_VERSION").to_owned(),
                created_unix_s: unix_s(),
                has_database,
                files,
            };
            write_index(to, &index)?;
            return Ok(index);
        }
        Err(BackupError::Unstable(data_dir.to_owned()))
    }
}

/// The files that were copied, with the time of their last change.
#[derive(Default)]
struct Copied(BTreeMap<PathBuf, (SystemTime, BackupFile)>);

impl Copied {
    /// Copies what is new or has changed, and deletes what has disappeared.
    fn update(&mut self, from: &Path, to: &Path, files: &BTreeSet<PathBuf>) -> Result<(), BackupError> {
        for (file, _) in self.0.extract_if(.., |file, _| !files.contains(file)) {
            let path = to.join(file);
            std::fs::remove_file(&path).map_err(BackupError::io("delete", &path))?;
        }
        for file in files {
            let source = from.join(file);
            let metadata = none_if_missing(std::fs::metadata(&source)).map_err(BackupError::io("read", &source))?;
            // A file that disappears now is noticed by the caller.
            let Some(metadata) = metadata else { continue };
            let changed = metadata.modified().map_err(BackupError::io("read", &source))?;
            let is_copied = |(time, copy): &(SystemTime, BackupFile)| *time == changed && copy.bytes == metadata.len();
            if self.0.get(file).is_some_and(is_copied) {
                continue;
            }
            let copied = none_if_missing(copy(&source, &to.join(file))).map_err(BackupError::io("copy", &source))?;
            if let Some(copied) = copied {
                self.0.insert(file.clone(), (changed, copied));
            }
        }
        Ok(())
    }

    /// The files by their names in the backup.
    fn into_files(self) -> BTreeMap<String, BackupFile> {
        let named = |(file, (_, copied)): (PathBuf, _)| (file.to_string_lossy().replace('\\', "/"), copied);
        self.0.into_iter().map(named).collect()
    }
}

/// The files below the data directory that do not change while they are listed.
async fn settled_files(data_dir: &Path) -> Result<BTreeSet<PathBuf>, BackupError> {
    let mut before = listed_files(data_dir)?;
    for _ in 0..LISTS {
        // Else the last file of a data set could be in the list without one that was written a moment before.
        let now = listed_files(data_dir)?;
        if now == before {
            return Ok(now);
        }
        before = now;
        tokio::time::sleep(LIST_AGAIN_AFTER).await;
    }
    Err(BackupError::Unstable(data_dir.to_owned()))
}

/// The files that belong to a backup, by their path below the data directory.
fn listed_files(data_dir: &Path) -> Result<BTreeSet<PathBuf>, BackupError> {
    for _ in 0..LISTS {
        let files = none_if_missing(files_below(data_dir)).map_err(BackupError::io("list", data_dir))?;
        // Otherwise a directory was deleted while it was listed.
        if let Some(files) = files {
            let below = |path: PathBuf| path.strip_prefix(data_dir).ok().map(Path::to_owned);
            let files = files.into_iter().filter_map(below);
            return Ok(files.filter(|file| is_kept(file)).collect());
        }
    }
    Err(BackupError::Unstable(data_dir.to_owned()))
}

/// Not the database, which is copied by itself, and not what belongs to a process.
fn is_kept(file: &Path) -> bool {
    let text = file.to_string_lossy();
    let is_passing = is_partial(file) || file.extension().is_some_and(|part| part == "lock" || part == "tmp");
    !(is_passing || is_hidden(file) || text.starts_with(DATABASE_FILE) || text == WRITE_PROBE || text == RESTORING)
}

/// The path of a name from the list of files, if it stays in the directory.
pub(super) fn inside(dir: &Path, name: &str) -> Option<PathBuf> {
    let mut parts = Path::new(name).components();
    parts
        .all(|part| matches!(part, Component::Normal(_)))
        .then(|| dir.join(name))
}

/// Whether a directory holds nothing but what may be ignored.
pub(super) fn is_empty_but(dir: &Path, is_ignored: impl Fn(&PathBuf) -> bool) -> Result<bool, BackupError> {
    let entries = std::fs::read_dir(dir).and_then(Iterator::collect::<io::Result<Vec<_>>>);
    let entries = entries.map_err(BackupError::io("read", dir))?;
    Ok(entries.iter().all(|entry| is_ignored(&entry.path())))
}

/// Copies a file, with its directory, and reports what was copied.
pub(super) fn copy(from: &Path, to: &Path) -> io::Result<BackupFile> {
    let mut source = File::open(from)?;
    std::fs::create_dir_all(to.parent().unwrap_or(to))?;
    let mut target = File::create(to)?;
    io::copy(&mut source, &mut target)?;
    target.sync_all()?;
    hash(to)
}

fn hash(path: &Path) -> io::Result<BackupFile> {
    let mut digest = Sha256::new();
    let bytes = io::copy(&mut File::open(path)?, &mut digest)?;
    let sha256 = format!("{:x}", digest.finalize());
    Ok(BackupFile { bytes, sha256 })
}

fn write_index(to: &Path, index: &BackupIndex) -> Result<(), BackupError> {
    let path = to.join(INDEX_FILE);
    let text = serde_json::to_vec_pretty(index).map_err(io::Error::other);
    let written = text.and_then(|text| write_atomically(&path, &text));
    written.map_err(BackupError::io("write", &path))
}

pub(super) fn read_index(from: &Path) -> Result<BackupIndex, BackupError> {
    let path = from.join(INDEX_FILE);
    let text = none_if_missing(std::fs::read(&path)).map_err(BackupError::io("read", &path))?;
    let text = text.ok_or_else(|| no_backup(from, "is missing"))?;
    let index: BackupIndex = serde_json::from_slice(&text).map_err(|error| no_backup(from, &error.to_string()))?;
    if index.format != FORMAT {
        let reason = format!("says format {}; this program reads format {FORMAT}", index.format);
        return Err(no_backup(from, &reason));
    }
    Ok(index)
}

pub(super) fn no_backup(path: &Path, reason: &str) -> BackupError {
    BackupError::NoBackup {
        path: path.to_owned(),
        reason: reason.to_owned(),
    }
}
