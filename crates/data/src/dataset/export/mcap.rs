//! Writes MCAP files: <https://mcap.dev/spec>. Chunks without compression, with checksums and with all indexes, as
//! `ros2 bag record` writes them. The crate `mcap` is not used: the import cannot use it (`import/bag/mcap` says why), and this
//! file is all that writing takes.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::ops::Range;
use std::path::Path;

use crate::dataset::DatasetError;

const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// Number of bytes after which a chunk is closed.
const CHUNK_BYTES: usize = 1 << 20;

mod operation {
    pub(super) const HEADER: u8 = 1;
    pub(super) const FOOTER: u8 = 2;
    pub(super) const SCHEMA: u8 = 3;
    pub(super) const CHANNEL: u8 = 4;
    pub(super) const MESSAGE: u8 = 5;
    pub(super) const CHUNK: u8 = 6;
    pub(super) const MESSAGE_INDEX: u8 = 7;
    pub(super) const CHUNK_INDEX: u8 = 8;
    pub(super) const STATISTICS: u8 = 11;
    pub(super) const SUMMARY_OFFSET: u8 = 14;
    pub(super) const DATA_END: u8 = 15;
}

/// A record of these fields.
fn record(operation: u8, fields: &[&[u8]]) -> Vec<u8> {
    let fields = fields.concat();
    let length = (fields.len() as u64).to_le_bytes();
    [&[operation][..], &length, &fields].concat()
}

/// A text, or a map or array that is already written, after its length in bytes.
fn sized(bytes: impl AsRef<[u8]>) -> Vec<u8> {
    let bytes = bytes.as_ref();
    [&(bytes.len() as u32).to_le_bytes(), bytes].concat()
}

fn u64s(values: &[u64]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

/// A topic of one type.
struct TopicWriter {
    messages: u64,
    /// Time, and position in the open chunk, of the messages of that chunk.
    in_chunk: Vec<u64>,
}

/// Messages of some topics on their way into a file.
pub(super) struct McapWriter<'a> {
    out: BufWriter<File>,
    /// The name of the file in errors.
    path: &'a Path,
    written: u64,
    topics: Vec<TopicWriter>,
    /// One of each topic.
    schemas: Vec<Vec<u8>>,
    channels: Vec<Vec<u8>>,
    chunk: Vec<u8>,
    /// First and last time of the open chunk's messages, and of all.
    chunk_times: Option<[u64; 2]>,
    times: Option<[u64; 2]>,
    chunk_indexes: Vec<Vec<u8>>,
}

fn including(times: Option<[u64; 2]>, time: u64) -> [u64; 2] {
    let [first, last] = times.unwrap_or([time, time]);
    [first.min(time), last.max(time)]
}

impl<'a> McapWriter<'a> {
    /// Begins a file, whose errors name `path`. Errors: `Io`.
    pub(super) fn new(file: File, path: &'a Path) -> Result<Self, DatasetError> {
        let mut writer = Self {
            out: BufWriter::new(file),
            path,
            written: 0,
            topics: Vec::new(),
            schemas: Vec::new(),
            channels: Vec::new(),
            chunk: Vec::new(),
            chunk_times: None,
            times: None,
            chunk_indexes: Vec::new(),
        };
        writer.put(MAGIC)?;
        let library = concat!("foreframe ", env!("CARGO_PKG_VERSION"));
        writer.put(&record(operation::HEADER, &[&sized("ros2"), &sized(library)]))?;
        Ok(writer)
    }

    fn put(&mut self, bytes: &[u8]) -> Result<(), DatasetError> {
        self.written += bytes.len() as u64;
        let written = self.out.write_all(bytes);
        written.map_err(DatasetError::io("write", self.path))
    }

    /// Adds a topic and returns its number. `definition` is the type's message definition with those of its parts.
    pub(super) fn topic(&mut self, name: &str, type_name: &str, definition: &str) -> u16 {
        let number = self.topics.len() as u16 + 1;
        let (id, definition) = (number.to_le_bytes(), sized(definition));
        let schema = [&id[..], &sized(type_name), &sized("ros2msg"), &definition];
        let channel = [&id[..], &id, &sized(name), &sized("cdr"), &sized("")];
        self.schemas.push(record(operation::SCHEMA, &schema));
        self.channels.push(record(operation::CHANNEL, &channel));
        let records = [&self.schemas, &self.channels].map(|records| &records[usize::from(number) - 1]);
        self.chunk.extend(records.into_iter().flatten());
        self.topics.push(TopicWriter {
            messages: 0,
            in_chunk: Vec::new(),
        });
        number
    }

