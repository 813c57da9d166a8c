//! Rows of labelled frames in one image: contact sheets, and panels like the paper's.

use std::iter::{repeat, repeat_n};

use super::canvas::{Canvas, TextStyle, height_px, width_px};
use foreframe_core::frame::{Frame, FrameError, MAX_SIDE_PX};

const PAPER: u8 = 255;
const INK: u8 = 30;
const MARGIN_PX: usize = 16;
const GAP_PX: usize = 8;
const LETTER_SCALE: usize = 3;
const TEXT: TextStyle = TextStyle {
    scale: LETTER_SCALE,
    ink: INK,
};
/// A line of text and the gap below it.
const LINE_PX: usize = height_px(LETTER_SCALE) + GAP_PX;
/// Frames are enlarged to at least this width.
pub const CELL_WIDTH_PX: u32 = 256;
/// Frames in a row at most; longer rows are wrapped.
const ROW_CELLS: usize = 10;
/// Errors are drawn brighter by this factor.
const ERROR_GAIN: u8 = 3;
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
        let caption = |step: i64| match step {
            0 => "t".to_owned(),
            _ => format!("t{step:+}"),
        };
        let cells = frames.iter().zip(first..);
        let cells = cells.map(|(frame, step)| (caption(step), frame.clone()));
        Self {
            label: label.to_owned(),
            cells: cells.collect(),
        }
    }
}

/// How a montage looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Style {
    /// Every pixel becomes a square of this side, or of a smaller one where the picture would get too large.
    pub scale: usize,
    /// Vertical lines over every frame, evenly spaced, by which movement shows (paper, figure 8); 0 for none.
    pub grid_lines: usize,
}

impl Style {
    /// Enlarges frames of that width to at least [`CELL_WIDTH_PX`], with three grid lines.
    #[must_use]
    pub fn for_frames_of(width_px: u32) -> Self {
        Self {
            scale: enlargement(width_px),
            grid_lines: 3,
        }
    }
}

/// How often a frame of that width is enlarged, so that it is at least [`CELL_WIDTH_PX`] wide.
fn enlargement(width_px: u32) -> usize {
    CELL_WIDTH_PX.div_ceil(width_px.max(1)) as usize
}

/// A frame enlarged to at least [`CELL_WIDTH_PX`], each pixel a square (nearest neighbour), for pictures that a person
/// looks at. Errors: `Size` if it gets too large.
pub fn enlarged(frame: &Frame) -> Result<Frame, FrameError> {
    let scale = enlargement(frame.width());
    let [width, height] = sides(frame.width() as usize * scale, frame.height() as usize * scale)?;
    Frame::new(width, height, enlarged_pixels(frame, scale))
}

/// The pixels of a frame, each as a square of that side.
fn enlarged_pixels(frame: &Frame, scale: usize) -> Vec<u8> {
    let mut pixels = Vec::with_capacity(frame.pixels().len() * scale * scale);
    for row in frame.pixels().chunks_exact(frame.width() as usize) {
        let wide: Vec<u8> = row.iter().flat_map(|&value| repeat_n(value, scale)).collect();
        for _ in 0..scale {
            pixels.extend_from_slice(&wide);
        }
    }
    pixels
}

/// The sides of a picture, before its pixels are allocated. Errors: `Size`.
fn sides(width: usize, height: usize) -> Result<[u32; 2], FrameError> {
    let [width, height] = [width, height].map(|px| u32::try_from(px).unwrap_or(u32::MAX));
    if (1..=MAX_SIDE_PX).contains(&width) && (1..=MAX_SIDE_PX).contains(&height) {
        Ok([width, height])
    } else {
        Err(FrameError::Size { width, height })
    }
}

/// What a model predicted, on one sheet. Time runs from left to right; from the top: the frames seen, the true frames to
/// come where they are known, the predicted ones, and the error of each. Long rows are wrapped. Errors: as [`montage`].
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
    let mut rows = wrapped("inputs", seen, 1 - seen.len() as i64);
    let truth = &truth[..truth.len().min(predicted.len())];
    let known = truth.chunks(ROW_CELLS).chain(repeat(&[][..]));
    for ((part, known), first) in predicted.chunks(ROW_CELLS).zip(known).zip((1..).step_by(ROW_CELLS)) {
        if !known.is_empty() {
            rows.push(MontageRow::in_time("truth", known, first));
        }
        rows.push(MontageRow::in_time("predicted", part, first));
        if !known.is_empty() {
            rows.push(error_row(part, known)?);
        }
    }
    let width = seen.first().or(predicted.first()).map_or(1, Frame::width);
    montage(title, &rows, &Style::for_frames_of(width))
}

