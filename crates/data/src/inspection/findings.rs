//! Everything that an inspection finds.

use serde::Serialize;

use super::channels::{self, ChannelSummary};
use super::delays::{self, ActionDelay};
use super::images::{self, ImageSummary};
use super::places::{FramePlace, places};
use super::timing::{self, FrameTiming};
use crate::dataset::{Dataset, DatasetError};

/// Pictures of the contact sheet.
const CONTACT_FRAMES: usize = 24;

/// What was found in a data set.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Inspection {
    /// The data set's name.
    pub name: String,
    /// SHA-256 of its content, in hexadecimal.
    pub content_hash: String,
    /// The simulated scenario; none for recordings.
    pub scenario: Option<String>,
    /// Width of every frame in pixels.
    pub frame_width_px: u32,
    /// Height of every frame in pixels.
    pub frame_height_px: u32,
    /// Number of frames.
    pub frame_count: usize,
    /// Number of episodes.
    pub episode_count: usize,
    /// Lengths and times.
    pub timing: FrameTiming,
    /// Every component of the action, then of the state.
    pub channels: Vec<ChannelSummary>,
    /// One for each component of the action.
    pub delays: Vec<ActionDelay>,
    /// Brightness, repeated frames, exposure.
    pub images: ImageSummary,
    /// Frames spread evenly over the data set.
    pub contact_sheet: Vec<FramePlace>,
    /// What is wrong and what to do about it, a few sentences each.
    pub warnings: Vec<String>,
}

/// Looks through a whole data set, on all threads of the current pool. It keeps some tens of bytes of each frame, not its
/// pixels. Errors: those of [`Dataset::pixels`].
pub fn inspect(dataset: &Dataset) -> Result<Inspection, DatasetError> {
    let info = dataset.info();
    let timing = timing::of(dataset);
    let channels = channels::of(dataset);
    let delays = delays::of(dataset)?;
    let images = images::of(dataset)?;
    let warnings = [
        timing.warnings(),
        images.warnings(&timing),
        channels::warnings(&channels),
        delays::warnings(&delays, timing.frame_period_s),
    ];
    Ok(Inspection {
        name: info.name.clone(),
        content_hash: info.content_hash.clone(),
        scenario: info.scenario.clone(),
        frame_width_px: info.frame_width_px,
        frame_height_px: info.frame_height_px,
        frame_count: info.frame_count,
        episode_count: info.episode_count,
        timing,
        channels,
        delays,
        images,
        contact_sheet: contact_sheet(dataset),
        warnings: warnings.concat(),
    })
}

fn contact_sheet(dataset: &Dataset) -> Vec<FramePlace> {
    let places: Vec<FramePlace> = places(dataset).collect();
    let count = CONTACT_FRAMES.min(places.len());
    // The middles of equal parts.
    let chosen = (0..count).map(|index| (2 * index + 1) * places.len() / (2 * count));
    chosen.map(|frame| places[frame]).collect()
}
