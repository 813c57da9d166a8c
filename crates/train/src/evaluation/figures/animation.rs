//! Frames as an endless GIF.

use super::montage::enlarged;
use foreframe_core::frame::{Frame, FrameError, codec};

/// Frames as an endless GIF, enlarged to at least [`super::montage::CELL_WIDTH_PX`]. Errors: `Size` if a frame gets too
/// large.
pub fn enlarged_gif(frames: &[Frame], period_s: f64) -> Result<Vec<u8>, FrameError> {
    let frames: Vec<Frame> = frames.iter().map(enlarged).collect::<Result<_, FrameError>>()?;
    codec::encode_gif(&frames, period_s)
}
