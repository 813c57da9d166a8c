//! Marks of a sample of the frames that a training had. By them, an evaluation finds these frames in any data set, also in one that holds
//! only some of them.

use std::collections::BTreeSet;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use foreframe_core::files::sha256_hex;
use foreframe_data::dataset::{Dataset, DatasetError, Window};

/// Marks that a model keeps, at most: the smallest ones, which are those of a random sample of the frames.
const KEPT: usize = 512;
/// Hexadecimal digits of a mark: 6 bytes, a number that JSON holds exactly.
const DIGITS: usize = 12;
/// Equal frames that are no coincidence: one alone may be black in both.
const FEWEST_SEEN: usize = 2;

/// The marks of the distinct frames of windows of `length` frames: the first 6 bytes of the SHA-256 of the pixels, row by row, as a number.
/// Errors: those of [`Dataset::pixels`].
pub(crate) fn of_windows(dataset: &Dataset, windows: &[Window], length: usize) -> Result<BTreeSet<u64>, DatasetError> {
    let starts = windows.iter().map(|window| window.first_frame);
    let frames: BTreeSet<usize> = starts.flat_map(|start| start..start + length).collect();
    let mark = |frame: usize| dataset.pixels(frame).map(|pixels| mark(&pixels));
    frames.into_par_iter().map(mark).collect()
}

fn mark(pixels: &[u8]) -> u64 {
    let digits = &sha256_hex(pixels)[..DIGITS];
    u64::from_str_radix(digits, 16).expect("a hash without hexadecimal digits is a bug")
}

/// Those of the marks that a model keeps.
pub(crate) fn kept(marks: BTreeSet<u64>) -> Vec<u64> {
    marks.into_iter().take(KEPT).collect()
}

/// How many frames a training had, judged by a sample of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FramesOfTraining {
    /// Frames whose marks the model would have kept.
    pub sampled: usize,
    /// Frames of these whose marks it kept: the training had them.
    pub seen: usize,
}

impl FramesOfTraining {
    /// Compares the marks of frames with those that a model kept.
    pub(crate) fn count(marks: &BTreeSet<u64>, kept: &[u64]) -> Self {
        let largest = kept.get(KEPT - 1).copied().unwrap_or(u64::MAX);
        let sampled = marks.range(..=largest);
        Self {
            sampled: sampled.clone().count(),
            seen: sampled.filter(|mark| kept.contains(mark)).count(),
        }
    }

    /// Whether the training had frames of these, so that they do not test the model.
    #[must_use]
    pub fn were_trained_on(self) -> bool {
        self.seen >= FEWEST_SEEN
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mark_is_the_first_six_bytes_of_the_hash_of_the_pixels() {
        // The SHA-256 of "abc" in the standard.
        assert_eq!(mark(b"abc"), 0xba78_16bf_8f01);
    }

    #[test]
    fn the_share_of_frames_that_were_seen_is_estimated_by_those_that_the_model_would_keep() {
        let marks =
            |range: std::ops::Range<u64>| -> BTreeSet<u64> { range.map(|index| mark(&index.to_le_bytes())).collect() };
        let (trained, half) = (kept(marks(0..20_000)), marks(19_000..21_000));
        let found = FramesOfTraining::count(&half, &trained);
        assert!((30..75).contains(&found.sampled), "{found:?}");
        let share = found.seen as f64 / found.sampled as f64;
        assert!((0.3..0.7).contains(&share) && found.were_trained_on(), "{found:?}");
        let new = FramesOfTraining::count(&marks(20_000..22_000), &trained);
        assert!(new.sampled >= 30 && new.seen == 0 && !new.were_trained_on(), "{new:?}");
        // Of few frames, all are kept.
        let few = FramesOfTraining::count(&half, &kept(marks(19_900..20_001)));
        assert_eq!((few.sampled, few.seen), (2000, 101));
    }
}
