//! How much the pixels of frames differ.
// Loops with vector instructions include only functions that are inlined into them.
#![allow(clippy::inline_always)]

/// The sum of the squared differences of the bytes that both have.
#[inline(always)]
pub(crate) fn squared_difference_of_bytes(a: &[u8], b: &[u8]) -> u64 {
    // The sum of so many squares fits 32 bits.
    const MOST: usize = 1 << 16;
    let mut total = 0;
    for (a, b) in a.chunks(MOST).zip(b.chunks(MOST)) {
        let mut sum = 0;
        for (a, b) in a.iter().zip(b) {
            let difference = u32::from(a.abs_diff(*b));
            sum += difference * difference;
        }
        total += u64::from(sum);
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_of_many_bytes_do_not_overflow() {
        let (black, white) = (vec![0; 150_000], vec![255; 200_000]);
        assert_eq!(squared_difference_of_bytes(&black, &white), 150_000 * 255 * 255);
        assert_eq!(squared_difference_of_bytes(&[1, 9], &[4, 7]), 13);
        assert_eq!(squared_difference_of_bytes(&[], &white), 0);
    }
}
