//! Predictions as pictures, for people.

use axum::http::header;
use axum::response::{IntoResponse, Response};

use crate::server::blocking::BlockingWork;
use crate::server::http::extract::ResponseFormat;
use crate::server::http::problem::ApiError;
use crate::server::state::App;
use foreframe_core::error_text::with_causes;
use foreframe_core::frame::{Frame, FrameError, codec};
use foreframe_train::evaluation::figures::montage::{MontageRow, Style, montage};

/// How long an animation stays on its last frame, in frame periods.
const REST_PERIODS: usize = 4;

/// A picture that could not be made.
#[derive(Debug, thiserror::Error)]
#[error("could not make the picture")]
pub(in crate::server) struct PictureError(#[from] FrameError);

impl From<PictureError> for ApiError {
    fn from(error: PictureError) -> Self {
        match &error.0 {
            FrameError::Size { .. } => {
                Self::NotAcceptable("the picture would be too large; ask for application/json".to_owned())
            }
            _ => Self::Internal(with_causes(&error)),
        }
    }
}

/// The threads that write predictions in that format.
pub(super) fn threads_for(app: &App, format: ResponseFormat) -> &BlockingWork {
    match format {
        ResponseFormat::Json => app.predictions(),
        ResponseFormat::Png | ResponseFormat::Gif => app.render_cache().threads(),
    }
}

/// A copy of the context for an answer in that format: empty if the answer does not show it.
pub(super) fn context_for(format: ResponseFormat, context: &[Frame]) -> Vec<Frame> {
    match format {
        ResponseFormat::Json => Vec::new(),
        ResponseFormat::Png | ResponseFormat::Gif => context.to_vec(),
    }
}

/// The response with a PNG picture.
pub(super) fn png(picture: Result<Frame, FrameError>) -> Result<Response, PictureError> {
    let bytes = png_file(picture)?;
    Ok(([(header::CONTENT_TYPE, "image/png")], bytes).into_response())
}

/// The picture as PNG.
pub(super) fn png_file(picture: Result<Frame, FrameError>) -> Result<Vec<u8>, PictureError> {
    Ok(picture.and_then(|picture| codec::encode_png(&picture))?)
}

/// The response with a GIF animation.
pub(super) fn gif(bytes: Result<Vec<u8>, FrameError>) -> Result<Response, PictureError> {
    Ok(([(header::CONTENT_TYPE, "image/gif")], bytes?).into_response())
}

/// The context, if it is known, and a row for each rollout; small and without labels if there are many.
/// Errors: `Size` if there are too many.
pub(super) fn rollout_sheet(seen: &[Frame], rollouts: &[impl AsRef<[Frame]>]) -> Result<Frame, FrameError> {
    let inputs = MontageRow::in_time("inputs", seen, 1 - seen.len() as i64);
    let rows = rollouts
        .iter()
        .enumerate()
        .map(|(index, frames)| MontageRow::in_time(&format!("plan {index}"), frames.as_ref(), 1));
    let mut rows: Vec<MontageRow> = Some(inputs)
        .filter(|_| !seen.is_empty())
        .into_iter()
        .chain(rows)
        .collect();
    let large = montage("", &rows, &style(rollouts));
    if !matches!(large, Err(FrameError::Size { .. })) {
        return large;
    }
    for row in &mut rows {
        row.label.clear();
        row.cells.iter_mut().for_each(|(caption, _)| caption.clear());
    }
    montage("", &rows, &SMALL)
}

/// All rollouts side by side, from the last context frame on if it is known. Errors: `Size` if there are too many.
pub(super) fn rollout_animation(
    seen: &[Frame],
    rollouts: &[impl AsRef<[Frame]>],
    period_s: f64,
) -> Result<Vec<u8>, FrameError> {
    let columns = (rollouts.len() as f64).sqrt().ceil().max(1.0) as usize;
    let steps = rollouts.iter().map(|frames| frames.as_ref().len()).max().unwrap_or(0);
    let grid = |cells: Vec<(String, Frame)>| {
        let rows = cells.chunks(columns).map(|cells| MontageRow {
            label: String::new(),
            cells: cells.to_vec(),
        });
        let rows: Vec<MontageRow> = rows.collect();
        montage("", &rows, &style(rollouts)).or_else(|_| montage("", &rows, &SMALL))
    };
    let named = |(index, frame): (usize, &Frame)| (index.to_string(), frame.clone());
    let first = seen
        .last()
        .map(|last| rollouts.iter().map(|_| last).enumerate().map(named).collect());
    let later = (0..steps).map(|step| {
        rollouts
            .iter()
            .filter_map(|future| future.as_ref().get(step))
            .enumerate()
            .map(named)
            .collect()
    });
    film(
        first
            .into_iter()
            .chain(later)
            .map(grid)
            .collect::<Result<_, FrameError>>()?,
        period_s,
    )
}

const SMALL: Style = Style {
    scale: 1,
    grid_lines: 0,
};

fn style(rollouts: &[impl AsRef<[Frame]>]) -> Style {
    let width = rollouts.iter().flat_map(AsRef::as_ref).next().map_or(1, Frame::width);
    Style {
        grid_lines: 0,
        ..Style::for_frames_of(width)
    }
}

/// The context, then the predicted frames, one frame period apart, as a GIF.
/// Errors: `Size` if the frames are too large.
pub(super) fn animation(seen: &[Frame], predicted: &[Frame], period_s: f64) -> Result<Vec<u8>, FrameError> {
    let rows = [
        MontageRow::in_time("", seen, 1 - seen.len() as i64),
        MontageRow::in_time("", predicted, 1),
    ];
    let picture = |cell: (String, Frame)| {
        let style = Style {
            grid_lines: 0,
            ..Style::for_frames_of(cell.1.width())
        };
        let row = MontageRow {
            label: String::new(),
            cells: vec![cell],
        };
        montage("", &[row], &style)
    };
    let cells = rows.into_iter().flat_map(|row| row.cells);
    film(cells.map(picture).collect::<Result<_, FrameError>>()?, period_s)
}

fn film(mut frames: Vec<Frame>, period_s: f64) -> Result<Vec<u8>, FrameError> {
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
        let film = rollout_animation(&[], &vec![vec![flat(1), flat(2)]; 5], 0.2).unwrap();
        assert!(film.starts_with(b"GIF89a"));
    }

    #[test]
    fn many_rollouts_are_drawn_small_and_too_many_refused() {
        let rollouts = |count| vec![vec![Frame::new(64, 64, vec![9; 4096]).unwrap(); 2]; count];
        let (few, many) = (
            rollout_sheet(&[], &rollouts(2)).unwrap(),
            rollout_sheet(&[], &rollouts(40)).unwrap(),
        );
        assert!(few.width() > 2 * 192 && many.width() < 2 * 192);
        assert!(matches!(
            rollout_sheet(&[], &rollouts(400)),
            Err(FrameError::Size { .. })
        ));
    }
}
