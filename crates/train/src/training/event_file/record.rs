//! The frame around each event (`TFRecord`): its length, a checksum of the length, the event, and its checksum.

const LENGTH: usize = 8;
const CHECKSUM: usize = 4;
/// CRC-32C (Castagnoli), with its bits reversed.
const POLYNOMIAL: u32 = 0x82f6_3b78;

const TABLE: [u32; 256] = {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let (mut value, mut bit) = (byte as u32, 0);
        while bit < 8 {
            value = if value & 1 == 1 {
                (value >> 1) ^ POLYNOMIAL
            } else {
                value >> 1
            };
            bit += 1;
        }
        table[byte] = value;
        byte += 1;
    }
    table
};

fn crc32c(bytes: &[u8]) -> u32 {
    let step = |sum: u32, byte: &u8| TABLE[usize::from(sum as u8 ^ byte)] ^ (sum >> 8);
    !bytes.iter().fold(!0, step)
}

/// The checksum as `TFRecord` has it. It is changed, because a checksum over data that holds its own checksum is weak.
fn masked(bytes: &[u8]) -> [u8; CHECKSUM] {
    let sum = crc32c(bytes);
    sum.rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

/// The record of an event.
pub(super) fn framed(event: &[u8]) -> Vec<u8> {
    let length = (event.len() as u64).to_le_bytes();
    [&length[..], &masked(&length), event, &masked(event)].concat()
}

/// The events of a file, until its end or to the first record that is damaged.
pub(super) fn contents(mut file: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let (event, rest) = split(file)?;
        file = rest;
        Some(event)
    })
}

fn split(file: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = file.split_first_chunk::<LENGTH>()?;
    let (sum, rest) = rest.split_first_chunk::<CHECKSUM>()?;
    let (event, rest) = rest.split_at_checked(usize::try_from(u64::from_le_bytes(*length)).ok()?)?;
    let (event_sum, rest) = rest.split_first_chunk::<CHECKSUM>()?;
    (*sum == masked(length) && *event_sum == masked(event)).then_some((event, rest))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_that_of_the_standard() {
        // The check value of CRC-32C, and those of RFC 3720, appendix B.4.
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(&[0xff; 32]), 0x62a8_ab43);
    }

    #[test]
    fn events_are_read_up_to_a_damaged_record() {
        let mut file = [framed(b"one"), framed(b""), framed(b"three")].concat();
        assert_eq!(contents(&file).collect::<Vec<_>>(), [&b"one"[..], b"", b"three"]);
        let whole = file.clone();
        file.pop();
        assert_eq!(contents(&file).count(), 2);
        for index in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[index] ^= 1;
            assert!(contents(&damaged).count() < 3, "byte {index}");
        }
    }
}
