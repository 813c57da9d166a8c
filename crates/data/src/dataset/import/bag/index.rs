//! The index of a bag, made by one pass over its files: where the images are, and the values and times of everything else that may be used.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

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

/// Where a message lies in its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Position {
    /// In the file itself.
    File { offset: u64, bytes: usize },
    /// In a compressed chunk, whose record starts at `chunk`.
    Chunk { chunk: u64, start: usize, bytes: usize },
    /// In a database's row of this number.
    #[cfg(feature = "databases")]
    Row(i64),
}

/// When a message was recorded and, by its header, when it was made; in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct MessageTime {
    pub(super) log_ns: i64,
    /// `None` without a header, or with one that nobody set.
    pub(super) stamp_ns: Option<i64>,
}

/// A message with an image.
pub(super) struct ImageEntry {
    pub(super) time: MessageTime,
    /// Its number in its topic, from 0.
    pub(super) number: u64,
    /// Position of its file in [`BagIndex::files`].
    pub(super) file: usize,
    pub(super) position: Position,
}

/// The values of a topic. A message need not have all fields (a `JointState` may have some joints only).
#[derive(Default)]
pub(super) struct ValueStream {
    /// Names and units of all fields, in the order in which they appeared.
    pub(super) fields: Vec<(String, &'static str)>,
    positions: HashMap<String, u32>,
    /// Which fields were ever other than 0.
    pub(super) is_ever_other_than_0: Vec<bool>,
    pub(super) times: Vec<MessageTime>,
    pub(super) numbers: Vec<u64>,
    /// For each message, where its values end.
    ends: Vec<usize>,
    values: Vec<(u32, f32)>,
}

impl ValueStream {
    /// Errors: why the message is refused.
    fn push(&mut self, time: MessageTime, number: u64, fields: Vec<FieldValue>) -> Result<(), String> {
        let is_new = |field: &&FieldValue| !self.positions.contains_key(&*field.name);
        let (mut count, mut longest) = (self.fields.len(), 0);
        for field in fields.iter().filter(is_new) {
            (count, longest) = (count + 1, longest.max(field.name.len()));
        }
        if count > MAX_FIELDS || longest > MAX_NAME_BYTES {
            return Err(format!(
                "its topic would have {count} fields, the longest new name with {longest} bytes; at most {MAX_FIELDS} fields \
                 and {MAX_NAME_BYTES} bytes per name are read"
            ));
        }
        for FieldValue { name, unit, value } in fields {
            let field = self.field(&name, unit);
            self.is_ever_other_than_0[field as usize] |= value != 0.0;
            self.values.push((field, value as f32));
        }
        self.times.push(time);
        self.numbers.push(number);
        self.ends.push(self.values.len());
        Ok(())
    }

    /// The position of a field, which is new or known.
    fn field(&mut self, name: &str, unit: &'static str) -> u32 {
        if let Some(&known) = self.positions.get(name) {
            return known;
        }
        let field = self.fields.len() as u32;
        self.positions.insert(name.to_owned(), field);
        self.fields.push((name.to_owned(), unit));
        self.is_ever_other_than_0.push(false);
        field
    }

    /// Fields and values of a message.
    pub(super) fn values(&self, message: usize) -> &[(u32, f32)] {
        let start = message.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.values[start..self.ends[message]]
    }
}

/// What is kept of a topic's messages.
pub(super) enum Content {
    Images(Vec<ImageEntry>),
    Values(ValueStream),
    Camera(Option<Projection>),
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

/// The index of a bag. It receives the messages of the bag's files, one file after the other.
pub(super) struct BagIndex<'a> {
    pub(super) source: &'a Path,
    pub(super) options: &'a ImportOptions,
    cancelled: &'a AtomicBool,
    pub(super) topics: Vec<Topic>,
    by_name: HashMap<(String, String), usize>,
    used_topics: usize,
    unused_topics: usize,
    pub(super) files: Vec<PathBuf>,
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
            used_topics: 0,
            unused_topics: 0,
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

    /// The messages that follow are in this file.
    pub(super) fn file(&mut self, path: PathBuf) {
        self.files.push(path);
    }

