//! Writes files so that a reader sees either the complete file or none, deletes directories, computes
//! hashes, and orders file names.

mod positioned;

use std::cmp::Ordering;
use std::error::Error;
use std::fs::{File, TryLockError};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use sha2::{Digest, Sha256};

pub use self::positioned::PositionedFile;

/// Extension of a file that is being written.
const PARTIAL: &str = "partial";
/// Prefix of a directory's name while it is being deleted.
const DELETING: &str = ".deleting-";
/// A partial file older than this has no writer any more.
const STALE_AFTER: Duration = Duration::from_hours(1);

/// Writes the file atomically: the path holds either all the bytes or its old content. Writes a temporary file in the
/// same directory, calls fsync and renames it.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let partial = partial_path(path)?;
    let written = File::create(&partial)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| std::fs::rename(&partial, path));
    if written.is_err() {
        // Return the first error. If this fails too, the file's name still marks it as partial.
        let _ = std::fs::remove_file(&partial);
    }
    written?;
    match path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        Some(parent) => File::open(parent)?.sync_all(),
        None => Ok(()),
    }
}

/// Opens a lock file and leaves its content. A symbolic link is refused, because another file would be locked.
pub fn open_lock(path: &Path) -> io::Result<File> {
    if path.symlink_metadata().is_ok_and(|found| found.is_symlink()) {
        return Err(io::Error::other("the lock file is a symbolic link; delete it"));
    }
    let mut options = File::options();
    options.read(true).write(true).create(true).truncate(false).open(path)
}

/// Locks a file. A program that this process is just starting shares its locks until it is executed, so a lock that was released
/// a moment ago can still be taken: a few tries are made, for a fifth of a second in all.
pub fn try_lock(file: &File) -> Result<(), TryLockError> {
    for _ in 0..9 {
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(20)),
            locked => return locked,
        }
    }
    file.try_lock()
}

/// The temporary path of a file. It is different in each call, because several writers can write the same file at once.
pub fn partial_path(path: &Path) -> io::Result<PathBuf> {
    let no_name = || io::Error::new(io::ErrorKind::InvalidInput, "the path does not end with a file name");
    let mut name = path.file_name().ok_or_else(no_name)?.to_owned();
    let random = getrandom::u64().map_err(io::Error::other)?;
    name.push(format!(".{random:016x}.{PARTIAL}"));
    Ok(path.with_file_name(name))
}

/// Whether `found` is a partial copy of the file `path`, left by a writer that was killed.
pub fn is_partial_of(path: &Path, found: &Path) -> bool {
    let name = |path: &Path| path.file_name().unwrap_or_default().as_encoded_bytes().to_owned();
    found.parent() == path.parent() && is_partial(found) && name(found).starts_with(&[&name(path)[..], b"."].concat())
}

/// Whether the file is being written, or was being written when its writer was killed.
pub fn is_partial(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == PARTIAL)
}

/// Whether the file, or a directory of its path, has a name that begins with a dot.
pub fn is_hidden(path: &Path) -> bool {
    path.components()
        .any(|part| part.as_os_str().as_encoded_bytes().starts_with(b"."))
}

/// Deletes old partial files below a directory. Files that cannot be deleted are ignored: they do no harm.
pub fn remove_stale_partials(root: &Path) {
    remove_partials_if(root, |path| {
        let modified = std::fs::metadata(path).and_then(|found| found.modified());
        modified.is_ok_and(|time| time.elapsed().is_ok_and(|age| age > STALE_AFTER))
    });
}

/// Deletes all partial files below a directory that no other process writes to, because this one has locked it.
pub fn remove_partials(root: &Path) {
    remove_partials_if(root, |_| true);
}

