//! Gray images to draw on: text from an 8×8 bitmap font, lines and discs. Crates that write text on images read the outlines of
//! a font file, which the program would have to carry; `font8x8` is a table of dots, and looks the same everywhere.

use std::ops::Range;

use font8x8::{BASIC_FONTS, LATIN_FONTS, UnicodeFonts};
use foreframe_core::frame::Frame;

/// Side of a letter in pixels before scaling.
const LETTER_PX: usize = 8;

/// How text looks.
#[derive(Clone, Copy)]
pub(super) struct TextStyle {
    /// Pixels of the canvas for each dot of a letter, to each side.
    pub(super) scale: usize,
    pub(super) ink: u8,
}

/// Width of a line of text in pixels.
pub(super) fn width_px(text: &str, scale: usize) -> usize {
    text.chars().count() * LETTER_PX * scale
}

/// Height of a line of text in pixels.
pub(super) const fn height_px(scale: usize) -> usize {
    LETTER_PX * scale
}

/// A gray image to draw on.
#[derive(Clone, Debug)]
pub(super) struct Canvas {
    /// Width in pixels.
    width: usize,
    /// Intensities, row by row.
    pub(super) pixels: Vec<u8>,
}

impl Canvas {
    /// A canvas of one intensity.
    pub(super) fn new(width: usize, height: usize, background: u8) -> Self {
        Self {
            width,
            pixels: vec![background; width * height],
        }
    }

    /// Sets a pixel; outside the canvas nothing happens.
    pub(super) fn set(&mut self, x: usize, y: usize, value: u8) {
        if x < self.width
            && let Some(pixel) = self.pixels.get_mut(y * self.width + x)
        {
            *pixel = value;
        }
    }

    /// A filled square around a place [column, row], `half_px` to each side.
    pub(super) fn dot(&mut self, [x, y]: [f32; 2], half_px: f32, ink: u8) {
        let (columns, rows) = (self.span(x, half_px), self.span(y, half_px));
        for row in rows {
            for column in columns.clone() {
                self.set(column, row, ink);
            }
        }
    }

    /// A straight line from place to place, `half_px` to each side.
    pub(super) fn line(&mut self, from: [f32; 2], to: [f32; 2], half_px: f32, ink: u8) {
        let steps = (to[0] - from[0]).hypot(to[1] - from[1]).ceil();
        let steps = steps.clamp(1.0, 4.0 * self.longest_side() as f32);
        for step in 0..=steps as usize {
            let part = step as f32 / steps;
            let place = [0, 1].map(|axis| from[axis] + part * (to[axis] - from[axis]));
            self.dot(place, half_px.max(0.5), ink);
        }
    }

    /// A filled disc.
    pub(super) fn disc(&mut self, [x, y]: [f32; 2], radius_px: f32, ink: u8) {
        for row in self.span(y, radius_px) {
            let height = row as f32 - y;
            let half = (radius_px * radius_px - height * height).max(0.0).sqrt();
            for column in self.span(x, half) {
                self.set(column, row, ink);
            }
        }
    }

    /// Copies another image; `left` and `top`: where its first pixel gets.
    pub(super) fn paste(&mut self, image: &Frame, [left, top]: [usize; 2]) {
        for (y, row) in image.pixels().chunks_exact(image.width() as usize).enumerate() {
            for (x, &value) in row.iter().enumerate() {
                self.set(left + x, top + y, value);
            }
        }
    }

    /// The numbers of columns or rows that are within `half_px` of a place; those beyond the longest side are left out.
    fn span(&self, middle: f32, half_px: f32) -> Range<usize> {
        let last = self.longest_side() as f32;
        let [low, high] = [middle - half_px, middle + half_px].map(|edge| edge.clamp(-1.0, last));
        low.ceil().max(0.0) as usize..(high.floor() + 1.0) as usize
    }

    fn longest_side(&self) -> usize {
        self.width.max(self.pixels.len() / self.width.max(1))
    }

    /// Writes a line of text from its top left corner. Letters that the font lacks stay blank.
    pub(super) fn write(&mut self, left: usize, top: usize, text: &str, style: TextStyle) {
        let TextStyle { scale, ink } = style;
        for (place, letter) in text.chars().enumerate() {
            let glyph = BASIC_FONTS.get(letter).or_else(|| LATIN_FONTS.get(letter));
            for (row, bits) in glyph.into_iter().flatten().enumerate() {
                for column in (0..LETTER_PX).filter(|column| bits >> column & 1 == 1) {
                    let (x, y) = (left + (place * LETTER_PX + column) * scale, top + row * scale);
                    for dot in 0..scale * scale {
                        self.set(x + dot % scale, y + dot / scale, ink);
                    }
                }
            }
        }
    }
}
