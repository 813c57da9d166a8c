//! Checks that every data set must pass: matching lengths, finite numbers, increasing timestamps.

use super::{DatasetError, DatasetInfo, EpisodeData};
use foreframe_core::frame::MAX_SIDE_PX;
use foreframe_core::frame::warp::CameraModel;

/// Errors: `Invalid`.
pub(super) fn check_description(info: &DatasetInfo) -> Result<(), DatasetError> {
    let sides = 1..=MAX_SIDE_PX;
    let wrong = if !sides.contains(&info.frame_width_px) || !sides.contains(&info.frame_height_px) {
        format!(
            "frames of {}×{} px are out of range; each side must be 1 to {MAX_SIDE_PX} px",
            info.frame_width_px, info.frame_height_px
        )
    } else if !(info.frame_period_s.is_finite() && info.frame_period_s > 0.0) {
        format!(
            "the frame period is {} s; it must be a finite number above 0",
            info.frame_period_s
        )
    } else if let Some(Err(error)) = info.camera.as_ref().map(CameraModel::validate) {
        error.to_string()
    } else {
        return Ok(());
    };
    Err(DatasetError::Invalid(wrong))
}

/// Checks counts, each with its name, that must be at least 1. Errors: `Usage`.
pub(super) fn check_counts(counts: &[(&str, u64)]) -> Result<(), DatasetError> {
    match counts.iter().find(|(_, count)| *count == 0) {
        Some((what, _)) => Err(DatasetError::Usage(format!("{what} is 0; it must be at least 1"))),
        None => Ok(()),
    }
}

/// Errors: `Invalid`, `TimeOrder`.
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
        let expected = frames * size;
        if found != expected {
            return Err(DatasetError::Invalid(format!(
                "episode {episode}: {part} has {found} values; {frames} frames need {expected}"
            )));
        }
    }
    check_numbers(info, episode, &data.actions, &data.states, &data.timestamps_s)
}

/// Checks the numbers of an episode's frames. Errors: `Invalid`, `TimeOrder`.
pub(super) fn check_numbers(
    info: &DatasetInfo,
    episode: usize,
    actions: &[f32],
    states: &[f32],
    timestamps_s: &[f64],
) -> Result<(), DatasetError> {
    let not_finite = |part: &str, frame: usize, value: f64| {
        Err(DatasetError::Invalid(format!(
            "episode {episode}, frame {frame}: {part} is {value}; every number must be finite"
        )))
    };
    for (part, values, size) in [
        ("action", actions, info.action_channels.len()),
        ("state", states, info.state_channels.len()),
    ] {
        if let Some(index) = values.iter().position(|value| !value.is_finite()) {
            return not_finite(part, index / size, f64::from(values[index]));
        }
    }
    if let Some(frame) = timestamps_s.iter().position(|time| !time.is_finite()) {
        return not_finite("timestamp", frame, timestamps_s[frame]);
    }
    match timestamps_s.windows(2).position(|pair| pair[1] <= pair[0]) {
        Some(previous) => Err(DatasetError::TimeOrder {
            episode,
            frame: previous + 1,
        }),
        None => Ok(()),
    }
}