fn remove_partials_if(root: &Path, condition: impl Fn(&Path) -> bool) {
    for path in files_below(root).unwrap_or_default() {
        if is_partial(&path) && condition(&path) {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// Every file below a directory, sorted.
pub fn files_below(root: &Path) -> io::Result<Vec<PathBuf>> {
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

/// Deletes a directory. It is renamed first, so its name is free at once. A missing directory is not an error. Also
/// deletes what earlier, killed deletions left in the same parent directory.
pub fn remove_dir(dir: &Path) -> io::Result<()> {
    let random = getrandom::u64().map_err(io::Error::other)?;
    let renamed = dir.with_file_name(format!("{DELETING}{random:016x}"));
    none_if_missing(std::fs::rename(dir, &renamed))?;
    // Another call can delete the same directory at the same time.
    none_if_missing(std::fs::remove_dir_all(&renamed))?;
    let beside = none_if_missing(std::fs::read_dir(dir.parent().unwrap_or(dir)))?;
    for left in beside.into_iter().flatten() {
        let left = left?;
        if left.file_name().as_encoded_bytes().starts_with(DELETING.as_bytes()) {
            let _ = std::fs::remove_dir_all(left.path());
        }
    }
    Ok(())
}

/// Whether an error comes from a file system that cannot be written or read for now, but may be later: it is full, was made
/// read-only, or its device failed.
pub fn is_transient(error: &(dyn Error + 'static)) -> bool {
    /// Linux's number of an I/O error, which has no `ErrorKind`.
    const EIO: i32 = 5;
    let mut causes = std::iter::successors(Some(error), |&error| error.source());
    let error = causes.find_map(|error| error.downcast_ref::<io::Error>());
    error.is_some_and(|error| match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::ReadOnlyFilesystem => true,
        _ => cfg!(unix) && error.raw_os_error() == Some(EIO),
    })
}

/// Turns the error `NotFound` into `None`.
pub fn none_if_missing<T>(found: io::Result<T>) -> io::Result<Option<T>> {
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

/// Two lower-case hexadecimal digits for each byte.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    let digit = |half: u8| char::from(b"0123456789abcdef"[usize::from(half)]);
    bytes
        .iter()
        .flat_map(|byte| [digit(byte >> 4), digit(byte & 15)])
        .collect()
}

/// The bytes of exactly `N` pairs of hexadecimal digits; `None` of other text.
#[must_use]
pub fn from_hex<const N: usize>(text: &str) -> Option<[u8; N]> {
    let digit = |byte: u8| u8::try_from(char::from(byte).to_digit(16)?).ok();
    let (pairs, rest) = text.as_bytes().as_chunks::<2>();
    let bytes = pairs.iter().map(|[high, low]| Some(digit(*high)? << 4 | digit(*low)?));
    let bytes: Vec<u8> = bytes.collect::<Option<_>>()?;
    if rest.is_empty() { bytes.try_into().ok() } else { None }
}

/// Compares runs of digits as numbers, so that `2.png` comes before `10.png`.
pub fn natural_order(a: &str, b: &str) -> Ordering {
    natural_parts(a).cmp(natural_parts(b)).then_with(|| a.cmp(b))
}

/// The sort key of each run. A run of digits is compared by its length without leading zeros, then by its digits. A run of
/// digits and one of other characters differ in their first byte, where every digit counts as 0.
fn natural_parts(text: &str) -> impl Iterator<Item = (u8, usize, &[u8])> {
    let runs = text
        .as_bytes()
        .chunk_by(|one, next| one.is_ascii_digit() == next.is_ascii_digit());
    runs.map(|run| {
        if !run[0].is_ascii_digit() {
            return (run[0], 0, run);
        }
        let zeros = run.iter().take_while(|&&digit| digit == b'0').count();
        (b'0', run.len() - zeros, &run[zeros..])
    })
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;

    #[test]
    fn hexadecimal_digits_give_the_same_bytes_again() {
        let bytes = [0x00, 0x7f, 0xa5, 0xff];
        assert_eq!(hex(&bytes), "007fa5ff");
        assert_eq!(from_hex("007fA5ff"), Some(bytes));
        for wrong in [
            "007fa5f",
            "007fa5ff0",
            "007fa5",
            "007fa5fg",
            "007fa5+f",
            "007fa5 f",
            "007fa5é",
        ] {
            assert_eq!(from_hex::<4>(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn the_hash_of_abc_matches_the_standard() {
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(sha256_hex(b"abc"), expected);
    }

    #[test]
    fn a_failed_write_keeps_the_old_content() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("taken");
        std::fs::create_dir(&path).unwrap();
        write_atomically(&path.join("file"), b"old").unwrap();
        assert!(write_atomically(&path, b"new").is_err());
        assert_eq!(files_below(dir.path()).unwrap(), [path.join("file")]);
        assert_eq!(std::fs::read(path.join("file")).unwrap(), b"old");
    }

    #[test]
    fn concurrent_writers_leave_one_complete_file() {
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
    fn deleting_also_removes_leftovers_of_killed_deletions() {
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
    fn only_old_partial_files_are_removed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("file");
        let long_ago = SystemTime::now() - 2 * STALE_AFTER;
        let make = |path: &Path, modified: SystemTime| File::create(path).unwrap().set_modified(modified).unwrap();
        let (old, new) = (partial_path(&path).unwrap(), partial_path(&path).unwrap());
        assert!(is_partial_of(&path, &old) && is_partial_of(&path, &dir.path().join("file.partial")));
        assert!(!is_partial_of(&path, &dir.path().join("file2.1.partial")));
        make(&path, long_ago);
        make(&old, long_ago);
        make(&new, SystemTime::now());
        remove_stale_partials(dir.path());
        assert!(path.exists() && new.exists() && !old.exists());
    }

    #[test]
    fn numbers_in_file_names_are_compared_as_numbers() {
        let mut names = [
            "10.png",
            "2.png",
            "frame-9.png",
            "frame-010.png",
            "1.png",
            "frame-1b.png",
        ];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(
            names,
            [
                "1.png",
                "2.png",
                "10.png",
                "frame-1b.png",
                "frame-9.png",
                "frame-010.png"
            ]
        );
    }
}