    /// Lists damage, or refuses it. Errors: `Record`.
    pub(super) fn fault(&mut self, place: String, reason: String) -> Result<(), ImportError> {
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
        let is_wanted = |names: &[String], by_default: bool| match names {
            [] => by_default,
            names => names.iter().any(|given| given.split(':').next() == Some(&name)),
        };
        let options = self.options;
        let is_value =
            is_wanted(&options.actions, kind.is_command()) || is_wanted(&options.states, kind.is_measurement());
        let content = match kind {
            _ if encoding != "cdr" => Content::Unused,
            RosType::CameraInfo => Content::Camera(None),
            _ if kind.is_image() && options.image.as_ref().is_none_or(|image| *image == name) => {
                Content::Images(Vec::new())
            }
            _ if is_value && (kind.is_command() || kind.is_measurement()) => Content::Values(ValueStream::default()),
            _ => Content::Unused,
        };
        let is_unused = matches!(content, Content::Unused);
        let count = if is_unused {
            &mut self.unused_topics
        } else {
            &mut self.used_topics
        };
        if *count == MAX_TOPICS {
            let what = if is_unused {
                "topics that are not imported"
            } else {
                "topics"
            };
            return Err(format!("the bag has more than {MAX_TOPICS} {what}; record fewer"));
        }
        *count += 1;
        self.by_name.insert(key, self.topics.len());
        self.topics.push(Topic {
            name,
            type_name,
            kind,
            encoding,
            messages: 0,
            content,
            faults: SkippedList::default(),
        });
        Ok(self.topics.len() - 1)
    }

    /// Where a message is, for people.
    pub(super) fn place(&self, file: usize, topic: &Topic, number: u64, position: Position) -> String {
        let path = self.files[file].display();
        let at = match position {
            Position::File { offset, .. } => format!("byte {offset}"),
            Position::Chunk { chunk, start, .. } => format!("byte {start} of the chunk at byte {chunk}"),
            #[cfg(feature = "databases")]
            Position::Row(row) => format!("row {row} of the messages"),
        };
        format!("{path} {at}: message {number} of {}", topic.name)
    }

    /// Takes a message of the latest file.
    pub(super) fn message(&mut self, topic: usize, log_ns: i64, position: Position, message: &[u8]) {
        let file = self.files.len() - 1;
        let of = &mut self.topics[topic];
        let number = of.messages;
        of.messages += 1;
        let entry = |time| ImageEntry {
            time,
            number,
            file,
            position,
        };
        let read = match of.content {
            Content::Unused => Ok(()),
            _ => compression::message(message).and_then(|message| take(of, number, log_ns, &message, entry)),
        };
        if let Err(reason) = read {
            let of = &self.topics[topic];
            if self.options.skip_bad || of.faults.is_empty() {
                let place = self.place(file, of, number, position);
                self.topics[topic].faults.push(SkippedItem::new(&place, &reason));
            }
        }
    }
}

/// Adds a message to its topic. Errors: why it cannot be read.
fn take(
    topic: &mut Topic,
    number: u64,
    log_ns: i64,
    message: &[u8],
    entry: impl FnOnce(MessageTime) -> ImageEntry,
) -> Result<(), String> {
    let at = |stamp_ns: Option<i64>| MessageTime {
        log_ns,
        stamp_ns: stamp_ns.filter(|&stamp| stamp != 0),
    };
    match &mut topic.content {
        Content::Unused => {}
        Content::Camera(found) => {
            // Cameras seldom change; the first description counts.
            if found.is_none() {
                *found = Some(messages::camera_info(message).map_err(|error| error.to_string())?);
            }
        }
        Content::Images(images) => {
            let stamp = if topic.kind == RosType::Image {
                let (stamp, image) = messages::image(message).map_err(|error| error.to_string())?;
                image.check().map_err(|error| error.to_string())?;
                stamp
            } else {
                let (stamp, format, _) = messages::compressed_image(message).map_err(|error| error.to_string())?;
                check_format(format)?;
                stamp
            };
            images.push(entry(at(Some(stamp))));
        }
        Content::Values(stream) => {
            let (stamp, values) = messages::values(topic.kind, message).map_err(|error| error.to_string())?;
            if let Some(wrong) = values.iter().find(|field| !(field.value as f32).is_finite()) {
                return Err(format!("{} is {}; it must be a finite number", wrong.name, wrong.value));
            }
            stream.push(at(stamp), number, values)?;
        }
    }
    Ok(())
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
