//! Files that are either whole or not there.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use sha2::{Digest, Sha256};

use super::{DatasetError, hex};

/// Writes a file beside its place, makes sure that it is on the disk, and moves it there. A reader never sees half.
pub(super) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), DatasetError> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".tmp");
    let temporary = path.with_file_name(name);
    let written = write_and_move(&temporary, path, bytes);
    if written.is_err() {
        // What was wrong is told already; half a temporary file is of use to nobody.
        let _ = fs::remove_file(&temporary);
    }
    written.map_err(DatasetError::io("write", path))
}

fn write_and_move(temporary: &Path, path: &Path, bytes: &[u8]) -> io::Result<()> {
    let directory = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(directory)?;
    let mut file = File::create(temporary)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    fs::rename(temporary, path)?;
    File::open(directory)?.sync_all()
}

/// The hex sha256 of a file.
pub(super) fn sha256_of_file(path: &Path) -> Result<String, DatasetError> {
    let mut hasher = Sha256::new();
    File::open(path)
        .and_then(|mut file| io::copy(&mut file, &mut hasher))
        .map_err(DatasetError::io("read", path))?;
    Ok(hex(&hasher.finalize()))
}

/// The hex sha256 of some bytes.
pub(super) fn sha256(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// Errors: `HashDiffers` unless the file has that hex sha256.
pub(super) fn verify(path: &Path, expected: &str) -> Result<(), DatasetError> {
    let found = sha256_of_file(path)?;
    if found == expected {
        return Ok(());
    }
    Err(DatasetError::HashDiffers {
        path: path.to_owned(),
        expected: expected.to_owned(),
        found,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_write_that_fails_leaves_nothing_behind() {
        let directory = tempfile::tempdir().unwrap();
        let place = directory.path().join("taken");
        fs::create_dir(&place).unwrap();
        fs::write(place.join("file"), b"x").unwrap();
        assert!(write_atomically(&place, b"new").is_err());
        let names: Vec<_> = fs::read_dir(directory.path())
            .unwrap()
            .map(|e| e.unwrap().file_name())
            .collect();
        assert_eq!(names, ["taken"]);
    }
}
