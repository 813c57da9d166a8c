//! Checks that every data set must pass: matching lengths, finite numbers, increasing timestamps.

use super::{DatasetError, DatasetInfo, EpisodeData};
use foreframe_core::frame::MAX_SIDE_PX;
use foreframe_core::frame::warp::CameraModel;

/// Errors: `Description`.
pub(super) fn check_description(info: &DatasetInfo) -> Result<(), DatasetError> {
    let sides = 1..=MAX_SIDE_PX;
    if !sides.contains(&info.frame_width_px) || !sides.contains(&info.frame_height_px) {
        return Err(DatasetError::Description(format!(
            "frames of {}×{} px are out of range; each side must be 1 to {MAX_SIDE_PX} px",
            info.frame_width_px, info.frame_height_px
        )));
    }
    if !(info.frame_period_s.is_finite() && info.frame_period_s > 0.0) {
        return Err(DatasetError::Description(format!(
            "the frame period is {} s; it must be a finite number above 0",
            info.frame_period_s
        )));
    }
    if let Some(Err(error)) = info.camera.as_ref().map(CameraModel::validate) {
        return Err(DatasetError::Description(error.to_string()));
    }
    Ok(())
}

/// Errors: `PartLength`, `NotFinite`, `TimeOrder`.
pub(super) fn check_episode(info: &DatasetInfo, episode: usize, data: &EpisodeData) -> Result<(), DatasetError> {
    let frames = data.timestamps_s.len();
    let pixels = info.frame_pixels();
    let mask_count = data.masks.as_ref().map_or(frames * pixels, Vec::len);
    for (part, found, size) in [
        ("pixels", data.pixels.len(), pixels),
        ("mask", mask_count, pixels),
        ("action", data.actions.len(), info.action_channels.len()),
        ("state", data.states.len(), info.state_channels.len()),
    ] {
        if found != frames * size {
            return Err(DatasetError::PartLength {
                episode,
                part,
                frames,
                found,
                expected: frames * size,
            });
        }
    }
    let numbers = Numbers {
        actions: &data.actions,
        states: &data.states,
        timestamps_s: &data.timestamps_s,
    };
    check_numbers(info, episode, &numbers)
}

/// The numbers of one episode's frames.
pub(super) struct Numbers<'a> {
    pub(super) actions: &'a [f32],
    pub(super) states: &'a [f32],
    pub(super) timestamps_s: &'a [f64],
}

/// Errors: `NotFinite`, `TimeOrder`.
pub(super) fn check_numbers(info: &DatasetInfo, episode: usize, numbers: &Numbers<'_>) -> Result<(), DatasetError> {
    check_finite(episode, "action", numbers.actions, info.action_channels.len())?;
    check_finite(episode, "state", numbers.states, info.state_channels.len())?;
    check_time(episode, numbers.timestamps_s)
}

fn check_finite(episode: usize, part: &'static str, values: &[f32], size: usize) -> Result<(), DatasetError> {
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(DatasetError::NotFinite {
            episode,
            frame: index / size,
            part,
            value: f64::from(values[index]),
        }),
        None => Ok(()),
    }
}

fn check_time(episode: usize, timestamps_s: &[f64]) -> Result<(), DatasetError> {
    if let Some(frame) = timestamps_s.iter().position(|time| !time.is_finite()) {
        return Err(DatasetError::NotFinite {
            episode,
            frame,
            part: "timestamp",
            value: timestamps_s[frame],
        });
    }
    match timestamps_s.windows(2).position(|pair| pair[1] <= pair[0]) {
        Some(previous) => Err(DatasetError::TimeOrder {
            episode,
            frame: previous + 1,
        }),
        None => Ok(()),
    }
}
