//! Checks SQLite's write-ahead log. SQLite ignores everything after the first frame that does not match its checksum, since
//! a power failure can leave such a frame at the end. In the middle it means damage, and all later changes would be lost.

use std::path::Path;

use super::StoreError;
use foreframe_core::files::none_if_missing;

const HEADER_BYTES: usize = 32;
const FRAME_HEADER_BYTES: usize = 24;
/// The first four bytes; the last bit says that checksums use big-endian words.
const MAGIC: u32 = 0x377f_0682;
/// The page size of databases that SQLite creates.
const DEFAULT_PAGE_BYTES: usize = 4096;
/// How often a log is read that another process changes meanwhile.
const READS: usize = 5;

/// Checks the write-ahead log of a database file. Errors: `Damaged` if transactions follow a damaged part; `Io`.
pub(super) fn check(database: &Path) -> Result<(), StoreError> {
    let mut path = database.as_os_str().to_owned();
    path.push("-wal");
    let path = Path::new(&path);
    let read = || none_if_missing(std::fs::read(path)).map_err(StoreError::io("read", path));
    for _ in 0..READS {
        let Some(log) = read()? else { return Ok(()) };
        let Some(reason) = damage(&log) else { return Ok(()) };
        // A running server can start the log anew while it is read.
        let again = read()?.unwrap_or_default();
        if again.get(..HEADER_BYTES) == log.get(..HEADER_BYTES) && damage(&again).as_ref() == Some(&reason) {
            let path = path.to_owned();
            return Err(StoreError::Damaged { path, reason });
        }
    }
    Ok(())
}

/// The running checksum of SQLite's log.
type Checksum = (u32, u32);

/// What is wrong with a log; `None` if SQLite loses at most the transaction that was written last.
fn damage(log: &[u8]) -> Option<String> {
    let header = LogHeader::of(log)?;
    let frames = log
        .get(HEADER_BYTES..)?
        .chunks_exact(FRAME_HEADER_BYTES + header.page_bytes);
    // With a damaged header, frames are compared with each other.
    let salts = if header.is_sound {
        pair(log, 16)
    } else {
        frames.clone().next().and_then(|frame| pair(frame, 8))
    };
    let mut before = header.is_sound.then_some(header.checksum);
    let mut damaged = (!header.is_sound).then_some("the header".to_owned());
    let mut has_commit = false;
    for (index, frame) in frames.enumerate() {
        let stored = pair(frame, 16);
        // Frames with other salts are left from an earlier log, and no frame of this log follows them.
        let is_sound = pair(frame, 8) == salts
            && before.is_some_and(|before| Some(header.frame_checksum(before, frame)) == stored);
        if let Some(part) = damaged.as_ref().filter(|_| is_sound && has_commit) {
            // This frame was written after the commit of what is damaged had reached the disk.
            return Some(format!("{part} of the write-ahead log does not match its checksum"));
        }
        if !is_sound && damaged.is_none() {
            damaged = Some(format!("frame {}", index + 1));
        }
        let is_commit = word(frame, 4, u32::from_be_bytes).is_some_and(|pages| pages != 0);
        has_commit |= damaged.is_some() && is_commit;
        before = stored;
    }
    None
}

/// The header of a log.
struct LogHeader {
    words: fn([u8; 4]) -> u32,
    page_bytes: usize,
    checksum: Checksum,
    is_sound: bool,
}

impl LogHeader {
    fn of(log: &[u8]) -> Option<Self> {
        let (magic, page) = (word(log, 0, u32::from_be_bytes)?, word(log, 8, u32::from_be_bytes)?);
        let words: fn([u8; 4]) -> u32 = match magic & 1 {
            0 => u32::from_le_bytes,
            _ => u32::from_be_bytes,
        };
        let checksum = checksum((0, 0), log.get(..24)?, words);
        let is_sound = magic & !1 == MAGIC && Some(checksum) == pair(log, 24);
        Some(Self {
            words: if is_sound { words } else { u32::from_ne_bytes },
            page_bytes: if is_sound { page as usize } else { DEFAULT_PAGE_BYTES },
            checksum,
            is_sound,
        })
    }

    /// The checksum of a frame after that of the frame before it.
    fn frame_checksum(&self, before: Checksum, frame: &[u8]) -> Checksum {
        let (head, page) = (frame.get(..8), frame.get(FRAME_HEADER_BYTES..));
        let before = checksum(before, head.unwrap_or_default(), self.words);
        checksum(before, page.unwrap_or_default(), self.words)
    }
}

/// SQLite's checksum of a whole number of pairs of words.
fn checksum(before: Checksum, bytes: &[u8], words: fn([u8; 4]) -> u32) -> Checksum {
    bytes.chunks_exact(8).fold(before, |(first, second), pair| {
        let (one, other) = (word(pair, 0, words), word(pair, 4, words));
        let first = first.wrapping_add(one.unwrap_or_default()).wrapping_add(second);
        (
            first,
            second.wrapping_add(other.unwrap_or_default()).wrapping_add(first),
        )
    })
}

fn pair(bytes: &[u8], at: usize) -> Option<(u32, u32)> {
    Some((
        word(bytes, at, u32::from_be_bytes)?,
        word(bytes, at + 4, u32::from_be_bytes)?,
    ))
}

fn word(bytes: &[u8], at: usize, read: fn([u8; 4]) -> u32) -> Option<u32> {
    bytes.get(at..)?.first_chunk().copied().map(read)
}
