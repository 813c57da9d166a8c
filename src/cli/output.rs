//! The directory that a command writes: its files appear when all of them are written, so that a command that fails or is
//! stopped can be repeated.

use std::fs;
use std::path::{Path, PathBuf};

use super::error::CliError;
use foreframe_core::files::write_atomically;

/// The beginning of the name of the directory in which the files are written first.
const PARTIAL: &str = ".partial-";

/// A directory whose files are being written. Without [`OutputDirectory::finish`], nothing stays.
pub(super) struct OutputDirectory {
    target: PathBuf,
    partial: PathBuf,
    is_new: bool,
}

impl OutputDirectory {
    /// Makes the directory if it does not exist. Errors: `Usage` if it is not empty or not a directory.
    pub(super) fn create(target: &Path) -> Result<Self, CliError> {
        let failed = |error| CliError::io("make", target, &error);
        if target.exists() && !is_empty(target).map_err(failed)? {
            return Err(CliError::Usage(format!(
                "{} exists and is not an empty directory; name a new one",
                target.display()
            )));
        }
        let directory = Self {
            target: target.to_owned(),
            partial: target.join(format!("{PARTIAL}{}", std::process::id())),
            is_new: !target.exists(),
        };
        fs::create_dir_all(&directory.partial).map_err(failed)?;
        Ok(directory)
    }

    /// Where the files are written until they are complete.
    pub(super) fn path(&self) -> &Path {
        &self.partial
    }

    /// Writes a file.
    pub(super) fn write(&self, name: &str, bytes: &[u8]) -> Result<(), CliError> {
        let path = self.partial.join(name);
        write_atomically(&path, bytes).map_err(|error| CliError::io("write", &self.target.join(name), &error))
    }

    /// Makes the files appear.
    pub(super) fn finish(mut self) -> Result<(), CliError> {
        let moved = fs::read_dir(&self.partial).and_then(|mut entries| {
            entries.try_for_each(|entry| {
                let entry = entry?;
                fs::rename(entry.path(), self.target.join(entry.file_name()))
            })
        });
        moved.map_err(|error| CliError::io("write", &self.target, &error))?;
        self.is_new = false;
        Ok(())
    }
}

impl Drop for OutputDirectory {
    fn drop(&mut self) {
        // What cannot be deleted does not stop the next try.
        let _ = fs::remove_dir_all(&self.partial);
        if self.is_new {
            let _ = fs::remove_dir(&self.target);
        }
    }
}

/// Whether a path is a directory that holds nothing, or only what a stopped command left.
fn is_empty(path: &Path) -> std::io::Result<bool> {
    if !path.is_dir() {
        return Ok(false);
    }
    for entry in fs::read_dir(path)? {
        if !entry?.file_name().to_string_lossy().starts_with(PARTIAL) {
            return Ok(false);
        }
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn created(target: &Path) -> OutputDirectory {
        OutputDirectory::create(target).unwrap_or_else(|error| panic!("{:?}", error.report()))
    }

    #[test]
    fn an_unfinished_directory_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("out");
        drop(created(&target));
        assert!(!target.exists());
        fs::create_dir_all(target.join(".partial-1")).unwrap();
        let output = created(&target);
        assert!(output.write("a", b"1").is_ok() && !target.join("a").exists());
        assert!(output.finish().is_ok());
        assert_eq!(fs::read(target.join("a")).unwrap(), b"1");
        assert!(OutputDirectory::create(&target).is_err());
    }
}
