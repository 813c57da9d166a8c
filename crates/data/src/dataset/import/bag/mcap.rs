//! MCAP files: <https://mcap.dev/spec>. Read once from start to end, so that the index at the end is not needed and a file
//! that was cut off can be read; then message by message at the positions found.
//!
//! The crate `mcap` is not used: it does not say where in the file a message lies, and decompresses with libraries in C.

use std::borrow::Cow;
use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::compression::{self, MAX_RECORD_BYTES};
use super::index::{BagIndex, MAX_NAME_BYTES, Position};
use crate::dataset::import::error::ImportError;
use crate::dataset::import::files::open_file;

const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// The operation code and the length of a record.
const RECORD_HEADER_BYTES: u64 = 9;
/// Decompressed chunks that are kept for the messages after the one that was read.
const CACHE_BYTES: usize = 48 << 20;

mod operation {
    pub(super) const FOOTER: u8 = 2;
    pub(super) const SCHEMA: u8 = 3;
    pub(super) const CHANNEL: u8 = 4;
    pub(super) const MESSAGE: u8 = 5;
    pub(super) const CHUNK: u8 = 6;
    pub(super) const DATA_END: u8 = 15;
}

/// Reads a record's fields, little endian; `None` where it ends too early.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }

    fn u16(&mut self) -> Option<u16> {
        self.take(2)?.first_chunk().copied().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take(4)?.first_chunk().copied().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take(8)?.first_chunk().copied().map(u64::from_le_bytes)
    }

    fn text(&mut self) -> Option<String> {
        let length = self.u32()?;
        let bytes = self.take(length as usize)?;
        Some(String::from_utf8_lossy(bytes).into_owned())
    }
}

/// The record of a chunk.
struct Chunk<'a> {
    records_bytes: u64,
    crc: u32,
    compression: String,
    /// Position of the records within the chunk's record.
    start: usize,
    /// The records, perhaps compressed, perhaps cut off.
    records: &'a [u8],
}

impl<'a> Chunk<'a> {
    /// Reads a chunk's record, or what is left of it. Errors: the reason.
    fn parse(body: &'a [u8]) -> Result<Self, String> {
        let mut fields = Fields(body);
        let mut read = || {
            fields.take(16)?;
            let (records_bytes, crc, compression) = (fields.u64()?, fields.u32()?, fields.text()?);
            Some((records_bytes, crc, compression, fields.u64()?))
        };
        let Some((records_bytes, crc, compression, length)) = read() else {
            return Err("the chunk ends within its header".to_owned());
        };
        if records_bytes > MAX_RECORD_BYTES {
            return Err(too_large("the chunk", records_bytes));
        }
        let start = body.len() - fields.0.len();
        let length = usize::try_from(length).unwrap_or(usize::MAX).min(fields.0.len());
        Ok(Self {
            records_bytes,
            crc,
            compression,
            start,
            records: &fields.0[..length],
        })
    }

    /// The records without compression: all of them, or those that a chunk that was cut off still has. Errors: the reason.
    fn decompress(&self, was_cut: bool) -> Result<Cow<'a, [u8]>, String> {
        let records = match self.compression.as_str() {
            "" => Cow::Borrowed(self.records),
            name => {
                let (bytes, error) = compression::decompress(name, self.records, self.records_bytes);
                match error.filter(|_| !was_cut) {
                    Some(error) => return Err(format!("the chunk {error}")),
                    None => Cow::Owned(bytes),
                }
            }
        };
        if was_cut {
            return Ok(records);
        }
        if records.len() as u64 != self.records_bytes {
            return Err(format!(
                "the chunk has {} bytes; its header says {}",
                records.len(),
                self.records_bytes
            ));
        }
        // 0 stands for no checksum.
        if self.crc != 0 && crc32fast::hash(&records) != self.crc {
            return Err("the chunk's content differs from its checksum (CRC-32)".to_owned());
        }
        Ok(records)
    }
}

fn too_large(what: &str, bytes: u64) -> String {
    format!("{what} has {bytes} bytes; at most {MAX_RECORD_BYTES} are read: write the recording with smaller chunks")
}

/// A schema's name and a channel's topic, by the numbers that the file gives them.
#[derive(Default)]
struct Channels {
    schemas: HashMap<u16, String>,
    topics: HashMap<u16, usize>,
}

/// Where the records of a piece of memory come from.
enum Origin {
    /// They lie in the file from here on.
    File(u64),
    /// They lie in the compressed chunk whose record starts here.
    Chunk(u64),
}

/// One pass over a file.
struct McapScan<'a, 'b> {
    path: &'a Path,
    reader: BufReader<&'a File>,
    length: u64,
    channels: Channels,
    index: &'a mut BagIndex<'b>,
}

