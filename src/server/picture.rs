//! A prediction in motion, for a person.

use crate::evaluation::figures::montage::{Row, Style, montage};
use crate::frame::{Frame, FrameError, codec};

/// How long an animation rests on its last frame, in frame periods.
const REST_PERIODS: usize = 4;

/// The frames seen, then those predicted, each with its time from t on, one frame period apart, as a GIF.
/// Errors: `Size` if the frames are too large.
pub(super) fn animation(seen: &[Frame], predicted: &[Frame], period_s: f64) -> Result<Vec<u8>, FrameError> {
    let rows = [
        Row::in_time("", seen, 1 - seen.len() as i64),
        Row::in_time("", predicted, 1),
    ];
    let picture = |cell: (String, Frame)| {
        let style = Style {
            grid_lines: 0,
            ..Style::for_frames_of(cell.1.width())
        };
        let row = Row {
            label: String::new(),
            cells: vec![cell],
        };
        montage("", &[row], &style)
    };
    let cells = rows.into_iter().flat_map(|row| row.cells);
    let mut frames = cells.map(picture).collect::<Result<Vec<Frame>, FrameError>>()?;
    let last = frames.last().cloned();
    frames.extend(last.into_iter().flat_map(|last| vec![last; REST_PERIODS]));
    codec::encode_gif(&frames, (period_s * 1000.0).clamp(20.0, 10_000.0) as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_animation_is_a_gif() {
        let flat = |value| Frame::new(64, 64, vec![value; 4096]).unwrap();
        assert!(animation(&[flat(1)], &[flat(2)], 0.2).unwrap().starts_with(b"GIF89a"));
    }
}
