//! Follows blocks of a frame through other frames by comparing pixels, as video codecs do.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use crate::nn::ops::sampling::ImageSize;
use crate::vectorized::vectorized;

/// Sides of the window that is compared, in pixels. The block of 4×4 px lies in its middle.
const WIDTH: usize = 16;
const HEIGHT: usize = 12;
/// Pixels that a block moves at most from one frame to the next, along each side.
pub(super) const REACH: i32 = 4;
/// Windows with less in them (sum of squares) are not followed.
const LEAST_ENERGY: f32 = 1.0;
/// What it costs to move otherwise than in the frame before, for each squared pixel, and the most that it costs.
const CHANGE_COST: f32 = 0.02;
const MOST_CHANGE: f32 = 8.0;
/// A later place must cost less than the best so far by more than the sum of [`LEAST_GAIN`] and the part [`LEAST_PART`] of that cost. Rounding
/// alone makes smaller differences. Costs of whole gray levels that differ do so by at least half of a squared level, 0.0000077.
const LEAST_GAIN: f32 = 4e-6;
const LEAST_PART: f32 = 1e-6;
/// Black pixels around the frames.
const BORDER: usize = 4 * WIDTH;

/// Values of one block for one frame: how far it moved since the frame that it was cut from, to the right and down in pixels, and
/// its misfit there: the squared difference, with the cost of the change, over the sum of squares, 0 to 1.
pub(super) const TRACK_VALUES: usize = 3;

/// The tracks of all blocks of a frame, row by row.
pub(super) struct Tracks {
    /// [`TRACK_VALUES`] for each of the other frames, block after block; zeros where nothing can be followed.
    pub(super) values: Vec<f32>,
    /// Whether a block has enough in it to be followed.
    pub(super) followed: Vec<bool>,
}

/// The tracks of the blocks of `frame` through `others`, each following the one before.
pub(super) fn block_tracks<'a>(frame: &[f32], others: impl Iterator<Item = &'a [f32]>, size: ImageSize) -> Tracks {
    let blocks = size.shrunk(4);
    let frame = Bordered::new(frame, size);
    let others: Vec<Bordered> = others.map(|other| Bordered::new(other, size)).collect();
    let mut values = vec![0.0; blocks.pixels() * others.len() * TRACK_VALUES];
    let mut followed = vec![false; blocks.pixels()];
    if others.is_empty() {
        return Tracks { values, followed };
    }
    vectorized(
        #[inline(always)]
        || {
            let tracks = values.chunks_exact_mut(others.len() * TRACK_VALUES);
            for (block, (track, followed)) in tracks.zip(&mut followed).enumerate() {
                let place = [
                    4 * (block % blocks.width) + 2 + BORDER - WIDTH / 2,
                    4 * (block / blocks.width) + 2 + BORDER - HEIGHT / 2,
                ];
                *followed = follow(&frame.window(place), place, &others, track);
            }
        },
    );
    Tracks { values, followed }
}

/// A frame with black around it.
struct Bordered {
    pixels: Vec<f32>,
    width: usize,
    height: usize,
}

type Window = [[f32; WIDTH]; HEIGHT];

impl Bordered {
    fn new(frame: &[f32], size: ImageSize) -> Self {
        let (width, height) = (size.width + 2 * BORDER, size.height + 2 * BORDER);
        let mut pixels = vec![0.0; width * height];
        for (row, values) in frame.chunks_exact(size.width).enumerate() {
            pixels[(row + BORDER) * width + BORDER..][..size.width].copy_from_slice(values);
        }
        Self { pixels, width, height }
    }

    #[inline(always)]
    fn window(&self, [left, top]: [usize; 2]) -> Window {
        let mut window = [[0.0; WIDTH]; HEIGHT];
        for (row, values) in window.iter_mut().enumerate() {
            values.copy_from_slice(&self.pixels[(top + row) * self.width + left..][..WIDTH]);
        }
        window
    }

    /// The sum of squared differences to a window.
    #[inline(always)]
    fn misfit(&self, window: &Window, [left, top]: [usize; 2]) -> f32 {
        let mut sums = [0.0f32; WIDTH];
        for (row, values) in window.iter().enumerate() {
            let pixels = &self.pixels[(top + row) * self.width + left..][..WIDTH];
            for at in 0..WIDTH {
                let difference = pixels[at] - values[at];
                sums[at] += difference * difference;
            }
        }
        let mut sum = 0.0;
        for part in sums {
            sum += part;
        }
        sum
    }

