//! The index of a bag, made by one pass over its files: where the images are, and the values and times of everything else that may be used.

use std::borrow::Cow;
use std::collections::HashMap;
use std::fmt::Display;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use indexmap::IndexMap;

use super::compression;
use super::messages::{self, FieldValue, Projection, RosType};
use crate::dataset::import::skipped::{SkippedItem, SkippedList};
use crate::dataset::import::{ImportError, ImportOptions};

/// The maximum number of topics that can be imported, and of others.
const MAX_TOPICS: usize = 4096;
/// A topic has at most this number of fields.
const MAX_FIELDS: usize = 4096;
/// The longest name of a topic, a type or a field, in bytes.
pub(super) const MAX_NAME_BYTES: usize = 1024;

/// A file of messages.
pub(super) trait MessageFile: Send + Sync {
    /// The message at a position that was found by the pass over the file. Errors: `Io`, `Record`.
    fn message(&self, position: Position) -> Result<Vec<u8>, ImportError>;

    /// File and position, for people.
    fn place(&self, position: Position) -> String;
}

/// Where a message lies in its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Position {
    /// The start of the compressed chunk that it lies in.
    pub(super) chunk: Option<u64>,
    /// Its first byte in the file or in the decompressed chunk; in a database, the number of its row.
    pub(super) start: u64,
    pub(super) bytes: usize,
}

/// When a message was recorded and, by its header, when it was made; in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct MessageTime {
    pub(super) log_ns: i64,
    /// `None` without a header, or with one that nobody set.
    pub(super) stamp_ns: Option<i64>,
}

/// Which message it is.
#[derive(Clone, Copy)]
pub(super) struct MessageEntry {
    pub(super) time: MessageTime,
    /// Its number in its topic, from 0.
    pub(super) number: u64,
    /// Position of its file in [`BagIndex::files`].
    pub(super) file: usize,
    pub(super) position: Position,
}

/// A field of a topic.
pub(super) struct MessageField {
    pub(super) unit: &'static str,
    pub(super) is_ever_other_than_0: bool,
}

/// A message whose values were taken.
pub(super) struct MessageValues {
    pub(super) time: MessageTime,
    /// Its number in its topic, from 0.
    pub(super) number: u64,
    /// Where its values end.
    end: usize,
}

/// The values of a topic. A message need not have all fields (a `JointState` may have some joints only).
#[derive(Default)]
pub(super) struct ValueStream {
    /// All fields, in the order in which they appeared.
    pub(super) fields: IndexMap<Cow<'static, str>, MessageField>,
    messages: Vec<MessageValues>,
    /// Positions of fields and their values.
    values: Vec<(u32, f32)>,
}

impl ValueStream {
    /// Errors: why the message is refused.
    fn push(&mut self, time: MessageTime, number: u64, fields: Vec<FieldValue>) -> Result<(), String> {
        let new = fields.iter().filter(|field| !self.fields.contains_key(&field.name));
        let (mut count, mut longest) = (self.fields.len(), 0);
        for field in new {
            (count, longest) = (count + 1, longest.max(field.name.len()));
        }
        if count > MAX_FIELDS || longest > MAX_NAME_BYTES {
            return Err(format!(
                "its topic would have {count} fields, the longest new name with {longest} bytes; at most {MAX_FIELDS} fields \
                 and {MAX_NAME_BYTES} bytes per name are read"
            ));
        }
        for FieldValue { name, unit, value } in fields {
            let field = self.fields.entry(name);
            self.values.push((field.index() as u32, value as f32));
            let is_ever_other_than_0 = false;
            let field = field.or_insert(MessageField {
                unit,
                is_ever_other_than_0,
            });
            field.is_ever_other_than_0 |= value != 0.0;
        }
        let end = self.values.len();
        self.messages.push(MessageValues { time, number, end });
        Ok(())
    }

