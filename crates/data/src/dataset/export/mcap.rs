//! Writes MCAP files: <https://mcap.dev/spec>. Chunks without compression, with checksums and with all indexes, as
//! `ros2 bag record` writes them.

use std::io::{self, Write};
use std::ops::Range;

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

/// The fields of a record, little endian.
#[derive(Default)]
struct RecordFields(Vec<u8>);

impl RecordFields {
    fn u16(self, value: u16) -> Self {
        self.raw(&value.to_le_bytes())
    }

    fn u32(self, value: u32) -> Self {
        self.raw(&value.to_le_bytes())
    }

    fn u64(self, value: u64) -> Self {
        self.raw(&value.to_le_bytes())
    }

    fn u64s(self, values: &[u64]) -> Self {
        values.iter().fold(self, |fields, &value| fields.u64(value))
    }

    /// A text, or a map or array that is already written, after its length in bytes.
    fn sized(self, bytes: &[u8]) -> Self {
        self.u32(bytes.len() as u32).raw(bytes)
    }

    fn text(self, text: &str) -> Self {
        self.sized(text.as_bytes())
    }

    fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }

    /// The whole record.
    fn record(self, operation: u8) -> Vec<u8> {
        let length = (self.0.len() as u64).to_le_bytes();
        [&[operation][..], &length, &self.0].concat()
    }
}

/// A topic of one type.
struct TopicWriter {
    /// Its schema and its channel.
    records: [Vec<u8>; 2],
    messages: u64,
    /// Time, and position in the open chunk, of the messages of that chunk.
    in_chunk: Vec<u64>,
}

/// Messages of some topics on their way into a file.
pub(super) struct McapWriter<W> {
    out: W,
    written: u64,
    topics: Vec<TopicWriter>,
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

impl<W: Write> McapWriter<W> {
    /// Begins a file. Errors: those of the writer.
    pub(super) fn new(out: W) -> io::Result<Self> {
        let mut writer = Self {
            out,
            written: 0,
            topics: Vec::new(),
            chunk: Vec::new(),
            chunk_times: None,
            times: None,
            chunk_indexes: Vec::new(),
        };
        writer.put(MAGIC)?;
        let library = concat!("foreframe ", env!("CARGO_PKG_VERSION"));
        writer.put(
            &RecordFields::default()
                .text("ros2")
                .text(library)
                .record(operation::HEADER),
        )?;
        Ok(writer)
    }

    fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.written += bytes.len() as u64;
        self.out.write_all(bytes)
    }

    /// Adds a topic and returns its number. `definition` is the type's message definition with those of its parts.
    pub(super) fn topic(&mut self, name: &str, type_name: &str, definition: &str) -> u16 {
        let id = self.topics.len() as u16 + 1;
        let schema = RecordFields::default().u16(id).text(type_name).text("ros2msg");
        let channel = RecordFields::default().u16(id).u16(id).text(name).text("cdr");
        let records = [
            schema.text(definition).record(operation::SCHEMA),
            channel.sized(&[]).record(operation::CHANNEL),
        ];
        self.chunk.extend(records.concat());
        self.topics.push(TopicWriter {
            records,
            messages: 0,
            in_chunk: Vec::new(),
        });
        id
    }

    /// Adds a message of a topic. Errors: those of the writer.
    pub(super) fn message(&mut self, topic: u16, time_ns: u64, content: &[u8]) -> io::Result<()> {
        let position = self.chunk.len() as u64;
        if let Some(of) = self.topics.get_mut(usize::from(topic) - 1) {
            let fields = RecordFields::default().u16(topic).u32(of.messages as u32);
            let fields = fields.u64s(&[time_ns, time_ns]).raw(content);
            self.chunk.extend(fields.record(operation::MESSAGE));
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

    fn close_chunk(&mut self) -> io::Result<()> {
        let Some(times) = self.chunk_times.take() else {
            return Ok(());
        };
        let records = std::mem::take(&mut self.chunk);
        let length = records.len() as u64;
        let fields = RecordFields::default().u64s(&times).u64(length);
        let fields = fields.u32(crc32fast::hash(&records)).text("").u64(length).raw(&records);
        let chunk_start = self.written;
        self.put(&fields.record(operation::CHUNK))?;
        let indexes_start = self.written;
        let mut offsets = RecordFields::default();
        for topic in 0..self.topics.len() {
            let entries = std::mem::take(&mut self.topics[topic].in_chunk);
            if entries.is_empty() {
                continue;
            }
            let id = topic as u16 + 1;
            offsets = offsets.u16(id).u64(self.written);
            let entries = RecordFields::default().u64s(&entries);
            let index = RecordFields::default().u16(id).sized(&entries.0);
            self.put(&index.record(operation::MESSAGE_INDEX))?;
        }
        let index = RecordFields::default()
            .u64s(&times)
            .u64s(&[chunk_start, indexes_start - chunk_start])
            .sized(&offsets.0)
            .u64(self.written - indexes_start)
            .text("")
            .u64s(&[length, length]);
        self.chunk_indexes.push(index.record(operation::CHUNK_INDEX));
        Ok(())
    }

    /// Writes a group of the summary. Returns where it is.
    fn group(&mut self, records: &[Vec<u8>]) -> io::Result<Range<u64>> {
        let start = self.written;
        for record in records {
            self.put(record)?;
        }
        Ok(start..self.written)
    }

    fn statistics(&self) -> Vec<u8> {
        let messages = self.topics.iter().map(|topic| topic.messages);
        let counts = messages.clone().zip(1..);
        let counts = counts.fold(RecordFields::default(), |fields, (count, id)| fields.u16(id).u64(count));
        let topics = self.topics.len();
        RecordFields::default()
            .u64(messages.sum())
            .u16(topics as u16)
            .u32(topics as u32)
            .u32(0)
            .u32(0)
            .u32(self.chunk_indexes.len() as u32)
            .u64s(&self.times.unwrap_or_default())
            .sized(&counts.0)
            .record(operation::STATISTICS)
    }

    /// Writes the indexes; the file is then complete. Errors: those of the writer.
    pub(super) fn finish(mut self) -> io::Result<()> {
        self.close_chunk()?;
        self.put(&RecordFields::default().u32(0).record(operation::DATA_END))?;
        let summary_start = self.written;
        let of_topics = |part: usize| self.topics.iter().map(|topic| topic.records[part].clone()).collect();
        let (schemas, channels): (Vec<_>, Vec<_>) = (of_topics(0), of_topics(1));
        let statistics = vec![self.statistics()];
        let chunks = std::mem::take(&mut self.chunk_indexes);
        let mut offsets = Vec::new();
        for (operation, records) in [
            (operation::SCHEMA, schemas),
            (operation::CHANNEL, channels),
            (operation::CHUNK_INDEX, chunks),
            (operation::STATISTICS, statistics),
        ] {
            let group = self.group(&records)?;
            if !group.is_empty() {
                let fields = RecordFields::default().raw(&[operation]);
                let fields = fields.u64s(&[group.start, group.end - group.start]);
                offsets.push(fields.record(operation::SUMMARY_OFFSET));
            }
        }
        let offsets = self.group(&offsets)?;
        let footer = RecordFields::default().u64s(&[summary_start, offsets.start]).u32(0);
        self.put(&footer.record(operation::FOOTER))?;
        self.put(MAGIC)?;
        self.out.flush()
    }
}
