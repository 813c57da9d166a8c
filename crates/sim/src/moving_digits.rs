//! Handwritten digits that move over a black square and bounce at its borders: the rule of Moving MNIST (Srivastava,
//! Mansimov & Salakhutdinov 2015, as in the program that they released).
//!
//! Each digit starts at a place drawn evenly, in a direction drawn evenly, and moves a tenth of the free side per frame.
//! Places are cut to whole pixels. Where digits overlap, the brighter pixel counts.

use std::f64::consts::TAU;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// Width and height of a digit in pixels, as in MNIST.
pub const DIGIT_SIDE_PX: usize = 28;
/// Pixels of a digit.
pub const DIGIT_PIXELS: usize = DIGIT_SIDE_PX * DIGIT_SIDE_PX;
/// Width and height of a frame in pixels.
pub const DIGITS_FRAME_SIDE_PX: usize = 64;
/// The pixels that a digit can move along one side.
const FREE_PX: f64 = (DIGITS_FRAME_SIDE_PX - DIGIT_SIDE_PX) as f64;
/// The way of a digit in one frame, as a share of [`FREE_PX`].
const STEP: f64 = 0.1;

/// Place and velocity of a digit's upper left corner along one side, as shares of the free side.
#[derive(Clone, Copy)]
struct BouncingCorner {
    place: f64,
    velocity: f64,
}

impl BouncingCorner {
    /// Moves on by one frame; a border turns the velocity round.
    fn step(&mut self) {
        self.place += self.velocity;
        if self.place <= 0.0 || self.place >= 1.0 {
            self.place = self.place.clamp(0.0, 1.0);
            self.velocity = -self.velocity;
        }
    }

    fn pixel(self) -> usize {
        (FREE_PX * self.place) as usize
    }
}

/// The frames of one trial, row by row: black, with these digits moving over it.
#[must_use]
pub fn moving_digits(digits: &[&[u8; DIGIT_PIXELS]], frame_count: usize, random: &mut ChaCha8Rng) -> Vec<u8> {
    let frame_pixels = DIGITS_FRAME_SIDE_PX * DIGITS_FRAME_SIDE_PX;
    let mut frames = vec![0; frame_count * frame_pixels];
    for digit in digits {
        let [x, y] = [random.random(), random.random()];
        let direction = TAU * random.random::<f64>();
        let corner = |place, share: f64| BouncingCorner {
            place,
            velocity: STEP * share,
        };
        let (mut column, mut row) = (corner(x, direction.cos()), corner(y, direction.sin()));
        for frame in frames.chunks_exact_mut(frame_pixels) {
            column.step();
            row.step();
            draw(frame, digit, (column.pixel(), row.pixel()));
        }
    }
    frames
}

/// Draws a digit with its upper left corner at a column and row; of two pixels, the brighter one stays.
fn draw(frame: &mut [u8], digit: &[u8; DIGIT_PIXELS], (left, top): (usize, usize)) {
    let rows = frame.chunks_exact_mut(DIGITS_FRAME_SIDE_PX).skip(top);
    for (frame_row, digit_row) in rows.zip(digit.chunks_exact(DIGIT_SIDE_PX)) {
        for (pixel, &value) in frame_row.iter_mut().skip(left).zip(digit_row) {
            *pixel = value.max(*pixel);
        }
    }
}