    /// Every message, and its values with the positions of their fields.
    pub(super) fn messages(&self) -> impl Iterator<Item = (&MessageValues, &[(u32, f32)])> {
        let mut start = 0;
        self.messages.iter().map(move |message| {
            let values = &self.values[start..message.end];
            start = message.end;
            (message, values)
        })
    }
}

/// What is kept of a topic's messages.
pub(super) enum Content {
    Images(Vec<MessageEntry>),
    Values(ValueStream),
    /// The different descriptions of the camera, of which two are enough.
    Camera(Vec<Projection>),
    Unused,
}

/// A topic, and what was collected of it.
pub(super) struct Topic {
    pub(super) name: String,
    pub(super) type_name: String,
    pub(super) kind: RosType,
    /// How its messages are encoded; only `cdr` can be read.
    pub(super) encoding: String,
    pub(super) messages: u64,
    pub(super) content: Content,
    /// Messages that cannot be read. If damage is not left out, the first one.
    pub(super) faults: SkippedList,
}

impl Topic {
    pub(super) fn is_unused(&self) -> bool {
        matches!(self.content, Content::Unused)
    }

    /// Adds a message, whose time in its header is not known yet. Errors: why it cannot be read.
    fn take(&mut self, mut entry: MessageEntry, message: &[u8]) -> Result<(), String> {
        let header_time = |stamp: i64| Some(stamp).filter(|&stamp| stamp != 0);
        match &mut self.content {
            Content::Unused => {}
            Content::Camera(different) => {
                let projection = messages::camera_info(message)?;
                if different.len() < 2 && !different.contains(&projection) {
                    different.push(projection);
                }
            }
            Content::Images(images) => {
                let stamp = if self.kind == RosType::Image {
                    let (stamp, image) = messages::image(message)?;
                    image.check()?;
                    stamp
                } else {
                    let (stamp, format, _) = messages::compressed_image(message)?;
                    check_format(format)?;
                    stamp
                };
                entry.time.stamp_ns = header_time(stamp);
                images.push(entry);
            }
            Content::Values(stream) => {
                let (stamp, values) = messages::values(self.kind, message)?;
                if let Some(wrong) = values.iter().find(|field| !(field.value as f32).is_finite()) {
                    return Err(format!("{} is {}; it must be a finite number", wrong.name, wrong.value));
                }
                entry.time.stamp_ns = stamp.and_then(header_time);
                stream.push(entry.time, entry.number, values)?;
            }
        }
        Ok(())
    }
}

/// The index of a bag. It receives the messages of the bag's files, one file after the other.
pub(super) struct BagIndex<'a> {
    pub(super) source: &'a Path,
    pub(super) options: &'a ImportOptions,
    cancelled: &'a AtomicBool,
    pub(super) topics: Vec<Topic>,
    by_name: HashMap<(String, String), usize>,
    /// The files; the messages that follow are in the last one.
    pub(super) files: Vec<Arc<dyn MessageFile>>,
    /// Damage that belongs to no topic.
    pub(super) skipped: SkippedList,
}

impl<'a> BagIndex<'a> {
    pub(super) fn new(source: &'a Path, options: &'a ImportOptions, cancelled: &'a AtomicBool) -> Self {
        Self {
            source,
            options,
            cancelled,
            topics: Vec::new(),
            by_name: HashMap::new(),
            files: Vec::new(),
            skipped: SkippedList::default(),
        }
    }

    /// Errors: `Stopped` if the import was cancelled.
    pub(super) fn check_cancelled(&self) -> Result<(), ImportError> {
        if self.cancelled.load(Ordering::Relaxed) {
            return Err(ImportError::Stopped);
        }
        Ok(())
    }

    /// Lists damage, or refuses it. Errors: `Record`.
    pub(super) fn fault(&mut self, place: String, reason: impl Display) -> Result<(), ImportError> {
        ImportError::record(place, reason).leave_out(self.options.skip_bad, &mut self.skipped)
    }

