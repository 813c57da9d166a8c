//! Unpacks a zip archive.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom};

use zip::ZipArchive;

use super::unpacker::Unpacker;
use crate::dataset::import::ImportError;

/// The last record of an archive, which may be followed by a comment of up to 64 KiB.
const END: [u8; 4] = *b"PK\x05\x06";
const END_BYTES: usize = 22;
const MAX_COMMENT_BYTES: u64 = 1 << 16;
/// What stands before it in a large archive, and says where the larger record is.
const LARGE_END_PLACE: [u8; 4] = *b"PK\x06\x07";
const LARGE_END_PLACE_BYTES: usize = 20;

/// Errors: `Archive`, `Io`, `Stopped`.
pub(super) fn unpack(mut file: File, to: &mut Unpacker<'_>) -> Result<(), ImportError> {
    let broken = |to: &Unpacker<'_>, error: &dyn std::fmt::Display| {
        to.wrong(
            "",
            format!("is no zip archive that can be read, or it was cut off: {error}"),
        )
    };
    // The library reads the list of all entries into memory, however long it is.
    let stated = entry_count(&mut file).map_err(|error| broken(to, &error))?;
    to.check_count(stated.unwrap_or(0))?;
    let mut archive = ZipArchive::new(file).map_err(|error| broken(to, &error))?;
    if stated.is_some_and(|stated| stated > archive.len() as u64) {
        // The library keeps the last of several entries with one name.
        return Err(to.wrong("", "holds a file more than once"));
    }
    for index in 0..archive.len() {
        to.count()?;
        let mut entry = archive.by_index(index).map_err(|error| broken(to, &error))?;
        let name = entry.name().map_err(|error| broken(to, &error))?.into_owned();
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

/// How many entries the archive says it has; `None` if it has no end record.
fn entry_count(file: &mut File) -> io::Result<Option<u64>> {
    let length = file.seek(SeekFrom::End(0))?;
    let tail_bytes = length.min(MAX_COMMENT_BYTES + (END_BYTES + LARGE_END_PLACE_BYTES) as u64);
    let mut tail = vec![0; tail_bytes as usize];
    file.seek(SeekFrom::Start(length - tail_bytes))?;
    file.read_exact(&mut tail)?;
    let Some(end) = tail.windows(END.len()).rposition(|bytes| bytes == END) else {
        return Ok(None);
    };
    let Some(count) = tail.get(end + 10..end + 12) else {
        return Ok(None);
    };
    let count = u64::from(u16::from_le_bytes([count[0], count[1]]));
    let place = end.checked_sub(LARGE_END_PLACE_BYTES).map(|start| &tail[start..end]);
    let Some(place) = place.filter(|place| place.starts_with(&LARGE_END_PLACE)) else {
        return Ok(Some(count));
    };
    let mut large = [0; 8];
    large.copy_from_slice(&place[8..16]);
    // The number of entries in the larger record.
    file.seek(SeekFrom::Start(u64::from_le_bytes(large).saturating_add(32)))?;
    file.read_exact(&mut large)?;
    Ok(Some(u64::from_le_bytes(large)))
}
