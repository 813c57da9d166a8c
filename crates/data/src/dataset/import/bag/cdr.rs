//! Reads CDR (OMG's Common Data Representation, version 1), the encoding of ROS 2 messages, in both byte orders. No input
//! makes it panic or allocate more than the message's own size.

/// Two bytes for the encoding, two for options.
const HEADER_BYTES: usize = 4;

/// Why a message cannot be read.
#[derive(Debug, thiserror::Error, PartialEq)]
pub(super) enum CdrError {
    #[error("its encoding is {0:?}; it must be CDR, [0, 0] (big endian) or [0, 1] (little endian)")]
    Encoding(Vec<u8>),
    #[error("its field {field} needs {needed} bytes at byte {offset}; the message has {length} bytes")]
    Ends {
        field: &'static str,
        offset: usize,
        needed: u64,
        length: usize,
    },
    #[error("its field {field} is no UTF-8 text")]
    Text { field: &'static str },
}

/// A position in a message. Fields are read one after the other; each starts at a multiple of its size.
pub(super) struct CdrReader<'a> {
    message: &'a [u8],
    offset: usize,
    big_endian: bool,
}

macro_rules! number {
    ($name:ident, $type:ty) => {
        /// The next number. Errors: `Ends`.
        pub(super) fn $name(&mut self, field: &'static str) -> Result<$type, CdrError> {
            const BYTES: usize = size_of::<$type>();
            let bytes = self.take(BYTES as u64, BYTES, field)?;
            let bytes = *bytes
                .first_chunk::<BYTES>()
                .expect("a number of other size is a bug");
            Ok(if self.big_endian {
                <$type>::from_be_bytes(bytes)
            } else {
                <$type>::from_le_bytes(bytes)
            })
        }
    };
}

impl<'a> CdrReader<'a> {
    /// Reads the message's header. Errors: `Encoding`, `Ends`.
    pub(super) fn new(message: &'a [u8]) -> Result<Self, CdrError> {
        let Some(header) = message.get(..HEADER_BYTES) else {
            return Err(CdrError::Ends {
                field: "header of the encoding",
                offset: 0,
                needed: HEADER_BYTES as u64,
                length: message.len(),
            });
        };
        let big_endian = match header {
            [0, 0, ..] => true,
            [0, 1, ..] => false,
            _ => return Err(CdrError::Encoding(header[..2].to_vec())),
        };
        Ok(Self {
            message,
            offset: HEADER_BYTES,
            big_endian,
        })
    }

    number!(u8, u8);
    number!(u32, u32);
    number!(i32, i32);
    number!(f64, f64);

    /// `count` bytes that start at a multiple of `align`, which is counted from the end of the header.
    fn take(&mut self, count: u64, align: usize, field: &'static str) -> Result<&'a [u8], CdrError> {
        let offset = HEADER_BYTES + (self.offset - HEADER_BYTES).next_multiple_of(align);
        let end = usize::try_from(count).ok().and_then(|count| offset.checked_add(count));
        let found = end.and_then(|end| self.message.get(offset..end));
        let bytes = found.ok_or(CdrError::Ends {
            field,
            offset,
            needed: count,
            length: self.message.len(),
        })?;
        self.offset = offset + bytes.len();
        Ok(bytes)
    }

    /// A text; its length counts a closing NUL. Errors: `Ends`, `Text`.
    pub(super) fn text(&mut self, field: &'static str) -> Result<&'a str, CdrError> {
        let length = self.u32(field)?;
        let bytes = self.take(length.into(), 1, field)?;
        let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        std::str::from_utf8(bytes).map_err(|_| CdrError::Text { field })
    }

    /// A sequence of bytes. Errors: `Ends`.
    pub(super) fn bytes(&mut self, field: &'static str) -> Result<&'a [u8], CdrError> {
        let length = self.u32(field)?;
        self.take(length.into(), 1, field)
    }

    /// A sequence of texts. Errors: `Ends`, `Text`.
    pub(super) fn texts(&mut self, field: &'static str) -> Result<Vec<&'a str>, CdrError> {
        let count = self.u32(field)?;
        // Each has a length of 4 bytes, so a false count ends with the message.
        (0..count).map(|_| self.text(field)).collect()
    }

    /// `count` numbers. Errors: `Ends`.
    pub(super) fn f64_array(&mut self, count: u32, field: &'static str) -> Result<Vec<f64>, CdrError> {
        (0..count).map(|_| self.f64(field)).collect()
    }

    /// A sequence of numbers. Errors: `Ends`.
    pub(super) fn f64_sequence(&mut self, field: &'static str) -> Result<Vec<f64>, CdrError> {
        let count = self.u32(field)?;
        self.f64_array(count, field)
    }
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
        assert_eq!(
            ended,
            Err(CdrError::Ends {
                field: "value",
                offset: 20,
                needed: 8,
                length: 24
            })
        );
    }

    #[test]
    fn another_encoding_is_named() {
        let error = CdrReader::new(&[0, 3, 0, 0]).err().unwrap().to_string();
        assert!(error.starts_with("its encoding is [0, 3]; it must be CDR"), "{error}");
    }

    proptest! {
        #[test]
        fn no_bytes_make_the_reader_panic(message in proptest::collection::vec(any::<u8>(), 0..64), order in 0u8..2) {
            let message = [&[0, order, 0, 0][..], &message].concat();
            for read in [
                (|reader| reader.text("a").map(drop)) as fn(&mut CdrReader<'_>) -> Result<(), CdrError>,
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
