//! The background in front of which a standing camera sees things move.

use super::{Dataset, DatasetError};

/// Frames that the background is the median of at most, evenly spread.
const MAX_FRAMES: usize = 1000;
/// A pixel that differs from the background by more than this belongs to something else.
const DIFFERENCE: u8 = 12;
/// Where more than this share of the pixels differ, the camera looks elsewhere.
pub const MAX_CHANGED_SHARE: f32 = 0.4;

/// The background of some frames.
pub struct Background {
    /// The median of every pixel, 0 to 255, row by row.
    pub pixels: Vec<u8>,
    /// The share of the frames' pixels that differ from it.
    pub changed_share: f32,
}

impl Background {
    /// The background of these frames, of evenly spread ones if there are many. Errors: those of [`Dataset::pixels`].
    pub fn of(dataset: &Dataset, frames: &[usize]) -> Result<Self, DatasetError> {
        let used = frames.len().min(MAX_FRAMES);
        let mut counts = vec![[0u16; 256]; dataset.info().frame_pixels()];
        for index in 0..used {
            let frame = dataset.pixels(frames[index * frames.len() / used])?;
            for (counts, &value) in counts.iter_mut().zip(&*frame) {
                counts[usize::from(value)] += 1;
            }
        }
        let middle = used as u16 / 2;
        let pixels: Vec<u8> = counts.iter().map(|counts| median(counts, middle)).collect();
        let changed: usize = counts
            .iter()
            .zip(&pixels)
            .map(|(counts, &at)| far_from(counts, at))
            .sum();
        Ok(Self {
            changed_share: changed as f32 / (used * pixels.len()).max(1) as f32,
            pixels,
        })
    }
}

/// Whether each pixel, 0 to 1, differs from the background.
pub fn differing(frame: &[f32], background: &[f32]) -> impl Iterator<Item = bool> {
    frame
        .iter()
        .zip(background)
        .map(|(value, behind)| (value - behind).abs() > f32::from(DIFFERENCE) / 255.0)
}

/// The value that has `middle` others below it.
fn median(counts: &[u16; 256], middle: u16) -> u8 {
    let mut below = 0;
    for (value, count) in (0..=u8::MAX).zip(counts) {
        below += count;
        if below > middle {
            return value;
        }
    }
    0
}

/// How many of a pixel's values differ from the one given.
fn far_from(counts: &[u16; 256], at: u8) -> usize {
    let far = (0..=u8::MAX)
        .zip(counts)
        .filter(|(value, _)| value.abs_diff(at) > DIFFERENCE);
    far.map(|(_, &count)| usize::from(count)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{DatasetInfo, EpisodeData};

    /// A data set of frames of 4×1 px.
    fn dataset(frames: &[[u8; 4]]) -> Dataset {
        let info = DatasetInfo {
            frame_width_px: 4,
            frame_height_px: 1,
            frame_period_s: 0.1,
            ..DatasetInfo::default()
        };
        let episode = EpisodeData {
            pixels: frames.concat(),
            timestamps_s: (0..frames.len()).map(|frame| 0.1 * frame as f64).collect(),
            ..EpisodeData::default()
        };
        Dataset::from_episodes(info, vec![episode]).unwrap()
    }

    #[test]
    fn the_background_is_the_median_and_what_is_far_from_it_has_changed() {
        let frames = dataset(&[[10, 0, 100, 7], [10, 255, 112, 7], [200, 3, 113, 7]]);
        let behind = Background::of(&frames, &[0, 1, 2]).unwrap();
        assert_eq!(behind.pixels, [10, 3, 112, 7]);
        // 200 and 255 are far from the median; 100 is 12 from it, which is not enough.
        assert!((behind.changed_share - 2.0 / 12.0).abs() < 1e-6);
        let two = Background::of(&frames, &[0, 1]).unwrap();
        assert_eq!(two.pixels, [10, 255, 112, 7]);
        let none = Background::of(&frames, &[]).unwrap();
        assert_eq!((none.pixels, none.changed_share), (vec![0; 4], 0.0));
    }

    #[test]
    fn of_many_frames_some_are_taken_evenly() {
        let frames: Vec<[u8; 4]> = (0..2400).map(|frame| [u8::from(frame >= 1600) * 50; 4]).collect();
        let all: Vec<usize> = (0..frames.len()).collect();
        let behind = Background::of(&dataset(&frames), &all).unwrap();
        assert_eq!(behind.pixels, [0; 4]);
        assert!((behind.changed_share - 1.0 / 3.0).abs() < 2e-3);
    }
}