    /// Adds a message of a topic. Errors: `Io`.
    pub(super) fn message(&mut self, topic: u16, time_ns: u64, content: &[u8]) -> Result<(), DatasetError> {
        let position = self.chunk.len() as u64;
        if let Some(of) = self.topics.get_mut(usize::from(topic) - 1) {
            let sequence = (of.messages as u32).to_le_bytes();
            let fields = [&topic.to_le_bytes()[..], &sequence, &u64s(&[time_ns, time_ns]), content];
            self.chunk.extend(record(operation::MESSAGE, &fields));
            of.messages += 1;
            of.in_chunk.extend([time_ns, position]);
        }
        self.chunk_times = Some(including(self.chunk_times, time_ns));
        self.times = Some(including(self.times, time_ns));
        if self.chunk.len() >= CHUNK_BYTES {
            self.close_chunk()?;
        }
        Ok(())
    }

    fn close_chunk(&mut self) -> Result<(), DatasetError> {
        let Some(times) = self.chunk_times.take() else {
            return Ok(());
        };
        let times = u64s(&times);
        let records = std::mem::take(&mut self.chunk);
        let length = (records.len() as u64).to_le_bytes();
        let checksum = crc32fast::hash(&records).to_le_bytes();
        let chunk_start = self.written;
        let fields = [&times[..], &length, &checksum, &sized(""), &length, &records];
        self.put(&record(operation::CHUNK, &fields))?;
        let indexes_start = self.written;
        let mut offsets = Vec::new();
        for topic in 0..self.topics.len() {
            let entries = std::mem::take(&mut self.topics[topic].in_chunk);
            if entries.is_empty() {
                continue;
            }
            let id = (topic as u16 + 1).to_le_bytes();
            offsets.extend(id);
            offsets.extend(self.written.to_le_bytes());
            let fields = [&id[..], &sized(u64s(&entries))];
            self.put(&record(operation::MESSAGE_INDEX, &fields))?;
        }
        let place = u64s(&[chunk_start, indexes_start - chunk_start]);
        let indexes = (self.written - indexes_start).to_le_bytes();
        let fields = [
            &times[..],
            &place,
            &sized(offsets),
            &indexes,
            &sized(""),
            &length,
            &length,
        ];
        self.chunk_indexes.push(record(operation::CHUNK_INDEX, &fields));
        Ok(())
    }

    /// Writes a group of the summary. Returns where it is.
    fn group(&mut self, records: &[Vec<u8>]) -> Result<Range<u64>, DatasetError> {
        let start = self.written;
        for record in records {
            self.put(record)?;
        }
        Ok(start..self.written)
    }

    fn statistics(&self, chunks: usize) -> Vec<u8> {
        let counts = (1u16..).zip(self.topics.iter().map(|topic| topic.messages));
        let counts = counts.flat_map(|(id, count)| [&id.to_le_bytes()[..], &count.to_le_bytes()].concat());
        let messages: u64 = self.topics.iter().map(|topic| topic.messages).sum();
        let topics = self.topics.len();
        let fields = [
            &messages.to_le_bytes()[..],
            &(topics as u16).to_le_bytes(),
            &(topics as u32).to_le_bytes(),
            // Neither attachments nor metadata.
            &[0; 8],
            &(chunks as u32).to_le_bytes(),
            &u64s(&self.times.unwrap_or_default()),
            &sized(counts.collect::<Vec<u8>>()),
        ];
        record(operation::STATISTICS, &fields)
    }

    /// Writes the indexes; the file is then complete. Errors: `Io`.
    pub(super) fn finish(mut self) -> Result<(), DatasetError> {
        self.close_chunk()?;
        self.put(&record(operation::DATA_END, &[&[0; 4]]))?;
        let summary_start = self.written;
        let (schemas, channels) = (std::mem::take(&mut self.schemas), std::mem::take(&mut self.channels));
        let chunks = std::mem::take(&mut self.chunk_indexes);
        let statistics = vec![self.statistics(chunks.len())];
        let mut offsets = Vec::new();
        for (operation, records) in [
            (operation::SCHEMA, schemas),
            (operation::CHANNEL, channels),
            (operation::CHUNK_INDEX, chunks),
            (operation::STATISTICS, statistics),
        ] {
            let group = self.group(&records)?;
            if !group.is_empty() {
                let place = u64s(&[group.start, group.end - group.start]);
                offsets.push(record(operation::SUMMARY_OFFSET, &[&[operation], &place]));
            }
        }
        let offsets = self.group(&offsets)?;
        let footer = [&u64s(&[summary_start, offsets.start])[..], &[0; 4]];
        self.put(&record(operation::FOOTER, &footer))?;
        self.put(MAGIC)?;
        let saved = self.out.flush().and_then(|()| self.out.get_ref().sync_all());
        saved.map_err(DatasetError::io("write", self.path))
    }
}
