//! Writes ROS 2 messages in CDR, little endian.

/// A message that is being written. Numbers start at multiples of their size, counted from the end of the 4-byte header.
pub(super) struct CdrWriter(Vec<u8>);

impl CdrWriter {
    pub(super) fn new() -> Self {
        Self(vec![0, 1, 0, 0])
    }

    fn number(mut self, little: &[u8]) -> Self {
        let length = (self.0.len() - 4).next_multiple_of(little.len()) + 4;
        self.0.resize(length, 0);
        self.0.extend_from_slice(little);
        self
    }

    pub(super) fn u8(self, value: u8) -> Self {
        self.number(&[value])
    }

    pub(super) fn u32(self, value: u32) -> Self {
        self.number(&value.to_le_bytes())
    }

    pub(super) fn u32s(self, values: &[u32]) -> Self {
        values.iter().fold(self, |cdr, &value| cdr.u32(value))
    }

    pub(super) fn f64s(self, values: &[f64]) -> Self {
        values.iter().fold(self, |cdr, value| cdr.number(&value.to_le_bytes()))
    }

    /// A sequence of numbers.
    pub(super) fn f64_sequence(self, values: &[f64]) -> Self {
        self.u32(values.len() as u32).f64s(values)
    }

    /// A text; its length counts a closing NUL.
    pub(super) fn text(self, text: &str) -> Self {
        let mut cdr = self.u32(text.len() as u32 + 1);
        cdr.0.extend_from_slice(text.as_bytes());
        cdr.0.push(0);
        cdr
    }

    /// A sequence of bytes.
    pub(super) fn bytes(self, bytes: &[u8]) -> Self {
        let mut cdr = self.u32(bytes.len() as u32);
        cdr.0.extend_from_slice(bytes);
        cdr
    }

    /// A `std_msgs/Header` of the camera.
    pub(super) fn header(self, time_ns: u64) -> Self {
        let (seconds, rest) = (time_ns / 1_000_000_000, time_ns % 1_000_000_000);
        self.u32s(&[seconds as u32, rest as u32]).text("camera")
    }

    pub(super) fn end(self) -> Vec<u8> {
        self.0
    }
}