    /// The place `[dx, dy]` from another one, if a window fits there.
    #[inline(always)]
    fn beside(&self, place: [usize; 2], step: [i32; 2]) -> Option<[usize; 2]> {
        let left = place[0].checked_add_signed(step[0] as isize)?;
        let top = place[1].checked_add_signed(step[1] as isize)?;
        (left + WIDTH <= self.width && top + HEIGHT <= self.height).then_some([left, top])
    }
}

/// Writes the track of one window, if there is enough in it.
#[inline(always)]
fn follow(window: &Window, from: [usize; 2], others: &[Bordered], track: &mut [f32]) -> bool {
    let mut energy = 0.0;
    for row in window {
        for value in row {
            energy += value * value;
        }
    }
    if energy < LEAST_ENERGY {
        return false;
    }
    let (mut place, mut before) = (from, [0, 0]);
    for (other, track) in others.iter().zip(track.chunks_exact_mut(TRACK_VALUES)) {
        let (mut least, mut best) = (f32::INFINITY, [0, 0]);
        for down in -REACH..=REACH {
            for right in -REACH..=REACH {
                let Some(there) = other.beside(place, [right, down]) else {
                    continue;
                };
                let change = (right - before[0]).pow(2) + (down - before[1]).pow(2);
                let cost = other.misfit(window, there) + CHANGE_COST * (change as f32).min(MOST_CHANGE);
                if cost < least * (1.0 - LEAST_PART) - LEAST_GAIN {
                    (least, best) = (cost, [right, down]);
                }
            }
        }
        before = best;
        place = other.beside(place, best).unwrap_or(place);
        track[0] = place[0] as f32 - from[0] as f32;
        track[1] = place[1] as f32 - from[1] as f32;
        track[2] = (least / energy).min(1.0);
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: ImageSize = ImageSize { height: 32, width: 40 };

    /// A patterned square of 8×8 px.
    fn frame([left, top]: [usize; 2]) -> Vec<f32> {
        let mut frame = vec![0.0; SIZE.pixels()];
        for row in 0..8 {
            for column in 0..8 {
                frame[(top + row) * SIZE.width + left + column] = 0.3 + (row * 8 + column) as f32 % 7.0 / 10.0;
            }
        }
        frame
    }

    #[test]
    fn a_block_is_followed_through_turns() {
        let others = [frame([13, 11]), frame([10, 14]), frame([14, 14])];
        let tracks = block_tracks(&frame([16, 12]), others.iter().map(Vec::as_slice), SIZE);
        let of_block = |row: usize, column: usize| &tracks.values[(row * 10 + column) * 9..][..9];
        let found = of_block(3, 4).chunks_exact(TRACK_VALUES);
        for (found, expected) in found.zip([[-3.0, -1.0], [-6.0, 2.0], [-2.0, 2.0]]) {
            assert_eq!(found[..2], expected);
            assert!(
                (0.0..0.02).contains(&found[2]),
                "only the turn costs something: {}",
                found[2]
            );
        }
        assert_eq!(of_block(0, 0), [0.0; 9], "nothing is there");
        assert!(tracks.followed[34] && !tracks.followed[0]);
    }

    #[test]
    fn of_places_that_cost_the_same_the_upper_one_counts() {
        // Two frames that are the same upside down. 2 px up and 2 px down cost the same, but rounded sums of f32 differ.
        let size = ImageSize { height: 20, width: 40 };
        let frame = |rows: [u8; 10]| -> Vec<f32> {
            let row = |gray: u8| vec![f32::from(gray) / 255.0; size.width];
            rows.into_iter().chain(rows.into_iter().rev()).flat_map(row).collect()
        };
        let last = frame([136, 244, 105, 78, 224, 174, 136, 251, 251, 62]);
        let before = frame([253, 63, 137, 244, 105, 77, 222, 173, 137, 254]);
        let tracks = block_tracks(&last, [before.as_slice()].into_iter(), size);
        assert_eq!(tracks.values[(2 * 10 + 5) * 3..][..2], [0.0, -2.0]);
    }

    #[test]
    fn what_leaves_the_frame_misfits() {
        let black = vec![0.0; SIZE.pixels()];
        let tracks = block_tracks(&frame([0, 0]), [black.as_slice()].into_iter(), SIZE);
        assert_eq!(tracks.values[..3], [0.0, 0.0, 1.0]);
    }

    #[test]
    fn what_stands_still_is_followed() {
        let still = frame([16, 12]);
        let tracks = block_tracks(&still, [still.as_slice()].into_iter(), SIZE);
        assert!(tracks.followed[34]);
        assert_eq!(tracks.values[34 * 3..][..3], [0.0; 3]);
    }
}
