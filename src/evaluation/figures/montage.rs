//! Rows of labelled frames in one image: contact sheets, and panels like the paper's.

use super::lettering::{Canvas, height_px, width_px};
use crate::frame::{Frame, FrameError};

const PAPER: u8 = 255;
const INK: u8 = 30;
const MARGIN_PX: usize = 16;
const GAP_PX: usize = 8;
const LETTER_SCALE: usize = 2;
/// Frames are enlarged to about this width.
const CELL_WIDTH_PX: u32 = 192;
/// Share of the contrast colour in a grid line.
const GRID_STRENGTH: f32 = 0.3;

/// A row of frames under a heading.
#[derive(Clone, Debug)]
pub struct MontageRow {
    /// The heading; none if empty.
    pub label: String,
    /// Frames with their captions.
    pub cells: Vec<(String, Frame)>,
}

impl MontageRow {
    /// Consecutive frames captioned `t-1`, `t`, `t+1`, …; `first` is the first one's distance from t.
    #[must_use]
    pub fn in_time(label: &str, frames: &[Frame], first: i64) -> Self {
        let caption = |step: i64| {
            if step == 0 {
                "t".to_owned()
            } else {
                format!("t{step:+}")
            }
        };
        let cells = frames
            .iter()
            .zip(first..)
            .map(|(frame, step)| (caption(step), frame.clone()));
        Self {
            label: label.to_owned(),
            cells: cells.collect(),
        }
    }
}

/// How a montage looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Style {
    /// Every pixel becomes a square of so many.
    pub scale: usize,
    /// Vertical lines over every frame, evenly spaced, by which movement shows (paper, figure 8); 0 for none.
    pub grid_lines: usize,
}

impl Style {
    /// Enlarges frames of that width until they are easy to see, with three grid lines.
    #[must_use]
    pub fn for_frames_of(width_px: u32) -> Self {
        Self {
            scale: (CELL_WIDTH_PX / width_px.max(1)).clamp(1, 16) as usize,
            grid_lines: 3,
        }
    }
}

/// What a model predicted, on one sheet like the paper's figure 8: predicted frames, the true ones where they are known
/// (empty otherwise), the frames seen. Errors: as [`montage`].
pub fn prediction_sheet(seen: &[Frame], predicted: &[Frame], truth: &[Frame]) -> Result<Frame, FrameError> {
    prediction_panel("", seen, predicted, truth)
}

/// As [`prediction_sheet`], below a title.
pub(super) fn prediction_panel(
    title: &str,
    seen: &[Frame],
    predicted: &[Frame],
    truth: &[Frame],
) -> Result<Frame, FrameError> {
    let rows: Vec<MontageRow> = [
        ("predicted", predicted, 1),
        ("ground truth", truth, 1),
        ("inputs", seen, 1 - seen.len() as i64),
    ]
    .into_iter()
    .filter(|(_, frames, _)| !frames.is_empty())
    .map(|(label, frames, first)| MontageRow::in_time(label, frames, first))
    .collect();
    let width = seen.first().or(predicted.first()).map_or(1, Frame::width);
    montage(title, &rows, &Style::for_frames_of(width))
}

/// Puts the rows under each other below a title (none if empty). Frames may differ in size.
/// Errors: `Size` if there is no frame at all or the image gets too large.
pub fn montage(title: &str, rows: &[MontageRow], style: &Style) -> Result<Frame, FrameError> {
    let cells = || rows.iter().flat_map(|row| &row.cells);
    let cell_width = cells().map(|(_, frame)| frame.width() as usize).max().unwrap_or(0) * style.scale;
    let widest_caption = cells()
        .map(|(caption, _)| width_px(caption, LETTER_SCALE))
        .max()
        .unwrap_or(0);
    let column = cell_width.max(widest_caption) + GAP_PX;
    let columns = rows.iter().map(|row| row.cells.len()).max().unwrap_or(0);
    let headings = rows.iter().map(|row| row.label.as_str()).chain([title]);
    let widest_heading = headings.map(|text| width_px(text, LETTER_SCALE)).max().unwrap_or(0);
    let width = 2 * MARGIN_PX + widest_heading.max((columns * column).saturating_sub(GAP_PX));
    let line = height_px(LETTER_SCALE) + GAP_PX;
    let title_height = if title.is_empty() { 0 } else { line + GAP_PX };
    let heights: Vec<usize> = rows.iter().map(|row| row_height(row, style, line)).collect();
    let height = 2 * MARGIN_PX + title_height + heights.iter().sum::<usize>();
    // The size is checked before the pixels are allocated.
    let side = |px: usize| u32::try_from(px).unwrap_or(u32::MAX);
    if cell_width == 0 || side(width) > crate::frame::MAX_SIDE_PX || side(height) > crate::frame::MAX_SIDE_PX {
        return Err(FrameError::Size {
            width: side(width),
            height: side(height),
        });
    }
    let mut canvas = Canvas::new(width, height, PAPER);
    canvas.write((MARGIN_PX, MARGIN_PX), title, LETTER_SCALE, INK);
    let mut top = MARGIN_PX + title_height;
    for (row, height) in rows.iter().zip(heights) {
        draw_row(&mut canvas, row, style, (top, column));
        top += height;
    }
    Frame::new(side(width), side(height), canvas.pixels)
}

