//! Files that clients upload to import them. Each is in a directory of its own below `uploads`, in the data directory and in a shared
//! object store, until its import has ended.

use std::fmt::{self, Display};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use super::JobError;
use crate::store::{Objects, StoreError};
use foreframe_core::files::remove_dir;

/// The directory of all uploads, below the data directory.
pub const UPLOADS_DIR: &str = "uploads";
/// How the source of an import names an uploaded file: `upload:ID/NAME`.
const SCHEME: &str = "upload:";
/// Hexadecimal digits of an id.
const ID_DIGITS: usize = 32;
/// The longest name of a file.
const MAX_NAME_BYTES: usize = 128;
/// What a file's name ends with: what `import` reads of single files.
pub const UPLOAD_ENDINGS: [&str; 13] = [
    ".zip", ".tar", ".tar.gz", ".tgz", ".mcap", ".db3", ".npy", ".npz", ".mp4", ".mkv", ".avi", ".mov", ".webm",
];

/// A file that a client uploads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UploadedFile {
    id: String,
    name: String,
}

/// Text that names no uploaded file.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UploadNameError(String);

impl UploadedFile {
    /// `id`: 32 hexadecimal digits. Errors: the name is not that of a file that can be imported.
    pub fn new(id: String, name: &str) -> Result<Self, UploadNameError> {
        let is_id = id.len() == ID_DIGITS && id.bytes().all(|c| matches!(c, b'0'..=b'9' | b'a'..=b'f'));
        let is_plain = |c: char| c.is_ascii_alphanumeric() || "._ ()+-".contains(c);
        let starts_well = name.starts_with(|c: char| c.is_ascii_alphanumeric());
        let lower = name.to_ascii_lowercase();
        let shown = name.escape_default();
        let wrong = if !is_id {
            format!("\"{}\" is not the id of an upload", id.escape_default())
        } else if !(starts_well && name.len() <= MAX_NAME_BYTES && name.chars().all(is_plain)) {
            format!(
                "\"{shown}\" is not a file's name; it has at most {MAX_NAME_BYTES} letters, digits, spaces and ._()+- and starts with \
                 a letter or digit"
            )
        } else if !UPLOAD_ENDINGS.iter().any(|ending| lower.ends_with(ending)) {
            format!(
                "\"{shown}\" cannot be imported; a file's name ends with one of {}",
                UPLOAD_ENDINGS.join(", ")
            )
        } else {
            let name = name.to_owned();
            return Ok(Self { id, name });
        };
        Err(UploadNameError(wrong))
    }

    /// The uploaded file that a source names; `None` if the source is a path. Errors: it names none that is possible.
    pub(super) fn of_source(source: &str) -> Option<Result<Self, UploadNameError>> {
        Some(source.strip_prefix(SCHEME)?.parse())
    }

    /// Its id.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The key of its directory.
    #[must_use]
    pub fn key(&self) -> String {
        format!("{UPLOADS_DIR}/{}", self.id)
    }

    /// Where the file is in a data directory.
    #[must_use]
    pub fn path(&self, data_dir: &Path) -> PathBuf {
        data_dir.join(self.key()).join(&self.name)
    }

    /// Copies it to a shared object store. Errors: `Io`, `Object`.
    pub async fn push(&self, objects: &Objects) -> Result<(), StoreError> {
        objects.push(&self.key(), &self.name).await
    }

    /// Copies it from a shared object store, unless it is here. A copy of one that was deleted there is deleted here too. Errors: `Io`,
    /// `Object`.
    pub(super) async fn fetch(&self, objects: &Objects) -> Result<(), StoreError> {
        if !objects.has(&format!("{}/{}", self.key(), self.name)).await? {
            self.forget_copy(objects);
        } else if !self.path(objects.data_dir()).is_file() {
            objects.pull(&self.key(), &self.name).await?;
        }
        Ok(())
    }

    /// Deletes the copy of a shared file. The server to which it was uploaded deletes the file itself.
    pub(super) fn forget_copy(&self, objects: &Objects) {
        if objects.are_shared() {
            // If it stays, it is deleted with the others that nobody uses.
            let _ = remove_dir(&objects.data_dir().join(self.key()));
        }
    }

    /// Its path. Errors: `Invalid` if it is not here.
    pub(super) fn existing(&self, data_dir: &Path) -> Result<PathBuf, JobError> {
        let path = self.path(data_dir);
        if path.is_file() {
            return Ok(path);
        }
        let reason = format!(
            "there is no \"{self}\"; an upload is deleted when its import has succeeded, and after a while; send the file again"
        );
        Err(JobError::invalid("source", reason))
    }
}

/// As the source of an import.
impl Display for UploadedFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{SCHEME}{}/{}", self.id, self.name)
    }
}

impl FromStr for UploadedFile {
    type Err = UploadNameError;

    /// `ID/NAME`.
    fn from_str(text: &str) -> Result<Self, UploadNameError> {
        let (id, name) = text.split_once('/').unwrap_or((text, ""));
        Self::new(id.to_owned(), name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ID: &str = "0123456789abcdef0123456789abcdef";

    #[test]
    fn a_source_names_its_upload() {
        let file = UploadedFile::new(ID.to_owned(), "My walk (2).TAR.gz").unwrap();
        let found = UploadedFile::of_source(&file.to_string()).unwrap().unwrap();
        assert_eq!(found, file);
        assert!(UploadedFile::of_source("walk/upload:").is_none());
    }

    #[test]
    fn names_that_could_lead_elsewhere_are_refused() {
        for name in [
            "../a.zip", "a/b.zip", ".zip", "a\\b.zip", "a\0.zip", "a.exe", "", "ü.zip", "-a.zip",
        ] {
            assert!(UploadedFile::new(ID.to_owned(), name).is_err(), "{name:?}");
        }
        assert!(UploadedFile::new(ID.to_owned(), &format!("{}.zip", "a".repeat(125))).is_err());
        for id in ["..", "", &ID[1..], "0123456789ABCDEF0123456789ABCDEF"] {
            assert!(UploadedFile::new(id.to_owned(), "a.zip").is_err(), "{id:?}");
        }
    }
}
