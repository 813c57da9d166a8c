//! Small images of frames, whose distances are never greater than those of the frames.

use std::ops::Range;

/// Blocks a side at most; a frame has one block a pixel on a side that is shorter.
const SIDE: usize = 8;

/// How a frame is divided into blocks.
pub(super) struct SmallImages {
    width: usize,
    columns: Vec<Range<usize>>,
    rows: Vec<Range<usize>>,
}

impl SmallImages {
    /// For frames of this size.
    pub(super) fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            columns: blocks(width),
            rows: blocks(height),
        }
    }

    /// Values of a small image.
    pub(super) fn values(&self) -> usize {
        self.rows.len() * self.columns.len()
    }

    /// The mean of each block, times the root of its pixel count. Then the distance of two small images is never more than that
    /// of their frames; it is equal if every block has one value.
    pub(super) fn shrink(&self, frame: &[u8], small: &mut [f32]) {
        let blocks = self
            .rows
            .iter()
            .flat_map(|rows| self.columns.iter().map(move |columns| (rows, columns)));
        for ((rows, columns), value) in blocks.zip(small) {
            let lines = rows.clone().map(|y| &frame[y * self.width..][columns.clone()]);
            let sum: u32 = lines.flatten().map(|&pixel| u32::from(pixel)).sum();
            *value = (f64::from(sum) / ((rows.len() * columns.len()) as f64).sqrt()) as f32;
        }
    }
}

/// The ranges of pixels of a side's blocks.
fn blocks(side: usize) -> Vec<Range<usize>> {
    let count = side.min(SIDE);
    (0..count).map(|i| i * side / count..(i + 1) * side / count).collect()
}

/// Summed in lanes, so that it can be done in vectors.
pub(super) fn squared_distance(one: &[f32], other: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    for (one, other) in one.chunks(16).zip(other.chunks(16)) {
        for ((lane, a), b) in lanes.iter_mut().zip(one).zip(other) {
            *lane += (a - b) * (a - b);
        }
    }
    lanes.iter().sum()
}

/// The squared distance of two frames.
pub(super) fn squared_byte_distance(one: &[u8], other: &[u8]) -> u64 {
    // As many squares as a u32 certainly holds.
    let parts = one.chunks(1 << 16).zip(other.chunks(1 << 16));
    let sums = parts.map(|(one, other)| {
        let squares = one.iter().zip(other).map(|(a, b)| {
            let difference = i32::from(i16::from(*a) - i16::from(*b));
            (difference * difference) as u32
        });
        u64::from(squares.sum::<u32>())
    });
    sums.sum()
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use foreframe_core::types::Seed;

    fn small(images: &SmallImages, frame: &[u8]) -> Vec<f32> {
        let mut small = vec![0.0; images.values()];
        images.shrink(frame, &mut small);
        small
    }

    #[test]
    fn a_block_is_the_mean_of_its_pixels_times_the_root_of_their_number() {
        let frame: Vec<u8> = (0..16 * 16).map(|i| (i % 16 / 2) as u8).collect();
        let images = SmallImages::new(16, 16);
        assert_eq!(small(&images, &frame)[..8], [0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0]);
        assert_eq!(small(&SmallImages::new(1, 1), &[3]), [3.0]);
    }

    #[test]
    fn small_images_are_never_farther_apart_than_their_frames() {
        let mut rng = Seed(4).rng();
        for (width, height) in [(16, 16), (13, 21), (3, 5), (8, 40)] {
            let images = SmallImages::new(width, height);
            let [one, other]: [Vec<u8>; 2] = [0, 1].map(|_| (0..width * height).map(|_| rng.random()).collect());
            let in_small = squared_distance(&small(&images, &one), &small(&images, &other));
            let in_full = squared_byte_distance(&one, &other) as f32;
            assert!(in_small <= 1.0001 * in_full, "{width}×{height}: {in_small} {in_full}");
        }
    }

    #[test]
    fn distances_are_sums_of_squares() {
        let one: Vec<f32> = (0..37).map(|i| i as f32).collect();
        assert_eq!(
            squared_distance(&one, &[0.0; 37]),
            (0..37).map(|i| (i * i) as f32).sum::<f32>()
        );
        assert_eq!(squared_byte_distance(&[0, 255, 3], &[255, 0, 1]), 2 * 255 * 255 + 4);
        let (black, white) = (vec![0; 100_000], vec![255; 100_000]);
        assert_eq!(squared_byte_distance(&black, &white), 100_000 * 255 * 255);
    }
}