/// Frames in rows of at most [`ROW_CELLS`]; the first row has the heading.
fn wrapped(label: &str, frames: &[Frame], first: i64) -> Vec<MontageRow> {
    let parts = frames.chunks(ROW_CELLS).zip((first..).step_by(ROW_CELLS));
    parts
        .enumerate()
        .map(|(row, (part, first))| MontageRow::in_time(if row == 0 { label } else { "" }, part, first))
        .collect()
}

/// The absolute error of every predicted frame, brighter where it is larger, with its mean squared error.
fn error_row(predicted: &[Frame], truth: &[Frame]) -> Result<MontageRow, FrameError> {
    let cells = predicted.iter().zip(truth).map(|(predicted, truth)| {
        let pairs = predicted.pixels().iter().zip(truth.pixels());
        let differences: Vec<u8> = pairs.map(|(one, other)| one.abs_diff(*other)).collect();
        let squares = differences.iter().map(|&value| (f64::from(value) / 255.0).powi(2));
        let mse = squares.sum::<f64>() / differences.len() as f64;
        let pixels = differences
            .iter()
            .map(|value| value.saturating_mul(ERROR_GAIN))
            .collect();
        let frame = Frame::new(predicted.width(), predicted.height(), pixels)?;
        Ok((format!("{:.1}e-4", mse * 1e4), frame))
    });
    Ok(MontageRow {
        label: format!("error, {ERROR_GAIN} times as bright, with its MSE"),
        cells: cells.collect::<Result<_, FrameError>>()?,
    })
}

/// Puts the rows under each other below a title (none if empty). Frames may differ in size. Where the picture would get
/// too large, frames are enlarged less. Errors: `Size` if there is no frame at all or it is too large even so.
pub fn montage(title: &str, rows: &[MontageRow], style: &Style) -> Result<Frame, FrameError> {
    let mut style = *style;
    let mut layout = Layout::of(title, rows, &style);
    while style.scale > 1 && layout.sides().is_err() {
        style.scale -= 1;
        layout = Layout::of(title, rows, &style);
    }
    let [width, height] = layout.sides()?;
    let mut canvas = Canvas::new(layout.width, layout.height, PAPER);
    canvas.write(MARGIN_PX, MARGIN_PX, title, TEXT);
    let mut top = layout.top;
    for (row, row_height) in rows.iter().zip(&layout.heights) {
        draw_row(&mut canvas, row, &style, (top, layout.column));
        top += row_height;
    }
    Frame::new(width, height, canvas.pixels)
}

/// Where everything is, in pixels.
struct Layout {
    /// 0 if there is no frame.
    width: usize,
    height: usize,
    /// From one cell's left edge to the next.
    column: usize,
    /// Below the title.
    top: usize,
    /// The height of each row.
    heights: Vec<usize>,
}

impl Layout {
    fn of(title: &str, rows: &[MontageRow], style: &Style) -> Self {
        let text_width = |text: &str| width_px(text, LETTER_SCALE);
        let cells = || rows.iter().flat_map(|row| &row.cells);
        let cell_width = cells().map(|(_, frame)| frame.width() as usize).max().unwrap_or(0) * style.scale;
        let widest_caption = cells().map(|(caption, _)| text_width(caption)).max().unwrap_or(0);
        let column = cell_width.max(widest_caption) + GAP_PX;
        let columns = rows.iter().map(|row| row.cells.len()).max().unwrap_or(0);
        let headings = rows.iter().map(|row| row.label.as_str()).chain([title]);
        let widest_heading = headings.map(text_width).max().unwrap_or(0);
        let title_height = if title.is_empty() { 0 } else { LINE_PX + GAP_PX };
        let heights: Vec<usize> = rows.iter().map(|row| row_height(row, style)).collect();
        let width = 2 * MARGIN_PX + widest_heading.max((columns * column).saturating_sub(GAP_PX));
        Self {
            width: if cell_width > 0 { width } else { 0 },
            height: 2 * MARGIN_PX + title_height + heights.iter().sum::<usize>(),
            column,
            top: MARGIN_PX + title_height,
            heights,
        }
    }

    fn sides(&self) -> Result<[u32; 2], FrameError> {
        sides(self.width, self.height)
    }
}

