//! What requests give to predictions, checked.

use super::config::ServerConfig;
use super::http::multipart::check_count;
use super::http::problem::{ApiError, unfit};
use super::images::{self, ImageBytes, ImageError, ImageInput};
use foreframe_core::frame::Frame;
use foreframe_core::registry::Manifest;
use foreframe_core::types::{Action, RobotState};

/// Errors: `Unprocessable` if a request asks for more than this server predicts.
pub(in crate::server) fn check_steps(
    steps: Option<usize>,
    manifest: &Manifest,
    config: &ServerConfig,
) -> Result<(), ApiError> {
    refused_steps(steps, manifest, config.max_steps).map_or(Ok(()), |reason| Err(ApiError::Unprocessable(reason)))
}

/// Why so many steps are not predicted, if they are not. The model's own horizon always is.
pub(in crate::server) fn refused_steps(steps: Option<usize>, manifest: &Manifest, max_steps: usize) -> Option<String> {
    let limit = max_steps.max(manifest.spec.horizon);
    let found = steps.filter(|steps| !(1..=limit).contains(steps))?;
    Some(format!("steps is {found}; this server predicts 1 to {limit}"))
}

/// The images of `frames` in a request as frames of the model's size.
pub(in crate::server) fn decode_frames(
    frames: Vec<ImageBytes>,
    input: ImageInput,
    manifest: &Manifest,
    limit: usize,
) -> Result<Vec<Frame>, ApiError> {
    check_count("frames", frames.len(), limit)?;
    let frame = |(index, image)| images::decode(&format!("frames[{index}]"), image, input, manifest);
    let frames: Result<_, ImageError> = frames.into_iter().enumerate().map(frame).collect();
    Ok(frames?)
}

/// The states at the earlier frames, if they are given, and that at the last one, from `state` or `states` of a request.
pub(in crate::server) fn states(
    state: Option<Vec<f32>>,
    states: Option<Vec<Vec<f32>>>,
    frames: usize,
) -> Result<(Vec<RobotState>, Option<RobotState>), ApiError> {
    let (past, last) = match (state, states) {
        (_, Some(states)) if states.len() != frames => {
            return Err(ApiError::Unprocessable(format!(
                "states holds {} states; there are {frames} frames, and each has one",
                states.len()
            )));
        }
        (Some(_), Some(_)) => {
            return Err(ApiError::Unprocessable(
                "state and states are both given; give one".to_owned(),
            ));
        }
        (None, Some(mut states)) => {
            let last = states.pop();
            (states, last)
        }
        (state, None) => (Vec::new(), state),
    };
    let state = |values| RobotState::try_from(values).map_err(unfit("state"));
    let past = past.into_iter().map(state).collect::<Result<_, _>>()?;
    Ok((past, last.map(state).transpose()?))
}

/// The actions in `field` of a request.
pub(in crate::server) fn actions(field: &str, values: Vec<Vec<f32>>) -> Result<Vec<Action>, ApiError> {
    let action = |(index, values)| Action::try_from(values).map_err(unfit(&format!("{field}[{index}]")));
    values.into_iter().enumerate().map(action).collect()
}
