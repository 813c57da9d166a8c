//! Unpacks a tar archive (ustar, with the long names of GNU and of pax). The crate `tar` reads a long name of any length into
//! memory; this reads at most 64 KiB.

use std::io::{self, ErrorKind, Read};

use super::unpacker::Unpacker;
use crate::dataset::import::ImportError;

const BLOCK: usize = 512;
/// The largest long name, and the largest header of pax, in bytes.
const MAX_HEADER_BYTES: u64 = 1 << 16;

// Places in a header.
const NAME: std::ops::Range<usize> = 0..100;
const SIZE: std::ops::Range<usize> = 124..136;
const CHECKSUM: std::ops::Range<usize> = 148..156;
const KIND: usize = 156;
const MAGIC: std::ops::Range<usize> = 257..263;
const PREFIX: std::ops::Range<usize> = 345..500;

/// What an earlier header says of the next file.
#[derive(Default)]
struct LongHeader {
    name: Option<String>,
    size: Option<u64>,
}

/// Errors: `Archive`, `Io`, `Stopped`.
pub(super) fn unpack(mut archive: impl Read, to: &mut Unpacker<'_>) -> Result<(), ImportError> {
    let mut long = LongHeader::default();
    loop {
        let mut block = [0; BLOCK];
        archive.read_exact(&mut block).map_err(|error| broken(to, &error))?;
        if block.iter().all(|&byte| byte == 0) {
            return Ok(());
        }
        to.count()?;
        let Some(header) = TarHeader::of(&block) else {
            return Err(to.wrong("", "is no tar archive, or it is damaged: a header's checksum is wrong"));
        };
        match header.kind {
            b'L' => long.name = Some(zero_ended(&header_content(&mut archive, header.size, to)?)),
            b'x' => read_pax(&header_content(&mut archive, header.size, to)?, &mut long, to)?,
            // A long name of a link, or what pax says of all files: neither is needed.
            b'K' | b'g' => drop(header_content(&mut archive, header.size, to)?),
            kind => {
                let LongHeader { name, size } = std::mem::take(&mut long);
                let (name, size) = (name.unwrap_or(header.name), size.unwrap_or(header.size));
                unpack_entry(kind, &name, size, &mut archive, to)?;
            }
        }
    }
}

/// Errors: `Archive`, `Io`, `Stopped`.
fn unpack_entry(
    kind: u8,
    name: &str,
    size: u64,
    archive: &mut impl Read,
    to: &mut Unpacker<'_>,
) -> Result<(), ImportError> {
    match kind {
        // Before ustar, a slash at the end told a folder.
        b'5' => to.folder(name),
        b'0' | b'\0' if name.ends_with('/') => to.folder(name),
        b'0' | b'\0' | b'7' => {
            let mut content = archive.by_ref().take(size);
            to.file(name, &mut content)?;
            if content.limit() > 0 {
                return Err(to.wrong(name, "is cut off"));
            }
            skip(archive, padding(size), to)
        }
        b'1' | b'2' => Err(to.wrong(name, "is a link; pack the file itself")),
        _ => Err(to.wrong(name, "is no plain file or folder; pack only these")),
    }
}

struct TarHeader {
    kind: u8,
    name: String,
    size: u64,
}

impl TarHeader {
    /// `None` if the checksum or the size is wrong.
    fn of(block: &[u8; BLOCK]) -> Option<Self> {
        let blanked = block.iter().enumerate();
        let sum: u64 = blanked
            .map(|(at, &byte)| u64::from(if CHECKSUM.contains(&at) { b' ' } else { byte }))
            .sum();
        if number(&block[CHECKSUM])? != sum {
            return None;
        }
        let name = zero_ended(&block[NAME]);
        // GNU writes other things where ustar has the beginning of a long name.
        let prefix = if &block[MAGIC] == b"ustar\0" {
            zero_ended(&block[PREFIX])
        } else {
            String::new()
        };
        Some(Self {
            kind: block[KIND],
            name: if prefix.is_empty() {
                name
            } else {
                format!("{prefix}/{name}")
            },
            size: number(&block[SIZE])?,
        })
    }
}