fn row_height(row: &MontageRow, style: &Style) -> usize {
    let has_captions = row.cells.iter().any(|(caption, _)| !caption.is_empty());
    let lines = usize::from(!row.label.is_empty()) + usize::from(has_captions);
    lines * LINE_PX + frames_height(row, style) + GAP_PX
}

/// The tallest frame of the row, enlarged.
fn frames_height(row: &MontageRow, style: &Style) -> usize {
    let heights = row.cells.iter().map(|(_, frame)| frame.height() as usize);
    heights.max().unwrap_or(0) * style.scale
}

fn draw_row(canvas: &mut Canvas, row: &MontageRow, style: &Style, (mut top, column): (usize, usize)) {
    if !row.label.is_empty() {
        canvas.write(MARGIN_PX, top, &row.label, TEXT);
        top += LINE_PX;
    }
    let frames = frames_height(row, style);
    for (place, (caption, frame)) in row.cells.iter().enumerate() {
        let left = MARGIN_PX + place * column;
        draw_frame(canvas, frame, style, (left, top));
        let indent = (column - GAP_PX).saturating_sub(width_px(caption, LETTER_SCALE)) / 2;
        canvas.write(left + indent, top + frames + GAP_PX / 2, caption, TEXT);
    }
}

fn draw_frame(canvas: &mut Canvas, frame: &Frame, style: &Style, (left, top): (usize, usize)) {
    let width = frame.width() as usize * style.scale;
    let lines: Vec<usize> = (1..=style.grid_lines)
        .map(|line| line * width / (style.grid_lines + 1))
        .collect();
    let pixels = enlarged_pixels(frame, style.scale);
    for (y, row) in pixels.chunks_exact(width).enumerate() {
        for (x, &value) in row.iter().enumerate() {
            let is_line = lines.contains(&x);
            canvas.set(left + x, top + y, if is_line { toward_contrast(value) } else { value });
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
    fn a_prediction_sheet_reads_from_the_inputs_down_to_the_error() {
        let flat = |value| Frame::new(64, 64, vec![value; 4096]).unwrap();
        let sheet = prediction_sheet(&vec![flat(10); 5], &vec![flat(100); 5], &vec![flat(90); 5]).unwrap();
        let left = MARGIN_PX + 5;
        let column: Vec<u8> = (0..sheet.height() as usize)
            .map(|y| sheet.pixels()[y * sheet.width() as usize + left])
            .collect();
        // Only cells are tall runs of one value.
        let cells: Vec<(u8, usize)> = column
            .chunk_by(u8::eq)
            .map(|run| (run[0], run.len()))
            .filter(|&(_, length)| length >= 256)
            .collect();
        assert_eq!(cells, [(10, 256), (90, 256), (100, 256), (30, 256)]);
    }

    #[test]
    fn long_sheets_are_wrapped_and_stay_within_the_bound() {
        let frames = vec![Frame::new(64, 64, vec![7; 4096]).unwrap(); 50];
        let sheet = prediction_sheet(&frames[..20], &frames, &frames).unwrap();
        assert!(
            sheet.width() <= foreframe_core::frame::MAX_SIDE_PX && sheet.height() <= foreframe_core::frame::MAX_SIDE_PX
        );
    }

    #[test]
    fn an_enlarged_frame_is_at_least_256_px_wide() {
        let frame = Frame::new(3, 2, vec![1, 2, 3, 4, 5, 6]).unwrap();
        let large = enlarged(&frame).unwrap();
        assert_eq!((large.width(), large.height()), (258, 172));
        assert_eq!(
            (large.pixels()[85], large.pixels()[86], large.pixels()[258 * 86]),
            (1, 2, 4)
        );
        assert_eq!(
            enlarged(&Frame::new(300, 1, vec![0; 300]).unwrap()).unwrap().width(),
            300
        );
    }

    #[test]
    fn captions_count_from_now() {
        let row = MontageRow::in_time("", &[frame(0), frame(0), frame(0)], -1);
        let captions: Vec<&str> = row.cells.iter().map(|(caption, _)| caption.as_str()).collect();
        assert_eq!(captions, ["t-1", "t", "t+1"]);
    }

    #[test]
    fn empty_and_oversized_sheets_are_refused() {
        let style = Style::for_frames_of(64);
        assert!(montage("title", &[], &style).is_err());
        let many: Vec<Frame> = (0..900).map(|_| frame(0)).collect();
        assert!(montage("", &[MontageRow::in_time("", &many, 0)], &style).is_err());
    }
}
