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

/// The threads that write predictions in that format.
pub(super) fn threads_for(app: &App, format: ResponseFormat) -> &BlockingWork {
    match format {
        ResponseFormat::Json | ResponseFormat::Msgpack => &app.predictions,
        ResponseFormat::Png | ResponseFormat::Gif => app.render_cache.threads(),
    }
}

/// A copy of the context for an answer in that format: empty if the answer does not show it.
pub(super) fn context_for(format: ResponseFormat, context: &[Frame]) -> Vec<Frame> {
    match format {
        ResponseFormat::Json | ResponseFormat::Msgpack => Vec::new(),
        ResponseFormat::Png | ResponseFormat::Gif => context.to_vec(),
    }
}

/// The response with a PNG picture.
pub(super) fn png(picture: Result<Frame, FrameError>) -> Result<Response, ApiError> {
    let bytes = png_file(picture)?;
    Ok(([(header::CONTENT_TYPE, "image/png")], bytes).into_response())
}

/// The picture as PNG.
pub(super) fn png_file(picture: Result<Frame, FrameError>) -> Result<Vec<u8>, ApiError> {
    picture
        .and_then(|picture| codec::encode_png(&picture))
        .map_err(not_drawn)
}

/// The response with a GIF animation.
pub(super) fn gif(bytes: Result<Vec<u8>, FrameError>) -> Result<Response, ApiError> {
    let bytes = bytes.map_err(not_drawn)?;
    Ok(([(header::CONTENT_TYPE, "image/gif")], bytes).into_response())
}

/// The answer if a picture could not be made.
pub(super) fn not_drawn(error: FrameError) -> ApiError {
    match error {
        FrameError::Size { .. } => {
            ApiError::NotAcceptable("the picture would be too large; ask for application/json".to_owned())
        }
        other => ApiError::Internal(format!("could not make the picture: {}", with_causes(&other))),
    }
}

/// The context, if it is known, and a row for each rollout; small and without labels if there are many.
/// Errors: `Size` if there are too many.
pub(super) fn rollout_sheet(seen: &[Frame], rollouts: &[impl AsRef<[Frame]>]) -> Result<Frame, FrameError> {
    let inputs = (!seen.is_empty()).then(|| MontageRow::in_time("inputs", seen, 1 - seen.len() as i64));
    let plans = rollouts
        .iter()
        .enumerate()
        .map(|(index, frames)| MontageRow::in_time(&format!("plan {index}"), frames.as_ref(), 1));
    let mut rows: Vec<MontageRow> = inputs.into_iter().chain(plans).collect();
    let large = montage("", &rows, &large(rollouts));
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
    let grid = |frames: Vec<&Frame>| {
        let cells = (0..)
            .zip(frames)
            .map(|(index, frame): (usize, _)| (index.to_string(), frame.clone()));
        let cells: Vec<(String, Frame)> = cells.collect();
        let rows: Vec<MontageRow> = cells.chunks(columns).map(unlabelled).collect();
        montage("", &rows, &large(rollouts)).or_else(|_| montage("", &rows, &SMALL))
    };
    let first = seen.last().map(|last| vec![last; rollouts.len()]);
    let at = |step| rollouts.iter().filter_map(move |frames| frames.as_ref().get(step));
    let later = (0..steps).map(|step| at(step).collect());
    film(first.into_iter().chain(later).map(grid), period_s)
}

/// A row without a heading.
pub(super) fn unlabelled(cells: &[(String, Frame)]) -> MontageRow {
    MontageRow {
        label: String::new(),
        cells: cells.to_vec(),
    }
}

const SMALL: Style = Style {
    scale: 1,
    grid_lines: 0,
};

/// Enlarges the frames of these rollouts.
fn large(rollouts: &[impl AsRef<[Frame]>]) -> Style {
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
    let style = large(&[seen, predicted]);
    let cells = rows.iter().flat_map(|row| row.cells.chunks(1));
    film(cells.map(|cell| montage("", &[unlabelled(cell)], &style)), period_s)
}

fn film(frames: impl Iterator<Item = Result<Frame, FrameError>>, period_s: f64) -> Result<Vec<u8>, FrameError> {
    let mut frames: Vec<Frame> = frames.collect::<Result<_, _>>()?;
    let last = frames.last().cloned();
    frames.extend(last.into_iter().flat_map(|last| vec![last; REST_PERIODS]));
    codec::encode_gif(&frames, period_s)
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
