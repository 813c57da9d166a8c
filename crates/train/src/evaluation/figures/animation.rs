//! Predictions over a whole trial, as an endless GIF.

use super::montage::{MontageRow, Style, enlarged, montage};
use foreframe_core::frame::{Frame, FrameError, codec};

/// Frames as an endless GIF, enlarged to at least [`super::montage::CELL_WIDTH_PX`]. Errors: `Size` if a frame gets too
/// large.
pub fn enlarged_gif(frames: &[Frame], delay_ms: u32) -> Result<Vec<u8>, FrameError> {
    let frames = frames
        .iter()
        .map(enlarged)
        .collect::<Result<Vec<Frame>, FrameError>>()?;
    codec::encode_gif(&frames, delay_ms)
}

/// One moment: three frames of the same time, `steps_ahead` after the last frame seen.
#[derive(Clone, Debug)]
pub struct AnimationFrame {
    /// The true frame.
    pub truth: Frame,
    /// What the model predicted.
    pub predicted: Frame,
    /// What a baseline predicted.
    pub copied: Frame,
}

/// Moments in their order.
#[derive(Clone, Debug)]
pub struct Animation {
    /// How far ahead of the last frame seen.
    pub steps_ahead: usize,
    /// Seconds from one moment to the next.
    pub period_s: f64,
    /// The baseline's name.
    pub baseline: &'static str,
    /// What is shown.
    pub moments: Vec<AnimationFrame>,
}

impl Animation {
    /// What it shows, in a phrase.
    #[must_use]
    pub fn caption(&self) -> String {
        format!(
            "The trial of the median window, {} frames ({:.1} s) ahead: truth, prediction, {}",
            self.steps_ahead,
            self.steps_ahead as f64 * self.period_s,
            self.baseline
        )
    }

    /// The animation as a GIF. Errors: `Size` if the frames are too large to be put side by side.
    pub fn encode(&self) -> Result<Vec<u8>, FrameError> {
        let frames = self.moments.iter().map(|moment| {
            let cell = |label: &str, frame: &Frame| (label.to_owned(), frame.clone());
            let row = MontageRow {
                label: String::new(),
                cells: vec![
                    cell("truth", &moment.truth),
                    cell("predicted", &moment.predicted),
                    cell("last seen", &moment.copied),
                ],
            };
            let style = Style {
                grid_lines: 0,
                ..Style::for_frames_of(moment.truth.width())
            };
            montage(&format!("{} frames ahead", self.steps_ahead), &[row], &style)
        });
        let frames = frames.collect::<Result<Vec<Frame>, FrameError>>()?;
        codec::encode_gif(&frames, (self.period_s * 1000.0).round().max(20.0) as u32)
    }
}