/// A number of a header: octal digits, or big-endian if the first bit is set.
fn number(field: &[u8]) -> Option<u64> {
    match field {
        [first, rest @ ..] if first & 0x80 != 0 => {
            let (high, low) = rest.split_at_checked(rest.len().checked_sub(8)?)?;
            let is_small = *first == 0x80 && high.iter().all(|&byte| byte == 0);
            is_small.then(|| low.iter().fold(0, |number, &byte| number << 8 | u64::from(byte)))
        }
        _ => {
            let text = zero_ended(field);
            let digits = text.trim();
            if digits.is_empty() {
                return Some(0);
            }
            u64::from_str_radix(digits, 8).ok()
        }
    }
}

/// The text before the first zero. Bytes that are no UTF-8 are replaced.
fn zero_ended(bytes: &[u8]) -> String {
    let text = bytes.split(|&byte| byte == 0).next().unwrap_or_default();
    String::from_utf8_lossy(text).into_owned()
}

/// Lines of the form `LENGTH KEY=VALUE`. Errors: `Archive`.
fn read_pax(mut content: &[u8], long: &mut LongHeader, to: &Unpacker<'_>) -> Result<(), ImportError> {
    while !content.is_empty() {
        let (line, rest) = pax_line(content).ok_or_else(|| to.wrong("", "has a damaged header of pax"))?;
        content = rest;
        let text = String::from_utf8_lossy(line);
        match text.split_once('=') {
            Some(("path", path)) => long.name = Some(path.to_owned()),
            Some(("size", size)) => {
                long.size = Some(size.parse().map_err(|_| to.wrong("", "has a damaged header of pax"))?);
            }
            Some((key, _)) if key.starts_with("GNU.sparse.") => {
                return Err(to.wrong("", "holds a sparse file; pack it without --sparse"));
            }
            _ => {}
        }
    }
    Ok(())
}

/// The first line without its length, and the rest.
fn pax_line(content: &[u8]) -> Option<(&[u8], &[u8])> {
    let digits = content.iter().position(|&byte| byte == b' ')?;
    let length: usize = std::str::from_utf8(&content[..digits]).ok()?.parse().ok()?;
    let (line, rest) = content.split_at_checked(length)?;
    Some((line.get(digits + 1..)?.strip_suffix(b"\n")?, rest))
}

/// The content of a header that is not that of a file. Errors: `Archive`.
fn header_content(archive: &mut impl Read, size: u64, to: &Unpacker<'_>) -> Result<Vec<u8>, ImportError> {
    if size > MAX_HEADER_BYTES {
        return Err(to.wrong(
            "",
            format!("has a header of {size} bytes; {MAX_HEADER_BYTES} are possible"),
        ));
    }
    let mut content = vec![0; size as usize];
    archive.read_exact(&mut content).map_err(|error| broken(to, &error))?;
    skip(archive, padding(size), to)?;
    Ok(content)
}

/// Bytes from the end of a content to the next block.
fn padding(size: u64) -> u64 {
    (BLOCK as u64 - size % BLOCK as u64) % BLOCK as u64
}

/// Skips `bytes` bytes, or fewer at the end. Errors: `Archive`.
fn skip(archive: &mut impl Read, bytes: u64, to: &Unpacker<'_>) -> Result<(), ImportError> {
    let skipped = io::copy(&mut archive.take(bytes), &mut io::sink());
    skipped.map(drop).map_err(|error| broken(to, &error))
}

fn broken(to: &Unpacker<'_>, error: &io::Error) -> ImportError {
    match error.kind() {
        ErrorKind::UnexpectedEof => to.wrong("", "is cut off: it has no end of a tar archive"),
        _ => to.wrong("", format!("cannot be decompressed: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_octal_or_big_endian() {
        assert_eq!(number(b"0000017 \0"), Some(15));
        assert_eq!(number(b"\0\0\0\0"), Some(0));
        assert_eq!(number(b"12x"), None);
        assert_eq!(number(&[0x80, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 2]), Some(258));
        // Negative, and larger than 64 bits.
        assert_eq!(number(&[0xff; 12]), None);
        assert_eq!(number(&[0x80, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 2]), None);
    }

    #[test]
    fn lines_of_pax_state_their_length() {
        assert_eq!(pax_line(b"8 a=b c\n13"), Some((&b"a=b c"[..], &b"13"[..])));
        for damaged in [&b"9 a=b"[..], b"x a=b\n", b"99999999999999999999 a=b\n", b"0 a\n", b""] {
            assert_eq!(pax_line(damaged), None);
        }
    }
}
