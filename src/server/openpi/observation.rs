//! An observation of openpi's client, and the step of a session that it becomes.

use serde::Deserialize;

use super::numpy::ReceivedArray;
use crate::server::images::{self, ImageFormat};
use crate::server::stream::step::{FrameStep, StepConditions, StepError};
use foreframe_core::frame::Frame;
use foreframe_core::frame::resize::Resize;
use foreframe_core::registry::Manifest;
use foreframe_core::serving::OBSERVATION_FIELDS;

/// What a client sends with `infer`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct OpenpiObservation {
    /// What to do; without it, predict.
    #[serde(default)]
    pub(super) endpoint: Endpoint,
    /// The model; another one than before begins a new context. Without it, the model stays.
    pub(super) model: Option<String>,
    /// Begins a new context with this frame.
    #[serde(default)]
    pub(super) reset: bool,
    /// `[height, width]`, `[height, width, 1]` (gray) or `[height, width, 3]` (red, green, blue), uint8.
    frame: Option<ReceivedArray>,
    /// How a frame of another size is resized; without it, another size is refused.
    resize: Option<Resize>,
    /// The robot's state at this frame.
    state: Option<ReceivedArray>,
    /// The action from this frame to the next.
    action: Option<ReceivedArray>,
    /// The future actions, `[steps, channels]`. Without them, `action` is repeated.
    actions: Option<ReceivedArray>,
    /// How many frames to predict. Default: the model's horizon.
    steps: Option<ReceivedArray>,
}

/// What a message asks for, in the words of other servers of openpi's protocol.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Endpoint {
    #[default]
    Infer,
    /// Begins a new context; needs no frame.
    Reset,
}

impl OpenpiObservation {
    /// The step of number `seq`. Errors name the key.
    pub(super) fn into_step(self, seq: u64, manifest: &Manifest, max_steps: usize) -> Result<FrameStep, StepError> {
        let conditions = StepConditions {
            action: self.action.map(|array| vector("action", array)).transpose()?,
            plan: self.actions.map(|array| rows("actions", array)).transpose()?,
            state: self.state.map(|array| vector("state", array)).transpose()?,
            steps: self.steps.map(|number| whole("steps", number)).transpose()?,
        };
        let frame = self.frame.ok_or_else(|| {
            let reason = "frame is missing; it is an array uint8 [height, width] or [height, width, 3]";
            StepError::Invalid(reason.to_owned())
        })?;
        Ok(FrameStep {
            seq,
            timestamp_us: 0,
            conditions: conditions.check(&OBSERVATION_FIELDS, manifest, max_steps)?,
            frame: images::resized("frame", image(frame)?, self.resize, manifest)?,
            format: ImageFormat::Raw,
            is_overtaken: false,
        })
    }
}

fn wrong(key: &str, reason: &str) -> StepError {
    StepError::Invalid(format!("{key} {reason}"))
}

/// A gray image.
fn image(array: ReceivedArray) -> Result<Frame, StepError> {
    let shape = array.shape.clone();
    let values = array.bytes().map_err(|reason| wrong("frame", &reason))?;
    Ok(images::from_array("frame", &shape, values)?)
}

/// A whole number from 0 on; of `NumPy` or not.
fn whole(key: &str, number: ReceivedArray) -> Result<usize, StepError> {
    let values = number.numbers().map_err(|reason| wrong(key, &reason))?;
    match values[..] {
        [value] if value >= 0.0 && value.fract() == 0.0 => Ok(value as usize),
        _ => Err(wrong(key, "must be one whole number")),
    }
}

/// The numbers of one row.
fn vector(key: &str, array: ReceivedArray) -> Result<Vec<f32>, StepError> {
    let rows = array.shape.iter().rev().skip(1);
    if rows.clone().any(|side| *side != 1) {
        let reason = format!("has the shape {:?}; it is one row of numbers", array.shape);
        return Err(wrong(key, &reason));
    }
    array.numbers().map_err(|reason| wrong(key, &reason))
}

/// The numbers of each row.
fn rows(key: &str, array: ReceivedArray) -> Result<Vec<Vec<f32>>, StepError> {
    let (shape, count) = (array.shape.clone(), array.shape.len());
    if count < 2 || shape[..count - 2].iter().any(|side| *side != 1) {
        return Err(wrong(key, &format!("has the shape {shape:?}; it is [steps, channels]")));
    }
    let numbers = array.numbers().map_err(|reason| wrong(key, &reason))?;
    let length = shape[count - 1].max(1);
    Ok(numbers.chunks(length).map(<[f32]>::to_vec).collect())
}
