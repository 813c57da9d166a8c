//! Pictures of a prediction for a person: what was seen and what is predicted, side by side or in motion.

use font8x8::UnicodeFonts as _;

use crate::frame::{Frame, FrameError, MAX_SIDE_PX, codec};

/// Frames are enlarged until their longer side has about this many pixels.
const SIDE_PX: u32 = 128;
const GLYPH_PX: usize = 8;
/// Between frames, and around labels.
const GAP_PX: usize = 4;
const LABEL_HEIGHT_PX: usize = GLYPH_PX + 2 * GAP_PX;
/// Longer sequences go on in the next row.
const MOST_COLUMNS: usize = 12;
const BACKGROUND: u8 = 32;
const INK: u8 = 255;
/// How long an animation rests on its last frame, in frame periods.
const REST_PERIODS: usize = 4;

/// Rows of labelled frames: those seen, those predicted and, where known, those that came. Errors: `Size` if the sheet
/// grows too large.
pub(super) fn contact_sheet(seen: &[Frame], predicted: &[Frame], came: &[Frame]) -> Result<Frame, FrameError> {
    let past = seen.len().saturating_sub(1);
    let seen_labels = (0..seen.len()).map(|i| {
        if i == past {
            "t".to_owned()
        } else {
            format!("t-{}", past - i)
        }
    });
    let predicted_labels = (1..=predicted.len()).map(|i| format!("t+{i}"));
    let Some(first) = seen.first().or(predicted.first()) else {
        return Frame::new(0, 0, Vec::new());
    };
    let cell = enlarged(first);
    let (cell_width, cell_height) = (cell.width() as usize + GAP_PX, cell.height() as usize + LABEL_HEIGHT_PX);
    let most_columns = ((MAX_SIDE_PX as usize - GAP_PX) / cell_width).clamp(1, MOST_COLUMNS);
    let seen: Vec<_> = seen.iter().zip(seen_labels).collect();
    let predicted: Vec<_> = predicted.iter().zip(predicted_labels).collect();
    let came: Vec<_> = came
        .iter()
        .zip((1..=came.len()).map(|i| format!("true t+{i}")))
        .collect();
    let parts = [seen, predicted, came];
    let rows: Vec<_> = parts.iter().flat_map(|part| part.chunks(most_columns)).collect();
    let columns = rows.iter().map(|row| row.len()).max().unwrap_or_default();
    let mut sheet = Canvas::new(columns * cell_width + GAP_PX, rows.len() * cell_height + GAP_PX);
    for (y, row) in rows.iter().enumerate() {
        for (x, (frame, label)) in row.iter().enumerate() {
            let (left, top) = (GAP_PX + x * cell_width, y * cell_height);
            sheet.write(label, left, top + GAP_PX);
            sheet.paste(&enlarged(frame), left, top + LABEL_HEIGHT_PX);
        }
    }
    sheet.into_frame()
}

/// The frames seen, then those predicted, each with its label, one frame period apart.
pub(super) fn animation(seen: &[Frame], predicted: &[Frame], period_s: f64) -> Result<Vec<u8>, FrameError> {
    let labels = (0..seen.len())
        .map(|i| format!("seen {}", i + 1))
        .chain((1..=predicted.len()).map(|i| format!("predicted t+{i}")));
    let mut frames = Vec::new();
    for (frame, label) in seen.iter().chain(predicted).zip(labels) {
        let picture = enlarged(frame);
        let mut canvas = Canvas::new(picture.width() as usize, picture.height() as usize + LABEL_HEIGHT_PX);
        canvas.write(&label, GAP_PX, GAP_PX);
        canvas.paste(&picture, 0, LABEL_HEIGHT_PX);
        frames.push(canvas.into_frame()?);
    }
    let last = frames.last().cloned();
    frames.extend(last.into_iter().flat_map(|last| vec![last; REST_PERIODS]));
    codec::encode_gif(&frames, (period_s * 1000.0).clamp(20.0, 10_000.0) as u32)
}

/// The frame with every pixel repeated.
fn enlarged(frame: &Frame) -> Frame {
    let factor = (SIDE_PX / frame.width().max(frame.height())).max(1) as usize;
    let row = |row: &[u8]| {
        row.iter()
            .flat_map(|&pixel| std::iter::repeat_n(pixel, factor))
            .collect::<Vec<u8>>()
    };
    let rows = frame.pixels().chunks_exact(frame.width() as usize);
    let pixels = rows.flat_map(|pixels| row(pixels).repeat(factor)).collect();
    let side = |length: u32| length * factor as u32;
    Frame::new(side(frame.width()), side(frame.height()), pixels).unwrap_or_else(|_| frame.clone())
}

struct Canvas {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
}

impl Canvas {
    fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            pixels: vec![BACKGROUND; width * height],
        }
    }

    /// Sets a pixel; what is outside is cut off.
    fn set(&mut self, x: usize, y: usize, value: u8) {
        if x < self.width && y < self.height {
            self.pixels[y * self.width + x] = value;
        }
    }

    fn write(&mut self, text: &str, left: usize, top: usize) {
        for (place, letter) in text.chars().enumerate() {
            let glyph = font8x8::BASIC_FONTS.get(letter).unwrap_or_default();
            for (y, bits) in glyph.iter().enumerate() {
                for x in (0..GLYPH_PX).filter(|x| bits >> x & 1 == 1) {
                    self.set(left + place * GLYPH_PX + x, top + y, INK);
                }
            }
        }
    }

    fn paste(&mut self, frame: &Frame, left: usize, top: usize) {
        for (y, row) in frame.pixels().chunks_exact(frame.width() as usize).enumerate() {
            for (x, &value) in row.iter().enumerate() {
                self.set(left + x, top + y, value);
            }
        }
    }

    fn into_frame(self) -> Result<Frame, FrameError> {
        Frame::new(self.width as u32, self.height as u32, self.pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(value: u8) -> Frame {
        Frame::new(64, 64, vec![value; 4096]).unwrap()
    }

    #[test]
    fn a_sheet_has_a_row_of_frames_seen_above_a_row_of_frames_predicted() {
        let sheet = contact_sheet(&[flat(10), flat(20), flat(30)], &[flat(200)], &[]).unwrap();
        let (cell_width, cell_height) = (128 + GAP_PX, 128 + LABEL_HEIGHT_PX);
        let pixel = |x: usize, y: usize| sheet.pixels()[y * sheet.width() as usize + x];
        assert_eq!(sheet.width() as usize, 3 * cell_width + GAP_PX);
        assert_eq!(pixel(GAP_PX + cell_width + 5, LABEL_HEIGHT_PX + 5), 20);
        assert_eq!(pixel(GAP_PX + 5, cell_height + LABEL_HEIGHT_PX + 5), 200);
        assert!(sheet.pixels().contains(&INK));
    }

    #[test]
    fn an_animation_is_a_gif() {
        assert!(animation(&[flat(1)], &[flat(2)], 0.2).unwrap().starts_with(b"GIF89a"));
    }
}
