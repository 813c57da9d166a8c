//! Archives of a recording (`.zip`, `.tar`, `.tar.gz`). They are unpacked beside the data set, and imported as the folder would be.

mod tar;
mod unpacker;
mod zip_file;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use flate2::read::MultiGzDecoder;

use self::unpacker::Unpacker;
use super::files::{entries, open_file};
use super::skipped::{SkippedItem, moved_text};
use super::{ImportConfig, ImportError};
use foreframe_core::files::remove_dir;

/// The folder of the data set's directory in which an archive is unpacked. It is hidden, so no object store gets it.
const UNPACKED: &str = ".unpacked";

/// How an archive is packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Packing {
    Zip,
    Tar,
    TarGz,
}

const ENDINGS: [(&str, Packing); 4] = [
    (".zip", Packing::Zip),
    (".tar", Packing::Tar),
    (".tar.gz", Packing::TarGz),
    (".tgz", Packing::TarGz),
];

/// The packing and the name without its ending; `None` if the file's name is not that of an archive.
fn packing(path: &Path) -> Option<(Packing, &str)> {
    let name = path.file_name()?.to_str()?;
    ENDINGS.into_iter().find_map(|(ending, packing)| {
        let (stem, end) = name.split_at_checked(name.len().checked_sub(ending.len())?)?;
        (!stem.chars().all(|letter| letter == '.') && end.eq_ignore_ascii_case(ending)).then_some((packing, stem))
    })
}

/// What an import reads: its source or, if that is an archive, what was in it. Dropped, it deletes what was unpacked.
pub(super) struct UnpackedSource {
    /// The recording.
    pub(super) path: PathBuf,
    folder: PathBuf,
    /// The archive, and the folder that stands for it; `None` if the source is none.
    archive: Option<ArchiveFolder>,
}

struct ArchiveFolder {
    archive: PathBuf,
    folder: PathBuf,
}

impl UnpackedSource {
    /// Unpacks the source, if it is an archive. Errors: `Archive`, `Io`, `Stopped`.
    pub(super) fn of(config: &ImportConfig, cancelled: &AtomicBool) -> Result<Self, ImportError> {
        let (source, folder) = (&config.source, config.out.join(UNPACKED));
        // What a killed import left: first file by file, since there may be very many.
        if folder.is_dir() {
            empty(&folder, cancelled)?;
        }
        remove_dir(&folder).map_err(ImportError::io("delete", &folder))?;
        let Some((packing, stem)) = packing(source).filter(|_| source.is_file()) else {
            let path = source.clone();
            return Ok(Self {
                path,
                folder,
                archive: None,
            });
        };
        let root = folder.join(stem);
        // The folder has the archive's name, which becomes the recording's.
        let mut unpacked = Self {
            path: root.clone(),
            folder,
            archive: Some(ArchiveFolder {
                archive: source.clone(),
                folder: root,
            }),
        };
        let mut unpacker = Unpacker::new(config, &unpacked.path, cancelled)?;
        let file = open_file(source)?;
        match packing {
            Packing::Zip => zip_file::unpack(file, &mut unpacker)?,
            Packing::Tar => tar::unpack(std::io::BufReader::new(file), &mut unpacker)?,
            Packing::TarGz => tar::unpack(MultiGzDecoder::new(std::io::BufReader::new(file)), &mut unpacker)?,
        }
        unpacked.path = recording_in(&unpacked.path)?;
        Ok(unpacked)
    }

    /// The same error, with paths in the archive instead of those of the unpacked files, which are gone when somebody reads it.
    pub(super) fn name_in_archive(&self, error: ImportError) -> ImportError {
        match &self.archive {
            Some(ArchiveFolder { archive, folder }) => error.moved(folder, archive),
            None => error,
        }
    }

    /// The same item, with paths in the archive instead of those of the unpacked files.
    pub(super) fn item_in_archive(&self, item: SkippedItem) -> SkippedItem {
        let Some(ArchiveFolder { archive, folder }) = &self.archive else {
            return item;
        };
        let [place, reason] = [&item.place, &item.reason].map(|text| moved_text(text, folder, archive));
        SkippedItem {
            count: item.count,
            ..SkippedItem::new(&place, &reason)
        }
    }
}

/// Deletes what is in a folder. Errors: `Io`, `Stopped`.
fn empty(folder: &Path, cancelled: &AtomicBool) -> Result<(), ImportError> {
    for path in entries(folder)? {
        if cancelled.load(Ordering::Relaxed) {
            return Err(ImportError::Stopped);
        }
        let is_folder = path.symlink_metadata().is_ok_and(|found| found.is_dir());
        let deleted = if is_folder {
            empty(&path, cancelled)?;
            fs::remove_dir(&path)
        } else {
            fs::remove_file(&path)
        };
        deleted.map_err(ImportError::io("delete", &path))?;
    }
    Ok(())
}

impl Drop for UnpackedSource {
    fn drop(&mut self) {
        // Should it stay, the next run of the same import deletes it, and so does whoever deletes the data set.
        let _ = remove_dir(&self.folder);
    }
}

/// The recording in a folder: what is in it or, as long as that is one folder or file alone, this one. Errors: `Io`.
fn recording_in(folder: &Path) -> Result<PathBuf, ImportError> {
    let mut path = folder.to_owned();
    while path.is_dir() {
        match entries(&path)?.as_slice() {
            [only] => path.clone_from(only),
            _ => break,
        }
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_deletion_of_what_was_left_can_be_stopped() {
        let dir = tempfile::tempdir().unwrap();
        let inner = dir.path().join("left/inner");
        fs::create_dir_all(&inner).unwrap();
        fs::write(inner.join("0.png"), "x").unwrap();
        let stopped = empty(dir.path(), &AtomicBool::new(true));
        assert!(matches!(stopped, Err(ImportError::Stopped)) && inner.join("0.png").is_file());
        empty(dir.path(), &AtomicBool::new(false)).unwrap();
        assert!(dir.path().is_dir() && !dir.path().join("left").exists());
    }

    #[test]
    fn the_ending_of_the_name_tells_an_archive() {
        for (name, expected) in [
            ("walk.zip", Some((Packing::Zip, "walk"))),
            ("a.b.TAR.GZ", Some((Packing::TarGz, "a.b"))),
            ("walk.tgz", Some((Packing::TarGz, "walk"))),
            ("walk.tar", Some((Packing::Tar, "walk"))),
            (".zip", None),
            ("...zip", None),
            ("walk.gz", None),
            ("ü", None),
        ] {
            assert_eq!(packing(Path::new(name)), expected, "{name}");
        }
    }
}
