//! Unpacks a zip archive.

use std::fs::File;

use zip::ZipArchive;

use super::unpacker::Unpacker;
use crate::dataset::import::ImportError;

/// Errors: `Archive`, `Io`, `Stopped`.
pub(super) fn unpack(file: File, to: &mut Unpacker<'_>) -> Result<(), ImportError> {
    let broken = |to: &Unpacker<'_>, error| to.wrong("", format!("is no zip archive, or it was cut off: {error}"));
    let mut archive = ZipArchive::new(file).map_err(|error| broken(to, error))?;
    for index in 0..archive.len() {
        to.count()?;
        let mut entry = archive.by_index(index).map_err(|error| broken(to, error))?;
        let name = entry.name().map_err(|error| broken(to, error))?.into_owned();
        if entry.is_symlink() {
            return Err(to.wrong(&name, "is a link; pack the file itself"));
        }
        if entry.is_dir() {
            to.folder(&name)?;
        } else {
            to.file(&name, &mut entry)?;
        }
    }
    Ok(())
}