/// Passes every message of a file to the index. Errors: `Io`, `Stopped`, `Record` where damage may not be left out.
pub(super) fn scan(path: &Path, index: &mut BagIndex<'_>) -> Result<(), ImportError> {
    let file = open_file(path)?;
    let length = file.metadata().map_err(ImportError::io("read", path))?.len();
    let mut scan = McapScan {
        path,
        reader: BufReader::new(&file),
        length,
        channels: Channels::default(),
        index,
    };
    let mut magic = [0; 8];
    if length < 8 || scan.reader.read_exact(&mut magic).is_err() || &magic != MAGIC {
        return Err(ImportError::record(
            format!("{} byte 0", path.display()),
            "this is not an MCAP file; it does not start with its magic bytes",
        ));
    }
    scan.records()
}

impl McapScan<'_, '_> {
    fn fault(&mut self, offset: u64, reason: impl Into<String>) -> Result<(), ImportError> {
        self.index
            .fault(format!("{} byte {offset}", self.path.display()), reason.into())
    }

    fn records(&mut self) -> Result<(), ImportError> {
        let (mut offset, mut body) = (MAGIC.len() as u64, Vec::new());
        loop {
            self.index.check_cancelled()?;
            let mut header = [0; RECORD_HEADER_BYTES as usize];
            let left = self.length.saturating_sub(offset.saturating_add(RECORD_HEADER_BYTES));
            if offset.saturating_add(RECORD_HEADER_BYTES) > self.length {
                return self.fault(
                    offset,
                    "the file ends without the end of its data; the recording was cut off",
                );
            }
            self.read(&mut header)?;
            let [code, length @ ..] = header;
            let length = u64::from_le_bytes(length);
            let is_read = matches!(
                code,
                operation::SCHEMA | operation::CHANNEL | operation::MESSAGE | operation::CHUNK
            );
            match code {
                operation::DATA_END | operation::FOOTER => return Ok(()),
                0 => return self.fault(offset, "no record starts here; the file is damaged from here on"),
                _ if is_read && length.min(left) > MAX_RECORD_BYTES => {
                    self.fault(offset, too_large("the record", length))?;
                    self.skip(length.min(left))?;
                }
                _ if length > left => {
                    let place = "the file ends in the middle of a record that starts here; the recording was cut off";
                    self.fault(offset, format!("{place} ({left} of {length} bytes are there)"))?;
                    if code == operation::CHUNK {
                        body.resize(left as usize, 0);
                        self.read(&mut body)?;
                        self.chunk(&body, offset, true)?;
                    }
                    return Ok(());
                }
                _ if is_read => {
                    body.resize(length as usize, 0);
                    self.read(&mut body)?;
                    match code {
                        operation::CHUNK => self.chunk(&body, offset, false)?,
                        _ => self.record(code, &body, &Origin::File(0), offset + RECORD_HEADER_BYTES)?,
                    }
                }
                _ => self.skip(length)?,
            }
            offset = offset.saturating_add(RECORD_HEADER_BYTES).saturating_add(length);
        }
    }

    fn read(&mut self, bytes: &mut [u8]) -> Result<(), ImportError> {
        self.reader
            .read_exact(bytes)
            .map_err(ImportError::io("read", self.path))
    }

    fn skip(&mut self, bytes: u64) -> Result<(), ImportError> {
        self.reader
            .seek_relative(bytes as i64)
            .map_err(ImportError::io("read", self.path))
    }

    fn chunk(&mut self, body: &[u8], offset: u64, was_cut: bool) -> Result<(), ImportError> {
        let parsed = Chunk::parse(body).and_then(|chunk| chunk.decompress(was_cut).map(|records| (chunk, records)));
        let (chunk, records) = match parsed {
            Ok(parsed) => parsed,
            Err(_) if was_cut => return Ok(()),
            Err(reason) => return self.fault(offset, reason),
        };
        let origin = match chunk.compression.as_str() {
            "" => Origin::File(offset + RECORD_HEADER_BYTES + chunk.start as u64),
            _ => Origin::Chunk(offset),
        };
        let mut fields = Fields(&records);
        while !fields.0.is_empty() {
            let header = fields.take(1).zip(fields.u64());
            let found = header.and_then(|(code, length)| {
                let start = records.len() - fields.0.len();
                Some((code[0], start, fields.take(usize::try_from(length).ok()?)?))
            });
            match found {
                Some((code, start, body)) => self.record(code, body, &origin, start as u64)?,
                None if was_cut => return Ok(()),
                None => return self.fault(offset, "the chunk ends in the middle of a record"),
            }
        }
        Ok(())
    }

