//! The messages `Event` and `Summary` of `TensorBoard` in the wire format of Protocol Buffers, as far as scalars and pictures need
//! them.

use foreframe_data::protobuf::{bytes_of, number_of};

/// What every file begins with.
const FILE_VERSION: &str = "brain.Event:2";

// Numbers of fields.
const EVENT_TIME: u32 = 1;
const EVENT_STEP: u32 = 2;
const EVENT_VERSION: u32 = 3;
const EVENT_SUMMARY: u32 = 5;
const SUMMARY_VALUE: u32 = 1;
const VALUE_TAG: u32 = 1;
const VALUE_SCALAR: u32 = 2;
const VALUE_IMAGE: u32 = 4;
const IMAGE_HEIGHT: u32 = 1;
const IMAGE_WIDTH: u32 = 2;
const IMAGE_COLORS: u32 = 3;
const IMAGE_FILE: u32 = 4;

/// How many numbers a pixel has.
const GRAY: u64 = 1;

// How a field is written.
const VARINT: u64 = 0;
const FIXED_64: u64 = 1;
const BYTES: u64 = 2;
const FIXED_32: u64 = 5;

/// A message that is being written.
#[derive(Default)]
struct MessageWriter(Vec<u8>);

impl MessageWriter {
    fn key(&mut self, field: u32, kind: u64) {
        self.varint(u64::from(field) << 3 | kind);
    }

    /// Seven bits a byte, the lowest first; the eighth bit says that more follow.
    fn varint(&mut self, mut value: u64) {
        while value > 0x7f {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn with_number(mut self, field: u32, value: u64) -> Self {
        self.key(field, VARINT);
        self.varint(value);
        self
    }

    fn with_f64(mut self, field: u32, value: f64) -> Self {
        self.key(field, FIXED_64);
        self.0.extend(value.to_le_bytes());
        self
    }

    fn with_f32(mut self, field: u32, value: f32) -> Self {
        self.key(field, FIXED_32);
        self.0.extend(value.to_le_bytes());
        self
    }

    fn with_bytes(mut self, field: u32, value: &[u8]) -> Self {
        self.key(field, BYTES);
        self.varint(value.len() as u64);
        self.0.extend(value);
        self
    }
}

/// A named value of a summary.
pub(super) struct SummaryValue(Vec<u8>);

impl SummaryValue {
    pub(super) fn scalar(tag: &str, value: f64) -> Self {
        let tagged = MessageWriter::default().with_bytes(VALUE_TAG, tag.as_bytes());
        Self(tagged.with_f32(VALUE_SCALAR, value as f32).0)
    }

    pub(super) fn png(tag: &str, width_px: u32, height_px: u32, png: &[u8]) -> Self {
        let image = MessageWriter::default()
            .with_number(IMAGE_HEIGHT, height_px.into())
            .with_number(IMAGE_WIDTH, width_px.into())
            .with_number(IMAGE_COLORS, GRAY)
            .with_bytes(IMAGE_FILE, png);
        let tagged = MessageWriter::default().with_bytes(VALUE_TAG, tag.as_bytes());
        Self(tagged.with_bytes(VALUE_IMAGE, &image.0).0)
    }
}

/// An event as bytes.
pub(super) struct EventMessage(Vec<u8>);

impl EventMessage {
    /// The first event of a file.
    pub(super) fn version(unix_s: f64) -> Self {
        let event = MessageWriter::default().with_f64(EVENT_TIME, unix_s);
        Self(event.with_bytes(EVENT_VERSION, FILE_VERSION.as_bytes()).0)
    }

    pub(super) fn summary(unix_s: f64, step: usize, values: impl IntoIterator<Item = SummaryValue>) -> Self {
        let values = values.into_iter();
        let summary = values.fold(MessageWriter::default(), |all, value| {
            all.with_bytes(SUMMARY_VALUE, &value.0)
        });
        let event = MessageWriter::default()
            .with_f64(EVENT_TIME, unix_s)
            .with_number(EVENT_STEP, step as u64);
        Self(event.with_bytes(EVENT_SUMMARY, &summary.0).0)
    }

    pub(super) fn of_bytes(bytes: &[u8]) -> Self {
        Self(bytes.to_vec())
    }

    pub(super) fn bytes(&self) -> &[u8] {
        &self.0
    }

    /// Its step.
    pub(super) fn step(&self) -> Option<usize> {
        usize::try_from(number_of(&self.0, EVENT_STEP)?).ok()
    }

    /// The tag of its first value.
    pub(super) fn tag(&self) -> Option<&str> {
        let value = bytes_of(bytes_of(&self.0, EVENT_SUMMARY)?, SUMMARY_VALUE)?;
        std::str::from_utf8(bytes_of(value, VALUE_TAG)?).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_has_the_bytes_of_protocol_buffers() {
        let value = SummaryValue::scalar("a/b", 0.5);
        let event = EventMessage::summary(1.0, 300, [value]);
        let expected = b"\x09\0\0\0\0\0\0\xf0\x3f\x10\xac\x02\x2a\x0c\x0a\x0a\x0a\x03a/b\x15\0\0\0\x3f";
        assert_eq!(event.bytes(), expected);
        assert_eq!((event.step(), event.tag()), (Some(300), Some("a/b")));
        let version = EventMessage::version(1.0);
        assert!(version.bytes().ends_with(b"\x1a\x0dbrain.Event:2"));
        assert_eq!((version.step(), version.tag()), (None, None));
    }

    #[test]
    fn damaged_messages_have_no_tag() {
        for message in [
            &b"\x2a\x7f"[..],
            b"\x2a",
            b"\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff",
            b"\x2b\x01",
            b"",
        ] {
            assert_eq!(EventMessage::of_bytes(message).tag(), None);
        }
    }
}