    /// The number of a topic, the same for the same name and type. Errors: why it is refused.
    pub(super) fn topic(&mut self, name: String, type_name: String, encoding: String) -> Result<usize, String> {
        let key = (name, type_name);
        if let Some(&known) = self.by_name.get(&key) {
            return Ok(known);
        }
        let longest = key.0.len().max(key.1.len()).max(encoding.len());
        if longest > MAX_NAME_BYTES {
            return Err(format!(
                "the topic's name, type or encoding has {longest} bytes; at most {MAX_NAME_BYTES} are read"
            ));
        }
        let (name, type_name) = key.clone();
        let kind = RosType::of(&type_name);
        let topic = Topic {
            messages: 0,
            content: self.content(kind, &name, &encoding),
            faults: SkippedList::default(),
            name,
            type_name,
            kind,
            encoding,
        };
        let is_unused = topic.is_unused();
        if self
            .topics
            .iter()
            .filter(|other| other.is_unused() == is_unused)
            .count()
            == MAX_TOPICS
        {
            let which = if is_unused { " that are not imported" } else { "" };
            return Err(format!(
                "the bag has more than {MAX_TOPICS} topics{which}; record fewer"
            ));
        }
        self.by_name.insert(key, self.topics.len());
        self.topics.push(topic);
        Ok(self.topics.len() - 1)
    }

    /// What the options want of a topic.
    fn content(&self, kind: RosType, name: &str, encoding: &str) -> Content {
        let is_wanted = |names: &[String], by_default: bool| match names {
            [] => by_default,
            names => names.iter().any(|given| given.split(':').next() == Some(name)),
        };
        let (is_command, is_measurement) = (kind.is_command(), kind.is_measurement());
        let ImportOptions {
            image, actions, states, ..
        } = self.options;
        if encoding != "cdr" {
            Content::Unused
        } else if kind == RosType::CameraInfo {
            Content::Camera(Vec::new())
        } else if kind.is_image() && image.as_ref().is_none_or(|image| image == name) {
            Content::Images(Vec::new())
        } else if (is_command || is_measurement)
            && (is_wanted(actions, is_command) || is_wanted(states, is_measurement))
        {
            Content::Values(ValueStream::default())
        } else {
            Content::Unused
        }
    }

    /// Where a message is, for people.
    pub(super) fn place(&self, topic: &Topic, entry: &MessageEntry) -> String {
        let place = self.files[entry.file].place(entry.position);
        format!("{place}: message {} of {}", entry.number, topic.name)
    }

    /// Takes a message of the last file.
    pub(super) fn message(&mut self, topic: usize, log_ns: i64, position: Position, message: &[u8]) {
        let file = self.files.len() - 1;
        let of = &mut self.topics[topic];
        let number = of.messages;
        of.messages += 1;
        if of.is_unused() {
            return;
        }
        let stamp_ns = None;
        let time = MessageTime { log_ns, stamp_ns };
        let entry = MessageEntry {
            time,
            number,
            file,
            position,
        };
        let taken = compression::message(message).and_then(|message| of.take(entry, &message));
        if let Err(reason) = taken
            && (self.options.skip_bad || of.faults.is_empty())
        {
            let place = self.place(&self.topics[topic], &entry);
            self.topics[topic].faults.push(SkippedItem::new(&place, &reason));
        }
    }
}

/// Errors: why images of this format cannot be read. Without a format, the image itself says what it is.
fn check_format(format: &str) -> Result<(), String> {
    let lower = format.to_lowercase();
    let is_depth = lower.contains("compresseddepth");
    if !is_depth && (lower.is_empty() || ["jpeg", "jpg", "png"].iter().any(|name| lower.contains(name))) {
        return Ok(());
    }
    let format: String = format.chars().take(40).collect();
    Err(format!("its format is {format:?}; it must be jpeg or png"))
}