    /// Takes a record whose content starts at `start` of its origin.
    fn record(&mut self, code: u8, body: &[u8], origin: &Origin, start: u64) -> Result<(), ImportError> {
        let at = match origin {
            Origin::File(offset) => offset + start,
            Origin::Chunk(offset) => *offset,
        };
        let mut fields = Fields(body);
        match code {
            operation::SCHEMA => match fields.u16().zip(fields.text()) {
                Some((_, name)) if name.len() > MAX_NAME_BYTES => {
                    let bytes = name.len();
                    let reason = format!("the schema's name has {bytes} bytes; at most {MAX_NAME_BYTES} are read");
                    self.fault(at, reason)?;
                }
                Some((id, name)) => drop(self.channels.schemas.insert(id, name)),
                None => self.fault(at, "the schema's record is too short")?,
            },
            operation::CHANNEL => {
                let ids = fields.u16().zip(fields.u16());
                match ids.zip(fields.text().zip(fields.text())) {
                    Some(((id, schema), (topic, encoding))) => {
                        let type_name = self.channels.schemas.get(&schema).cloned().unwrap_or_default();
                        match self.index.topic(topic, type_name, encoding) {
                            Ok(topic) => drop(self.channels.topics.insert(id, topic)),
                            Err(reason) => self.fault(at, reason)?,
                        }
                    }
                    None => self.fault(at, "the channel's record is too short")?,
                }
            }
            operation::MESSAGE => {
                let header = fields.u16().zip(fields.u32().and(fields.u64()));
                let Some(((id, log_time), _)) = header.zip(fields.u64()) else {
                    return self.fault(at, "the message's record is too short");
                };
                let Some(&topic) = self.channels.topics.get(&id) else {
                    return self.fault(at, format!("the message's channel {id} was not described before"));
                };
                let start = start + (body.len() - fields.0.len()) as u64;
                let bytes = fields.0.len();
                let position = match origin {
                    Origin::File(offset) => Position::File {
                        offset: offset + start,
                        bytes,
                    },
                    Origin::Chunk(chunk) => Position::Chunk {
                        chunk: *chunk,
                        start: start as usize,
                        bytes,
                    },
                };
                let log_time = i64::try_from(log_time).unwrap_or(i64::MAX);
                self.index.message(topic, log_time, position, fields.0);
            }
            _ => {}
        }
        Ok(())
    }
}

/// A file whose messages are read at known positions.
pub(super) struct McapFile {
    path: PathBuf,
    file: Mutex<File>,
    /// The chunks that were read last, the latest at the end, by the position of their record.
    cache: Mutex<Vec<(u64, Arc<Vec<u8>>)>>,
}

impl McapFile {
    /// Errors: `Io`.
    pub(super) fn open(path: &Path) -> Result<Self, ImportError> {
        Ok(Self {
            path: path.to_owned(),
            file: Mutex::new(open_file(path)?),
            cache: Mutex::new(Vec::new()),
        })
    }

    /// The message at a position that [`scan`] found. Errors: `Io`, and `Record` if the file has changed since.
    pub(super) fn message(&self, position: Position) -> Result<Vec<u8>, ImportError> {
        let changed = |at: u64| {
            ImportError::record(
                format!("{} byte {at}", self.path.display()),
                "the file has changed while it was read",
            )
        };
        match position {
            Position::File { offset, bytes } => self.bytes(offset, bytes),
            Position::Chunk { chunk, start, bytes } => {
                let records = self.chunk(chunk)?;
                let message = records.get(start..).and_then(|rest| rest.get(..bytes));
                message.map(<[u8]>::to_vec).ok_or_else(|| changed(chunk))
            }
            #[cfg(feature = "databases")]
            Position::Row(_) => Err(changed(0)),
        }
    }

    fn bytes(&self, offset: u64, count: usize) -> Result<Vec<u8>, ImportError> {
        let mut bytes = vec![0; count];
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(offset))
            .and_then(|_| file.read_exact(&mut bytes))
            .map_err(ImportError::io("read", &self.path))?;
        Ok(bytes)
    }

    /// The decompressed records of a chunk.
    fn chunk(&self, offset: u64) -> Result<Arc<Vec<u8>>, ImportError> {
        if let Some(found) = self.cached(offset) {
            return Ok(found);
        }
        let header = self.bytes(offset, RECORD_HEADER_BYTES as usize)?;
        let length = header[1..]
            .first_chunk()
            .map_or(0, |length| u64::from_le_bytes(*length));
        let left = {
            let file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
            let end = file.metadata().map_err(ImportError::io("read", &self.path))?.len();
            end.saturating_sub(offset + RECORD_HEADER_BYTES)
        };
        let body = self.bytes(
            offset + RECORD_HEADER_BYTES,
            length.min(left).min(MAX_RECORD_BYTES) as usize,
        )?;
        let records = Chunk::parse(&body)
            .and_then(|chunk| chunk.decompress(length > left).map(Cow::into_owned))
            .map_err(|reason| ImportError::record(format!("{} byte {offset}", self.path.display()), reason))?;
        let records = Arc::new(records);
        let mut cache = self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        let mut total: usize = cache.iter().map(|(_, records)| records.len()).sum();
        while total + records.len() > CACHE_BYTES && !cache.is_empty() {
            total -= cache.remove(0).1.len();
        }
        cache.push((offset, records.clone()));
        Ok(records)
    }

    fn cached(&self, offset: u64) -> Option<Arc<Vec<u8>>> {
        let mut cache = self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        let place = cache.iter().position(|(of, _)| *of == offset)?;
        let found = cache.remove(place);
        let records = found.1.clone();
        cache.push(found);
        Some(records)
    }
}
