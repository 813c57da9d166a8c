//! MCAP files: <https://mcap.dev/spec>. Read once from start to end, so that the index at the end is not needed and a file
//! that was cut off can be read; then message by message at the positions found.
//!
//! The crate `mcap` is not used: it does not say where in the file a message lies, and decompresses with libraries in C.

use std::borrow::Cow;
use std::collections::{HashMap, VecDeque};
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::compression::{self, MAX_RECORD_BYTES};
use super::index::{BagIndex, MAX_NAME_BYTES, MessageFile, Position};
use crate::dataset::import::error::ImportError;
use crate::dataset::import::files::open_file;
use foreframe_core::files::PositionedFile;

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
        self.0.split_off(..count)
    }

    fn array<const BYTES: usize>(&mut self) -> Option<[u8; BYTES]> {
        self.take(BYTES)?.first_chunk().copied()
    }

    fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    fn text(&mut self) -> Option<String> {
        let length = self.u32()?;
        let bytes = self.take(length as usize)?;
        Some(String::from_utf8_lossy(bytes).into_owned())
    }
}

/// The content of a chunk.
struct Chunk<'a> {
    /// The records without compression.
    records: Cow<'a, [u8]>,
    /// Where they lie in the chunk's record; `None` if they were compressed.
    start: Option<usize>,
}

impl<'a> Chunk<'a> {
    /// Reads the records in a chunk's record: all of them, or those that are left of a chunk that was cut off. Errors: the reason.
    fn read(body: &'a [u8], was_cut: bool) -> Result<Self, String> {
        let mut fields = Fields(body);
        let mut header = || {
            fields.take(16)?;
            Some((fields.u64()?, fields.u32()?, fields.text()?, fields.u64()?))
        };
        let (bytes, crc, compression, length) = header().ok_or("the chunk ends within its header")?;
        if bytes > MAX_RECORD_BYTES {
            return Err(too_large("the chunk", bytes));
        }
        let start = body.len() - fields.0.len();
        let length = usize::try_from(length).unwrap_or(usize::MAX).min(fields.0.len());
        let stored = &fields.0[..length];
        let chunk = if compression.is_empty() {
            Self {
                records: Cow::Borrowed(stored),
                start: Some(start),
            }
        } else {
            let (records, error) = compression::decompress(&compression, stored, bytes);
            if let Some(error) = error.filter(|_| !was_cut) {
                return Err(format!("the chunk {error}"));
            }
            Self {
                records: Cow::Owned(records),
                start: None,
            }
        };
        let found = chunk.records.len();
        if !was_cut && found as u64 != bytes {
            return Err(format!("the chunk has {found} bytes; its header says {bytes}"));
        }
        // 0 stands for no checksum.
        if !was_cut && crc != 0 && crc32fast::hash(&chunk.records) != crc {
            return Err("the chunk's content differs from its checksum (CRC-32)".to_owned());
        }
        Ok(chunk)
    }
}

fn too_large(what: &str, bytes: u64) -> String {
    format!("{what} has {bytes} bytes; at most {MAX_RECORD_BYTES} are read: write the recording with smaller chunks")
}

/// One pass over a file.
struct McapScan<'a, 'b> {
    file: Arc<McapFile>,
    /// Names of the schemas, by the numbers that the file gives them.
    schemas: HashMap<u16, String>,
    /// Topics of the channels, likewise.
    topics: HashMap<u16, usize>,
    index: &'a mut BagIndex<'b>,
}

/// Passes every message of a file to the index. Errors: `Io`, `Stopped`, `Record` where damage may not be left out.
pub(super) fn scan(path: &Path, index: &mut BagIndex<'_>) -> Result<(), ImportError> {
    let file = open_file(path)?;
    let file = Arc::new(McapFile {
        path: path.to_owned(),
        length: file.metadata().map_err(ImportError::io("read", path))?.len(),
        file: PositionedFile::new(file),
        cache: Mutex::default(),
    });
    index.files.push(file.clone());
    if file.length < MAGIC.len() as u64 || file.bytes(0, MAGIC.len())? != MAGIC {
        let reason = "this is not an MCAP file; it does not start with its magic bytes";
        return Err(ImportError::record(file.place_at(0), reason));
    }
    let mut scan = McapScan {
        file,
        schemas: HashMap::new(),
        topics: HashMap::new(),
        index,
    };
    scan.records()
}