fn row_height(row: &MontageRow, style: &Style, line: usize) -> usize {
    let heading = if row.label.is_empty() { 0 } else { line };
    let captions = if row.cells.iter().all(|(caption, _)| caption.is_empty()) {
        0
    } else {
        line
    };
    heading + frames_height(row, style) + captions + GAP_PX
}

/// The tallest frame of the row, enlarged.
fn frames_height(row: &MontageRow, style: &Style) -> usize {
    let heights = row.cells.iter().map(|(_, frame)| frame.height() as usize);
    heights.max().unwrap_or(0) * style.scale
}

fn draw_row(canvas: &mut Canvas, row: &MontageRow, style: &Style, (mut top, column): (usize, usize)) {
    if !row.label.is_empty() {
        canvas.write((MARGIN_PX, top), &row.label, LETTER_SCALE, INK);
        top += height_px(LETTER_SCALE) + GAP_PX;
    }
    let frames = frames_height(row, style);
    for (place, (caption, frame)) in row.cells.iter().enumerate() {
        let left = MARGIN_PX + place * column;
        draw_frame(canvas, frame, style, (left, top));
        let indent = (column - GAP_PX).saturating_sub(width_px(caption, LETTER_SCALE)) / 2;
        canvas.write((left + indent, top + frames + GAP_PX / 2), caption, LETTER_SCALE, INK);
    }
}

fn draw_frame(canvas: &mut Canvas, frame: &Frame, style: &Style, (left, top): (usize, usize)) {
    let (width, height) = (
        frame.width() as usize * style.scale,
        frame.height() as usize * style.scale,
    );
    let lines: Vec<usize> = (1..=style.grid_lines)
        .map(|line| line * width / (style.grid_lines + 1))
        .collect();
    for y in 0..height {
        for x in 0..width {
            let value = frame.pixels()[y / style.scale * frame.width() as usize + x / style.scale];
            let drawn = if lines.contains(&x) {
                toward_contrast(value)
            } else {
                value
            };
            canvas.set(left + x, top + y, drawn);
        }
    }
}

/// A line that shows on dark and on bright pixels.
fn toward_contrast(value: u8) -> u8 {
    let contrast = if value < 128 { 255.0 } else { 0.0 };
    (f32::from(value) + GRID_STRENGTH * (contrast - f32::from(value))).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(value: u8) -> Frame {
        Frame::new(8, 4, vec![value; 32]).unwrap()
    }

    #[test]
    fn every_frame_is_shown_enlarged_at_its_place() {
        let row = MontageRow {
            label: String::new(),
            cells: vec![(String::new(), frame(10)), (String::new(), frame(200))],
        };
        let style = Style {
            scale: 3,
            grid_lines: 0,
        };
        let sheet = montage("", &[row], &style).unwrap();
        let at = |x: usize, y: usize| sheet.pixels()[y * sheet.width() as usize + x];
        assert_eq!(sheet.width() as usize, 2 * MARGIN_PX + 2 * 24 + GAP_PX);
        assert_eq!((at(MARGIN_PX, MARGIN_PX), at(MARGIN_PX + 23, MARGIN_PX + 11)), (10, 10));
        assert_eq!(at(MARGIN_PX + 24, MARGIN_PX), PAPER);
        assert_eq!(at(MARGIN_PX + 24 + GAP_PX, MARGIN_PX), 200);
    }

    #[test]
    fn captions_count_from_now() {
        let row = MontageRow::in_time("", &[frame(0), frame(0), frame(0)], -1);
        let captions: Vec<&str> = row.cells.iter().map(|(caption, _)| caption.as_str()).collect();
        assert_eq!(captions, ["t-1", "t", "t+1"]);
    }

    #[test]
    fn nothing_to_show_and_too_much_are_refused() {
        let style = Style::for_frames_of(64);
        assert!(montage("title", &[], &style).is_err());
        let many: Vec<Frame> = (0..600).map(|_| frame(0)).collect();
        assert!(montage("", &[MontageRow::in_time("", &many, 0)], &style).is_err());
    }
}
