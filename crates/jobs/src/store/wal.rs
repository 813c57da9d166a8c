//! Checks SQLite's write-ahead log. SQLite ignores everything after the first frame that does not match its checksum, since
//! a power failure can leave such a frame at the end. In the middle it means damage, and all later changes would be lost.
//! SQLite's own `quick_check` does not see what it ignores.

use std::path::Path;

use super::StoreError;
use foreframe_core::files::none_if_missing;

/// The length of the header, and of that of a frame, in words of four bytes.
const HEADER_WORDS: usize = 8;
const FRAME_HEADER_WORDS: usize = 6;
/// The first word; its last bit says that checksums use big-endian words.
const MAGIC: u32 = 0x377f_0682;
/// The page size of databases that SQLite creates.
const DEFAULT_PAGE_BYTES: u32 = 4096;
/// How often a log is read that another process changes meanwhile.
const READS: usize = 5;

/// Checks the write-ahead log of a database file. Errors: `Damaged` if transactions follow a damaged part; `Io`.
pub(super) fn check(database: &Path) -> Result<(), StoreError> {
    let mut path = database.as_os_str().to_owned();
    path.push("-wal");
    let path = Path::new(&path);
    let read = || -> Result<Vec<u32>, StoreError> {
        let log = none_if_missing(std::fs::read(path)).map_err(StoreError::io("read", path))?;
        let log = log.unwrap_or_default();
        Ok(log.as_chunks().0.iter().copied().map(u32::from_be_bytes).collect())
    };
    for _ in 0..READS {
        let log = read()?;
        let Some(reason) = damage(&log) else { return Ok(()) };
        // A running server can start the log anew while it is read.
        let again = read()?;
        if again.get(..HEADER_WORDS) == log.get(..HEADER_WORDS) && damage(&again).as_ref() == Some(&reason) {
            let path = path.to_owned();
            return Err(StoreError::Damaged { path, reason });
        }
    }
    Ok(())
}

/// The running checksum of SQLite's log.
type Checksum = (u32, u32);

/// What is wrong with a log, given as big-endian words; `None` if SQLite loses at most the transaction that was written last.
fn damage(log: &[u32]) -> Option<String> {
    let (&[magic, version, page_bytes, checkpoint, salt, other_salt, sum, other_sum], frames) =
        log.split_first_chunk()?;
    let fields = [magic, version, page_bytes, checkpoint, salt, other_salt];
    let is_sound = magic & !1 == MAGIC && checksum((0, 0), &fields, magic & 1 == 1) == (sum, other_sum);
    let (page_bytes, is_big_endian) = if is_sound {
        (page_bytes, magic & 1 == 1)
    } else {
        (DEFAULT_PAGE_BYTES, cfg!(target_endian = "big"))
    };
    // With a damaged header, frames are compared with each other.
    let mut salts = is_sound.then_some((salt, other_salt));
    let mut before = is_sound.then_some((sum, other_sum));
    let mut damaged = (!is_sound).then_some("the header".to_owned());
    let mut has_commit = false;
    for (index, frame) in frames
        .chunks_exact(FRAME_HEADER_WORDS + page_bytes as usize / 4)
        .enumerate()
    {
        let &[number, pages, salt, other_salt, sum, other_sum, ref page @ ..] = frame else {
            break;
        };
        let expected = before.map(|before| {
            let before = checksum(before, &[number, pages], is_big_endian);
            checksum(before, page, is_big_endian)
        });
        // Frames with other salts are left from an earlier log, and no frame of this log follows them.
        let is_sound =
            *salts.get_or_insert((salt, other_salt)) == (salt, other_salt) && expected == Some((sum, other_sum));
        if let Some(part) = damaged.as_ref().filter(|_| is_sound && has_commit) {
            // This frame was written after the commit of what is damaged had reached the disk.
            return Some(format!("{part} of the write-ahead log does not match its checksum"));
        }
        if !is_sound && damaged.is_none() {
            damaged = Some(format!("frame {}", index + 1));
        }
        has_commit |= damaged.is_some() && pages != 0;
        before = Some((sum, other_sum));
    }
    None
}

/// SQLite's checksum of pairs of words.
fn checksum(before: Checksum, words: &[u32], is_big_endian: bool) -> Checksum {
    let word = |word: u32| if is_big_endian { word } else { word.swap_bytes() };
    let pairs = words.as_chunks::<2>().0;
    pairs.iter().fold(before, |(first, second), &[one, other]| {
        let first = first.wrapping_add(word(one)).wrapping_add(second);
        (first, second.wrapping_add(word(other)).wrapping_add(first))
    })
}