impl McapScan<'_, '_> {
    fn fault(&mut self, offset: u64, reason: impl Display) -> Result<(), ImportError> {
        self.index.fault(self.file.place_at(offset), reason)
    }

    fn records(&mut self) -> Result<(), ImportError> {
        let file = Arc::clone(&self.file);
        let mut offset = MAGIC.len() as u64;
        loop {
            self.index.check_cancelled()?;
            let content = offset.saturating_add(RECORD_HEADER_BYTES);
            let Some(left) = file.length.checked_sub(content) else {
                let reason = "the file ends without the end of its data; the recording was cut off";
                return self.fault(offset, reason);
            };
            let (code, length) = file.header(offset)?;
            let body = || file.bytes(content, length.min(left) as usize);
            let is_read = matches!(
                code,
                operation::SCHEMA | operation::CHANNEL | operation::MESSAGE | operation::CHUNK
            );
            match code {
                operation::DATA_END | operation::FOOTER => return Ok(()),
                0 => return self.fault(offset, "no record starts here; the file is damaged from here on"),
                _ if is_read && length.min(left) > MAX_RECORD_BYTES => {
                    self.fault(offset, too_large("the record", length))?;
                }
                _ if length > left => {
                    let place = "the file ends in the middle of a record that starts here; the recording was cut off";
                    self.fault(offset, format!("{place} ({left} of {length} bytes are there)"))?;
                    if code == operation::CHUNK {
                        self.chunk(&body()?, offset, true)?;
                    }
                    return Ok(());
                }
                operation::CHUNK => self.chunk(&body()?, offset, false)?,
                _ if is_read => self.record(code, &body()?, None, content)?,
                _ => {}
            }
            offset = content.saturating_add(length);
        }
    }

    fn chunk(&mut self, body: &[u8], offset: u64, was_cut: bool) -> Result<(), ImportError> {
        let Chunk { records, start } = match Chunk::read(body, was_cut) {
            Ok(chunk) => chunk,
            Err(_) if was_cut => return Ok(()),
            Err(reason) => return self.fault(offset, reason),
        };
        // Without compression, the messages are read from the file itself.
        let (chunk, first) = match start {
            Some(start) => (None, offset + RECORD_HEADER_BYTES + start as u64),
            None => (Some(offset), 0),
        };
        let mut fields = Fields(&records);
        while !fields.0.is_empty() {
            let header = fields.array().zip(fields.u64());
            let start = first + (records.len() - fields.0.len()) as u64;
            let body = header.and_then(|(code, length)| Some((code, fields.take(usize::try_from(length).ok()?)?)));
            match body {
                Some(([code], body)) => self.record(code, body, chunk, start)?,
                None if was_cut => return Ok(()),
                None => return self.fault(offset, "the chunk ends in the middle of a record"),
            }
        }
        Ok(())
    }

    /// Takes a record whose content starts at `start`, in the file or in the compressed chunk whose record starts at `chunk`.
    fn record(&mut self, code: u8, body: &[u8], chunk: Option<u64>, start: u64) -> Result<(), ImportError> {
        let (what, taken) = match code {
            operation::SCHEMA => ("schema", self.schema(Fields(body))),
            operation::CHANNEL => ("channel", self.channel(Fields(body))),
            operation::MESSAGE => ("message", self.message(body, chunk, start)),
            _ => return Ok(()),
        };
        let reason = match taken {
            Some(Ok(())) => return Ok(()),
            Some(Err(reason)) => reason,
            None => format!("the {what}'s record is too short"),
        };
        self.fault(chunk.unwrap_or(start), reason)
    }

    /// `None` if the record is too short. Errors: why it is refused.
    fn schema(&mut self, mut fields: Fields<'_>) -> Option<Result<(), String>> {
        let (id, name) = (fields.u16()?, fields.text()?);
        let bytes = name.len();
        if bytes > MAX_NAME_BYTES {
            let reason = format!("the schema's name has {bytes} bytes; at most {MAX_NAME_BYTES} are read");
            return Some(Err(reason));
        }
        self.schemas.insert(id, name);
        Some(Ok(()))
    }

