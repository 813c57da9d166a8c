//! Reads CDR (OMG's Common Data Representation, version 1), the encoding of ROS 2 messages, in both byte orders. No input
//! makes it panic or allocate more than the message's own size. Errors: why the message cannot be read.

/// Two bytes for the encoding, two for options.
const HEADER_BYTES: usize = 4;

/// A position in a message. Fields are read one after the other; each starts at a multiple of its size.
pub(super) struct CdrReader<'a> {
    message: &'a [u8],
    offset: usize,
    big_endian: bool,
}

impl<'a> CdrReader<'a> {
    /// Reads the message's header.
    pub(super) fn new(message: &'a [u8]) -> Result<Self, String> {
        let big_endian = match message.first_chunk::<HEADER_BYTES>() {
            Some([0, 0, ..]) => true,
            Some([0, 1, ..]) => false,
            Some([first, second, ..]) => {
                return Err(format!(
                    "its encoding is [{first}, {second}]; it must be CDR, [0, 0] (big endian) or [0, 1] (little endian)"
                ));
            }
            None => return Err(ends("header of the encoding", 0, HEADER_BYTES, message)),
        };
        Ok(Self {
            message,
            offset: HEADER_BYTES,
            big_endian,
        })
    }

    /// `count` bytes that start at a multiple of `align`, which is counted from the end of the header.
    fn take(&mut self, count: usize, align: usize, field: &'static str) -> Result<&'a [u8], String> {
        let offset = HEADER_BYTES + (self.offset - HEADER_BYTES).next_multiple_of(align);
        let end = offset.checked_add(count);
        let bytes = end.and_then(|end| self.message.get(offset..end));
        let bytes = bytes.ok_or_else(|| ends(field, offset, count, self.message))?;
        self.offset = offset + bytes.len();
        Ok(bytes)
    }

    /// The bytes of the next number, little endian.
    fn number<const BYTES: usize>(&mut self, field: &'static str) -> Result<[u8; BYTES], String> {
        let mut bytes = [0; BYTES];
        bytes.copy_from_slice(self.take(BYTES, BYTES, field)?);
        if self.big_endian {
            bytes.reverse();
        }
        Ok(bytes)
    }

    pub(super) fn u8(&mut self, field: &'static str) -> Result<u8, String> {
        self.number(field).map(u8::from_le_bytes)
    }

    pub(super) fn u32(&mut self, field: &'static str) -> Result<u32, String> {
        self.number(field).map(u32::from_le_bytes)
    }

    pub(super) fn i32(&mut self, field: &'static str) -> Result<i32, String> {
        self.number(field).map(i32::from_le_bytes)
    }

    pub(super) fn f64(&mut self, field: &'static str) -> Result<f64, String> {
        self.number(field).map(f64::from_le_bytes)
    }

    /// A sequence of bytes.
    pub(super) fn bytes(&mut self, field: &'static str) -> Result<&'a [u8], String> {
        let length = self.u32(field)?;
        self.take(length as usize, 1, field)
    }

    /// A text; its length counts a closing NUL.
    pub(super) fn text(&mut self, field: &'static str) -> Result<&'a str, String> {
        let bytes = self.bytes(field)?;
        let text = std::str::from_utf8(bytes.strip_suffix(&[0]).unwrap_or(bytes));
        text.map_err(|_| format!("its field {field} is no UTF-8 text"))
    }

    /// A sequence of texts.
    pub(super) fn texts(&mut self, field: &'static str) -> Result<Vec<&'a str>, String> {
        let count = self.u32(field)?;
        // Each has a length of 4 bytes, so a false count ends with the message.
        (0..count).map(|_| self.text(field)).collect()
    }

    /// `count` numbers.
    pub(super) fn f64_array(&mut self, count: u32, field: &'static str) -> Result<Vec<f64>, String> {
        (0..count).map(|_| self.f64(field)).collect()
    }

    /// A sequence of numbers.
    pub(super) fn f64_sequence(&mut self, field: &'static str) -> Result<Vec<f64>, String> {
        let count = self.u32(field)?;
        self.f64_array(count, field)
    }
}

fn ends(field: &str, offset: usize, needed: usize, message: &[u8]) -> String {
    let length = message.len();
    format!("its field {field} needs {needed} bytes at byte {offset}; the message has {length} bytes")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn both_byte_orders_give_the_same_values() {
        let little = [
            0, 1, 0, 0, 7, 0, 0, 0, 3, 0, 0, 0, b'a', b'b', 0, 0, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f,
        ];
        let big = [
            0, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 3, b'a', b'b', 0, 0, 0, 0, 0, 0, 0x3f, 0xf0, 0, 0, 0, 0, 0, 0,
        ];
        let read = |message: &[u8]| {
            let mut reader = CdrReader::new(message).unwrap();
            let (flag, text) = (reader.u8("flag").unwrap(), reader.text("text").unwrap().to_owned());
            (flag, text, reader.f64("value"))
        };
        assert_eq!(read(&big), (7, "ab".to_owned(), Ok(1.0)));
        // The number starts at a multiple of 8 after the header, which this message does not reach.
        let (_, _, ended) = read(&little);
        let reason = "its field value needs 8 bytes at byte 20; the message has 24 bytes";
        assert_eq!(ended, Err(reason.to_owned()));
    }

    #[test]
    fn another_encoding_is_named() {
        let error = CdrReader::new(&[0, 3, 0, 0]).err().unwrap();
        assert!(error.starts_with("its encoding is [0, 3]; it must be CDR"), "{error}");
    }

    proptest! {
        #[test]
        fn no_bytes_make_the_reader_panic(message in proptest::collection::vec(any::<u8>(), 0..64), order in 0u8..2) {
            let message = [&[0, order, 0, 0][..], &message].concat();
            for read in [
                (|reader| reader.text("a").map(drop)) as fn(&mut CdrReader<'_>) -> Result<(), String>,
                |reader| reader.bytes("a").map(drop),
                |reader| reader.texts("a").map(drop),
                |reader| reader.f64_sequence("a").map(drop),
            ] {
                let mut reader = CdrReader::new(&message).unwrap();
                while read(&mut reader).is_ok() && reader.offset < message.len() {}
            }
        }
    }
}
