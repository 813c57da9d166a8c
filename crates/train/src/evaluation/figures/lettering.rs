//! Text in gray images, from an 8×8 bitmap font.

use font8x8::{BASIC_FONTS, LATIN_FONTS, UnicodeFonts};

/// Side of a letter in pixels before scaling.
const LETTER_PX: usize = 8;

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

    /// Writes a line of text from its top left corner. Letters that the font lacks stay blank.
    pub(super) fn write(&mut self, (left, top): (usize, usize), text: &str, scale: usize, ink: u8) {
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
