//! Writes what an archive holds below one folder, with bounds: no path leads out, nothing is written twice, and neither the number
//! of files nor their size exceeds a limit.

use std::fmt::Display;
use std::fs::{self, File};
use std::io::{ErrorKind, Read, Write as _};
use std::path::{Component, Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use crate::dataset::import::{ImportConfig, ImportError};

/// Bytes that are written at once.
const PIECE_BYTES: usize = 1 << 18;
/// The longest path in an archive, in bytes, and the most folders in it: each can make a folder on the disk.
const MAX_PATH_BYTES: usize = 1024;
const MAX_PATH_PARTS: usize = 32;
/// The most folders: a recording has few, and to delete very many takes long.
const MAX_FOLDERS: u64 = 20_000;
/// What some systems add to every archive beside the files of its maker.
const FOREIGN: [&str; 2] = ["__MACOSX", ".DS_Store"];
const FOREIGN_PREFIX: &str = "._";

pub(super) struct Unpacker<'a> {
    archive: &'a Path,
    folder: &'a Path,
    max_files: u64,
    max_mib: u64,
    files: u64,
    folders: u64,
    bytes: u64,
    cancelled: &'a AtomicBool,
}

impl<'a> Unpacker<'a> {
    /// Makes the folder. Errors: `Io`.
    pub(super) fn new(
        config: &'a ImportConfig,
        folder: &'a Path,
        cancelled: &'a AtomicBool,
    ) -> Result<Self, ImportError> {
        fs::create_dir_all(folder).map_err(ImportError::io("write", folder))?;
        Ok(Self {
            archive: &config.source,
            folder,
            max_files: config.max_files,
            max_mib: config.disk_mib,
            files: 0,
            folders: 0,
            bytes: 0,
            cancelled,
        })
    }

    /// An error of the archive: the name of the entry or empty, and what is wrong.
    pub(super) fn wrong(&self, name: &str, reason: impl Display) -> ImportError {
        let shown: String = name
            .chars()
            .take(MAX_PATH_BYTES)
            .flat_map(char::escape_default)
            .collect();
        let place = if name.is_empty() {
            String::new()
        } else {
            format!("\"{shown}\" ")
        };
        ImportError::Archive {
            archive: self.archive.to_owned(),
            reason: format!("{place}{reason}"),
        }
    }

    /// Makes a folder. Errors: `Archive`, `Io`.
    pub(super) fn folder(&mut self, name: &str) -> Result<(), ImportError> {
        match self.path(name)? {
            Some(path) => self.make_folders(name, &path),
            None => Ok(()),
        }
    }

    /// Makes a folder with those above it. Errors: `Archive`, `Io`, `Stopped`.
    fn make_folders(&mut self, name: &str, path: &Path) -> Result<(), ImportError> {
        if path.is_dir() {
            return Ok(());
        }
        if let Some(above) = path.parent() {
            self.make_folders(name, above)?;
        }
        self.folders += 1;
        if self.folders > MAX_FOLDERS {
            return Err(self.wrong(
                "",
                format!("holds more than {MAX_FOLDERS} folders; import the folder itself"),
            ));
        }
        fs::create_dir(path).map_err(|error| self.not_made(name, path, error))
    }

    /// Errors: `Archive` if it holds more entries than files are allowed.
    pub(super) fn check_count(&self, entries: u64) -> Result<(), ImportError> {
        if entries <= self.max_files {
            return Ok(());
        }
        let (limit, right) = (self.max_files, "raise it, or import the folder itself");
        let reason = format!("holds more than {limit} files, the limit of the setting max_import_files; {right}");
        Err(self.wrong("", reason))
    }

    /// Counts an entry or header of the archive. Errors: `Archive`, `Stopped`.
    pub(super) fn count(&mut self) -> Result<(), ImportError> {
        if self.cancelled.load(Ordering::Relaxed) {
            return Err(ImportError::Stopped);
        }
        self.files += 1;
        self.check_count(self.files)
    }

    /// Writes a file. Errors: `Archive`, `Io`, `Stopped`.
    pub(super) fn file(&mut self, name: &str, content: &mut impl Read) -> Result<(), ImportError> {
        let path = self.path(name)?;
        // What does not belong to the recording is read as well, since it counts.
        let mut file = path.as_deref().map(|path| self.create(name, path)).transpose()?;
        let mut piece = vec![0; PIECE_BYTES];
        loop {
            if self.cancelled.load(Ordering::Relaxed) {
                return Err(ImportError::Stopped);
            }
            let read = match content.read(&mut piece) {
                Ok(0) => return Ok(()),
                Ok(read) => read,
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) => return Err(self.wrong(name, format!("cannot be unpacked: {error}"))),
            };
            self.bytes += read as u64;
            if self.bytes > self.max_mib.saturating_mul(1 << 20) {
                let (limit, right) = (self.max_mib, "raise it, or import the folder itself");
                let reason = format!("holds more than {limit} MiB, the limit of the setting import_disk_mib; {right}");
                return Err(self.wrong("", reason));
            }
            if let (Some(file), Some(path)) = (&mut file, &path) {
                file.write_all(&piece[..read]).map_err(ImportError::io("write", path))?;
            }
        }
    }

    fn create(&mut self, name: &str, path: &Path) -> Result<File, ImportError> {
        self.make_folders(name, path.parent().unwrap_or(self.folder))?;
        File::create_new(path).map_err(|error| self.not_made(name, path, error))
    }

    /// Where an entry is to be written; `None` for what does not belong to the recording. Errors: `Archive`.
    fn path(&self, name: &str) -> Result<Option<PathBuf>, ImportError> {
        let parts = || Path::new(name).components();
        let is_inside = parts().all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
        if name.is_empty() || !is_inside || name.contains(['\\', '\0']) {
            return Err(self.wrong(name, "is not a path inside the archive's folder"));
        }
        if name.len() > MAX_PATH_BYTES || parts().count() > MAX_PATH_PARTS {
            let reason = format!("is a path of more than {MAX_PATH_BYTES} bytes or {MAX_PATH_PARTS} parts");
            return Err(self.wrong(name, reason));
        }
        let is_foreign = |part: &str| FOREIGN.contains(&part) || part.starts_with(FOREIGN_PREFIX);
        let is_foreign = parts().any(|part| part.as_os_str().to_str().is_some_and(is_foreign));
        Ok((!is_foreign).then(|| self.folder.join(name)))
    }

    fn not_made(&self, name: &str, path: &Path, error: std::io::Error) -> ImportError {
        match error.kind() {
            ErrorKind::AlreadyExists | ErrorKind::NotADirectory | ErrorKind::IsADirectory => {
                self.wrong(name, "is in it more than once, or both a file and a folder")
            }
            ErrorKind::InvalidFilename | ErrorKind::InvalidInput => self.wrong(name, "is no name that this system has"),
            _ => ImportError::io("write", path)(error),
        }
    }
}
