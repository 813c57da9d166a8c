//! Files that are whole or absent, and their hashes.

use std::ffi::OsString;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use sha2::{Digest, Sha256};

/// The ending of a file that is being written.
const PARTIAL: &str = "partial";
/// The beginning of a directory's name while it is deleted.
const DELETING: &str = ".deleting-";
/// After so long nobody writes a partial file any more.
const ABANDONED_AFTER: Duration = Duration::from_hours(1);

/// Writes the bytes so that the path holds all of them or what it held before: temporary file beside it, fsync, rename.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let partial = partial_path(path)?;
    let written = File::create(&partial)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| std::fs::rename(&partial, path));
    if written.is_err() {
        // The first error is the one to tell; what is left behind is named as partial.
        let _ = std::fs::remove_file(&partial);
    }
    written?;
    match path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        Some(parent) => File::open(parent)?.sync_all(),
        None => Ok(()),
    }
}

/// Opens a lock file and leaves its content. A symbolic link is refused, because another file would be locked.
pub(crate) fn open_lock(path: &Path) -> io::Result<File> {
    if path.symlink_metadata().is_ok_and(|found| found.is_symlink()) {
        return Err(io::Error::other("the lock file is a symbolic link; delete it"));
    }
    let mut options = File::options();
    options.read(true).write(true).create(true).truncate(false).open(path)
}

/// Where a file is written before it takes its name: another place each time, since several may write it at once.
fn partial_path(path: &Path) -> io::Result<PathBuf> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(
        ".{:016x}.{PARTIAL}",
        getrandom::u64().map_err(io::Error::other)?
    ));
    Ok(path.with_file_name(name))
}

/// Whether something is no more than what was written of the file when its writer was killed.
pub(crate) fn is_partial_of(path: &Path, found: &Path) -> bool {
    let name = |path: &Path| path.file_name().unwrap_or_default().as_encoded_bytes().to_owned();
    found.parent() == path.parent() && is_partial(found) && name(found).starts_with(&[&name(path)[..], b"."].concat())
}

/// Whether a file is one that is being written, or was when its writer was killed.
pub(crate) fn is_partial(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending == PARTIAL)
}

/// Deletes the partial files below a directory whose writers are gone. What cannot be deleted is in nobody's way.
pub(crate) fn remove_abandoned(root: &Path) {
    let age = |path: &Path| {
        SystemTime::now()
            .duration_since(std::fs::metadata(path)?.modified()?)
            .map_err(io::Error::other)
    };
    for path in files_below(root).unwrap_or_default() {
        if is_partial(&path) && age(&path).is_ok_and(|age| age > ABANDONED_AFTER) {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// Every file below a directory, sorted.
pub(crate) fn files_below(root: &Path) -> io::Result<Vec<PathBuf>> {
    let (mut dirs, mut files) = (vec![root.to_owned()], Vec::new());
    while let Some(dir) = dirs.pop() {
        for entry in std::fs::read_dir(dir)? {
            let path = entry?.path();
            if path.is_dir() {
                dirs.push(path);
            } else {
                files.push(path);
            }
        }
    }
    files.sort();
    Ok(files)
}

/// Deletes a directory, whose name is free at once; one that is not there is deleted already. What deletions that were
/// killed left beside it goes too.
pub(crate) fn remove_dir(dir: &Path) -> io::Result<()> {
    let mut name = OsString::from(DELETING);
    name.push(format!("{:016x}", getrandom::u64().map_err(io::Error::other)?));
    let doomed = dir.with_file_name(name);
    if_there(std::fs::rename(dir, &doomed))?;
    // Another deletion may be at it too.
    if_there(std::fs::remove_dir_all(&doomed))?;
    for left in if_there(std::fs::read_dir(dir.parent().unwrap_or(dir)))?
        .into_iter()
        .flatten()
    {
        let left = left?;
        if left.file_name().as_encoded_bytes().starts_with(DELETING.as_bytes()) {
            let _ = std::fs::remove_dir_all(left.path());
        }
    }
    Ok(())
}

/// What was found, or none where nothing is there.
pub(crate) fn if_there<T>(found: io::Result<T>) -> io::Result<Option<T>> {
    match found {
        Ok(found) => Ok(Some(found)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

/// SHA-256 in lower-case hexadecimal digits.
#[must_use]
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// Lower-case hexadecimal digits of the bytes.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut hex, byte| {
        // Writing to a string cannot fail.
        let _ = write!(hex, "{byte:02x}");
        hex
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hash_of_abc_is_the_standards() {
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(sha256_hex(b"abc"), expected);
    }

    #[test]
    fn a_write_that_fails_leaves_the_old_content() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("taken");
        std::fs::create_dir(&path).unwrap();
        write_atomically(&path.join("file"), b"old").unwrap();
        assert!(write_atomically(&path, b"new").is_err());
        assert_eq!(files_below(dir.path()).unwrap(), [path.join("file")]);
        assert_eq!(std::fs::read(path.join("file")).unwrap(), b"old");
    }

    #[test]
    fn many_that_write_a_file_at_once_all_succeed_and_leave_one_content_whole() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("file");
        let contents: Vec<Vec<u8>> = (0..8).map(|byte| vec![byte; 1 << 16]).collect();
        std::thread::scope(|scope| {
            let writers: Vec<_> = contents
                .iter()
                .map(|bytes| scope.spawn(|| (0..20).try_for_each(|_| write_atomically(&path, bytes))))
                .collect();
            for writer in writers {
                writer.join().unwrap().unwrap();
            }
        });
        assert!(contents.contains(&std::fs::read(&path).unwrap()));
        assert_eq!(files_below(dir.path()).unwrap(), [path]);
    }

    #[test]
    fn a_directory_is_deleted_with_what_killed_deletions_left() {
        let root = tempfile::tempdir().unwrap();
        for name in ["a", "b", ".deleting-1"] {
            std::fs::create_dir_all(root.path().join(name).join("deep")).unwrap();
        }
        for name in ["a", "a", "c/d"] {
            remove_dir(&root.path().join(name)).unwrap();
        }
        let left: Vec<_> = std::fs::read_dir(root.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name())
            .collect();
        assert_eq!(left, ["b"]);
    }

    #[test]
    fn only_partial_files_of_long_ago_are_removed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("file");
        let long_ago = SystemTime::now() - 2 * ABANDONED_AFTER;
        let make = |path: &Path, modified: SystemTime| File::create(path).unwrap().set_modified(modified).unwrap();
        let (old, new) = (partial_path(&path).unwrap(), partial_path(&path).unwrap());
        assert!(is_partial_of(&path, &old) && is_partial_of(&path, &dir.path().join("file.partial")));
        assert!(!is_partial_of(&path, &dir.path().join("file2.1.partial")));
        make(&path, long_ago);
        make(&old, long_ago);
        make(&new, SystemTime::now());
        remove_abandoned(dir.path());
        assert!(path.exists() && new.exists() && !old.exists());
    }
}
