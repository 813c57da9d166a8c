//! How much pixels, or other values, differ.
// Loops with vector instructions include only functions that are inlined into them.
#![allow(clippy::inline_always)]

/// Partial sums. With a single one, each addition would wait for the one before it.
const LANES: usize = 16;

/// The sum of the squared differences of the values that both have.
#[inline(always)]
pub(crate) fn squared_difference(a: &[f32], b: &[f32]) -> f64 {
    let length = a.len().min(b.len());
    let (a, a_rest) = a[..length].as_chunks::<LANES>();
    let (b, b_rest) = b[..length].as_chunks::<LANES>();
    let mut sums = [0.0f32; LANES];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            sums[lane] += (a[lane] - b[lane]) * (a[lane] - b[lane]);
        }
    }
    for ((sum, a), b) in sums.iter_mut().zip(a_rest).zip(b_rest) {
        *sum += (a - b) * (a - b);
    }
    sums.into_iter().map(f64::from).sum()
}

/// The sum of the squared differences of the bytes that both have.
#[inline(always)]
pub(crate) fn squared_difference_of_bytes(a: &[u8], b: &[u8]) -> u64 {
    // The sum of so many squares fits 32 bits.
    const CHUNK_BYTES: usize = 1 << 16;
    let mut total = 0;
    for (a, b) in a.chunks(CHUNK_BYTES).zip(b.chunks(CHUNK_BYTES)) {
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
