//! Reads the files of a recording, with bounds, and finds them in its folders.

use std::fs::File;
use std::io::{self, ErrorKind, Read as _};
use std::path::{Component, Path, PathBuf};

use super::error::ImportError;
use foreframe_core::files::natural_order;

/// The largest file that is read in one piece, in bytes.
pub(super) const MAX_FILE_BYTES: u64 = 256 << 20;
/// The largest text that describes a recording, in bytes.
const MAX_TEXT_BYTES: u64 = 32 << 20;

/// Opens a file of a recording. Errors: `Io`, also for what is no regular file: reading a named pipe could take forever.
pub(super) fn open_file(path: &Path) -> Result<File, ImportError> {
    let irregular = || io::Error::new(ErrorKind::InvalidInput, "it is not a regular file");
    std::fs::metadata(path)
        .and_then(|found| found.is_file().then_some(()).ok_or_else(irregular))
        .and_then(|()| File::open(path))
        .map_err(ImportError::io("read", path))
}

pub(super) fn read_file(path: &Path) -> Result<Vec<u8>, ImportError> {
    read_at_most(path, MAX_FILE_BYTES)
}

fn read_at_most(path: &Path, most: u64) -> Result<Vec<u8>, ImportError> {
    let mut bytes = Vec::new();
    let mut file = open_file(path)?.take(most + 1);
    file.read_to_end(&mut bytes).map_err(ImportError::io("read", path))?;
    if bytes.len() as u64 > most {
        let error = io::Error::new(ErrorKind::InvalidData, format!("it has more than {} MiB", most >> 20));
        return Err(ImportError::io("read", path)(error));
    }
    Ok(bytes)
}

pub(super) fn read_text(path: &Path) -> Result<String, ImportError> {
    let invalid = |_| io::Error::new(ErrorKind::InvalidData, "it is not UTF-8 text");
    let text = String::from_utf8(read_at_most(path, MAX_TEXT_BYTES)?).map_err(invalid);
    text.map_err(ImportError::io("read", path))
}

/// What is in a folder, in the natural order of the names. Errors: `Io`.
pub(super) fn entries(folder: &Path) -> Result<Vec<PathBuf>, ImportError> {
    let entries = std::fs::read_dir(folder).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let mut paths: Vec<PathBuf> = entries
        .map_err(ImportError::io("read", folder))?
        .iter()
        .map(std::fs::DirEntry::path)
        .collect();
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    paths.sort_by(|a, b| natural_order(&name(a), &name(b)));
    Ok(paths)
}

/// A file of the folder. Errors: `Record` if the name leads out of it.
pub(super) fn inside(folder: &Path, name: &str, place: &str) -> Result<PathBuf, ImportError> {
    let mut parts = Path::new(name).components();
    let is_inside = parts.all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    if name.is_empty() || !is_inside {
        let reason = format!(
            "the file's name is {name:?}; it must be a file below {}",
            folder.display()
        );
        return Err(ImportError::record(place, reason));
    }
    Ok(folder.join(name))
}

/// The name of a recording: that of its file without the ending.
pub(super) fn stem(path: &Path, otherwise: &str) -> String {
    path.file_stem()
        .map_or_else(|| otherwise.to_owned(), |name| name.to_string_lossy().into_owned())
}

/// The name of a recording: that of its folder.
pub(super) fn folder_name(path: &Path, otherwise: &str) -> String {
    let real = path.canonicalize().ok();
    let name = real.as_deref().and_then(Path::file_name);
    name.map_or_else(|| otherwise.to_owned(), |name| name.to_string_lossy().into_owned())
}

/// The extension in lower case; empty if there is none.
pub(super) fn extension(path: &Path) -> String {
    path.extension()
        .map(|extension| extension.to_string_lossy().to_lowercase())
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn image_names_cannot_leave_the_folder() {
        let folder = Path::new("tub");
        assert!(inside(folder, "images/1.png", "").is_ok());
        for name in ["../1.png", "/etc/passwd", "", "a/../../b"] {
            assert!(inside(folder, name, "").is_err(), "{name}");
        }
    }
}