    /// As [`Self::schema`].
    fn channel(&mut self, mut fields: Fields<'_>) -> Option<Result<(), String>> {
        let (id, schema) = (fields.u16()?, fields.u16()?);
        let (topic, encoding) = (fields.text()?, fields.text()?);
        let type_name = self.schemas.get(&schema).cloned().unwrap_or_default();
        Some(self.index.topic(topic, type_name, encoding).map(|topic| {
            self.topics.insert(id, topic);
        }))
    }

    /// As [`Self::schema`].
    fn message(&mut self, body: &[u8], chunk: Option<u64>, start: u64) -> Option<Result<(), String>> {
        let mut fields = Fields(body);
        let (id, _sequence, log_time, _publish_time) = (fields.u16()?, fields.u32()?, fields.u64()?, fields.u64()?);
        let Some(&topic) = self.topics.get(&id) else {
            return Some(Err(format!("the message's channel {id} was not described before")));
        };
        let message = fields.0;
        let position = Position {
            chunk,
            start: start + (body.len() - message.len()) as u64,
            bytes: message.len(),
        };
        let log_ns = i64::try_from(log_time).unwrap_or(i64::MAX);
        self.index.message(topic, log_ns, position, message);
        Some(Ok(()))
    }
}

/// A file whose messages are read at known positions.
struct McapFile {
    path: PathBuf,
    file: PositionedFile,
    length: u64,
    /// The chunks that were read last, by the position of their record.
    cache: Mutex<VecDeque<(u64, Arc<Vec<u8>>)>>,
}

impl MessageFile for McapFile {
    fn message(&self, Position { chunk, start, bytes }: Position) -> Result<Vec<u8>, ImportError> {
        let Some(chunk) = chunk else {
            return self.bytes(start, bytes);
        };
        let records = self.chunk(chunk)?;
        let message = records.get(start as usize..).and_then(|rest| rest.get(..bytes));
        let changed = || ImportError::record(self.place_at(chunk), "the file has changed while it was read");
        message.map(<[u8]>::to_vec).ok_or_else(changed)
    }

    fn place(&self, Position { chunk, start, .. }: Position) -> String {
        match chunk {
            None => self.place_at(start),
            Some(chunk) => format!("{} of the chunk at byte {chunk}", self.place_at(start)),
        }
    }
}

impl McapFile {
    fn place_at(&self, offset: u64) -> String {
        format!("{} byte {offset}", self.path.display())
    }

    fn bytes(&self, offset: u64, count: usize) -> Result<Vec<u8>, ImportError> {
        let mut bytes = vec![0; count];
        let read = self.file.read_at(&mut bytes, offset);
        read.map_err(ImportError::io("read", &self.path))?;
        Ok(bytes)
    }

    /// Operation code and length of the record at a position.
    fn header(&self, offset: u64) -> Result<(u8, u64), ImportError> {
        let header = self.bytes(offset, RECORD_HEADER_BYTES as usize)?;
        Ok((header[0], Fields(&header[1..]).u64().unwrap_or_default()))
    }

    /// The decompressed records of a chunk.
    fn chunk(&self, offset: u64) -> Result<Arc<Vec<u8>>, ImportError> {
        let cache = || self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, found)) = cache().iter().find(|(of, _)| *of == offset) {
            return Ok(Arc::clone(found));
        }
        let content = offset + RECORD_HEADER_BYTES;
        let (_, length) = self.header(offset)?;
        let left = self.length.saturating_sub(content);
        let body = self.bytes(content, length.min(left).min(MAX_RECORD_BYTES) as usize)?;
        let chunk = Chunk::read(&body, length > left);
        let chunk = chunk.map_err(|reason| ImportError::record(self.place_at(offset), reason))?;
        let records = Arc::new(chunk.records.into_owned());
        let mut cache = cache();
        let mut total = cache.iter().map(|(_, records)| records.len()).sum::<usize>() + records.len();
        while total > CACHE_BYTES
            && let Some((_, oldest)) = cache.pop_front()
        {
            total -= oldest.len();
        }
        cache.push_back((offset, Arc::clone(&records)));
        Ok(records)
    }
}
