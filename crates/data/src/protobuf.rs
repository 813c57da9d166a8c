//! Reads messages of Protocol Buffers field by field, without their descriptions. No bytes make it panic.

// How a field is written.
const VARINT: u64 = 0;
const FIXED_64: u64 = 1;
const BYTES: u64 = 2;
const FIXED_32: u64 = 5;

/// The value of a field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WireValue<'a> {
    /// A number of variable length, or of 32 bits.
    Number(u64),
    /// A text, a message inside, or a number of 64 bits.
    Bytes(&'a [u8]),
}

/// The bytes of a field of a message; `None` if it is absent or a number.
#[must_use]
pub fn bytes_of(message: &[u8], wanted: u32) -> Option<&[u8]> {
    match field(message, wanted)? {
        WireValue::Bytes(bytes) => Some(bytes),
        WireValue::Number(_) => None,
    }
}

/// The number of a field of a message; `None` if it is absent or no number.
#[must_use]
pub fn number_of(message: &[u8], wanted: u32) -> Option<u64> {
    match field(message, wanted)? {
        WireValue::Number(number) => Some(number),
        WireValue::Bytes(_) => None,
    }
}

/// The first field of that number; `None` if there is none before the end or before what cannot be read.
#[must_use]
pub fn field(mut message: &[u8], wanted: u32) -> Option<WireValue<'_>> {
    loop {
        let key = take_varint(&mut message)?;
        let value = match key & 7 {
            VARINT => WireValue::Number(take_varint(&mut message)?),
            BYTES => {
                let length = usize::try_from(take_varint(&mut message)?).ok()?;
                WireValue::Bytes(message.split_off(..length)?)
            }
            FIXED_64 => WireValue::Bytes(message.split_off(..8)?),
            FIXED_32 => {
                let (number, rest) = message.split_first_chunk::<4>()?;
                message = rest;
                WireValue::Number(u32::from_le_bytes(*number).into())
            }
            _ => return None,
        };
        if key >> 3 == u64::from(wanted) {
            return Some(value);
        }
    }
}

/// Seven bits a byte, the lowest first; the eighth bit says that more follow.
fn take_varint(message: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for place in 0..10 {
        let byte = *message.split_off_first()?;
        value |= u64::from(byte & 0x7f) << (7 * place);
        if byte < 0x80 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn fields_of_each_kind_are_read() {
        let message = b"\x08\xac\x02\x15\x03\0\0\0\x1a\x03abc\x21\x01\0\0\0\0\0\0\0";
        assert_eq!(number_of(message, 1), Some(300));
        assert_eq!(number_of(message, 2), Some(3));
        assert_eq!(bytes_of(message, 3), Some(&b"abc"[..]));
        assert_eq!(bytes_of(message, 4), Some(&[1, 0, 0, 0, 0, 0, 0, 0][..]));
        assert_eq!(
            (field(message, 5), bytes_of(message, 1), number_of(message, 3)),
            (None, None, None)
        );
    }

    proptest! {
        #[test]
        fn no_bytes_make_the_reader_panic(message in proptest::collection::vec(any::<u8>(), 0..64), wanted in 0u32..8) {
            let _ = field(&message, wanted);
        }
    }
}
