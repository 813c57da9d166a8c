//! The bodies of vLLM-Omni's sessions. As there, unknown fields are ignored: they are meant for other models.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::server::images::{self, ImageBytes, ImageFormat};
use crate::server::nested_numbers::NestedNumbers;
use crate::server::stream::protocol::ServerMessage;
use crate::server::stream::step::{FrameStep, StepConditions, StepError};
use crate::server::world_session::WorldSession;
use foreframe_core::frame::resize::Resize;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::Manifest;
use foreframe_core::serving::STEP_FIELDS;

/// The session to open.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
pub(super) struct NewWorldSession {
    /// The model's name.
    pub(super) model: String,
    /// What the model is used as.
    #[serde(default)]
    pub(super) mode: WorldMode,
}

/// What a model is used as: an environment.
#[derive(Clone, Copy, Debug, Default, Deserialize, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum WorldMode {
    /// An observation and an action give the next observation.
    #[default]
    WorldModelEnv,
}

/// An opened session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct OpenedWorldSession {
    /// Its id.
    pub(super) session_id: String,
    /// As asked for.
    pub(super) mode: WorldMode,
    /// When it was opened, in seconds since 1970.
    pub(super) created_at: f64,
}

/// A step.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
pub(super) struct WorldStepRequest {
    /// Counts from 0. Only the next number is taken, so that a repeated request changes nothing.
    pub(super) step_id: u64,
    /// The observation now.
    observation: WorldObservation,
    /// The action from this observation to the next.
    action: WorldAction,
    /// Must be true: without a context, there is no prediction.
    #[serde(default = "yes")]
    pub(super) use_session_context: bool,
}

fn yes() -> bool {
    true
}

/// An observation.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
struct WorldObservation {
    /// One image by the name of its camera: rows of whole numbers from 0 to 255, or of lists with 1 or 3 channels (red, green,
    /// blue).
    #[schema(value_type = Option<BTreeMap<String, Vec<Vec<f32>>>>)]
    images: Option<BTreeMap<String, NestedNumbers>>,
    /// The robot's state, in the model's order and units.
    state: Option<Vec<f32>>,
    /// More fields.
    #[serde(default)]
    extra: ObservationExtra,
}

/// Fields of an observation that only this server knows.
#[derive(Debug, Default, Deserialize, utoipa::ToSchema)]
struct ObservationExtra {
    /// How an image of another size is resized; without it, another size is refused.
    resize: Option<Resize>,
}

/// An action.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
struct WorldAction {
    /// In the model's order and units.
    joint_positions: Option<Vec<f32>>,
    /// Follows `joint_positions`.
    #[schema(value_type = Option<f32>)]
    gripper_position: Option<NestedNumbers>,
    /// More fields.
    #[serde(default)]
    extra: ActionExtra,
}

/// Fields of an action that only this server knows.
#[derive(Debug, Default, Deserialize, utoipa::ToSchema)]
struct ActionExtra {
    /// The future actions, the first from this observation on. Without them, the action is repeated.
    plan: Option<Vec<Vec<f32>>>,
    /// How many observations to predict. Default: the model's horizon.
    #[schema(minimum = 1, maximum = 256)]
    steps: Option<usize>,
}

/// The number of the last step; -1 if there is none.
pub(super) fn committed(next_step: u64) -> i64 {
    i64::try_from(next_step).unwrap_or(i64::MAX) - 1
}

impl WorldStepRequest {
    /// The step of the session. Errors name the field.
    pub(super) fn into_step(self, manifest: &Manifest, max_steps: usize) -> Result<FrameStep, StepError> {
        let Self {
            observation, action, ..
        } = self;
        let gripper = action
            .gripper_position
            .map(|gripper| gripper.values)
            .unwrap_or_default();
        let has_action = action.joint_positions.is_some() || !gripper.is_empty();
        let joints = action.joint_positions.unwrap_or_default();
        let conditions = StepConditions {
            action: has_action.then(|| [joints, gripper].concat()),
            plan: action.extra.plan,
            state: observation.state,
            steps: action.extra.steps,
        };
        let mut images = observation.images.unwrap_or_default().into_iter();
        let (Some((camera, image)), None) = (images.next(), images.next()) else {
            let reason = "observation.images must hold one image, the model has one camera";
            return Err(StepError::Invalid(reason.to_owned()));
        };
        let field = format!("observation.images.{}", camera.escape_default());
        let shape = image.shape;
        let pixels =
            NestedNumbers::bytes(image.values).map_err(|reason| StepError::Invalid(format!("{field} {reason}")))?;
        let frame = images::from_array(&field, &shape, pixels)?;
        Ok(FrameStep {
            seq: self.step_id,
            timestamp_us: 0,
            conditions: conditions.check(&STEP_FIELDS, manifest, max_steps)?,
            frame: images::resized(&field, frame, observation.extra.resize, manifest)?,
            format: ImageFormat::Raw,
            is_overtaken: false,
        })
    }
}

/// The answer to a step.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct WorldStepAnswer {
    /// As in the request.
    step_id: u64,
    /// The predicted observations; null while the context is not full.
    next_observation: Option<NextObservation>,
    /// About the step and its session.
    model_metadata: WorldStepMetadata,
    /// Why there is no step; null if there is one.
    error: Option<StepRefusal>,
}

/// The observations that follow.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct NextObservation {
    /// The frames t+1, t+2, …: gray bytes, row by row, base64.
    video: ImageBytes,
    /// Frames, height and width.
    shape: [usize; 3],
    /// The type of a value of `video`.
    dtype: &'static str,
    /// How `video` is encoded.
    encoding: &'static str,
    /// The mean squared error to expect of each frame up to the model's horizon, which follows the session's own errors so far;
    /// absent if the model is not calibrated.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    expected_mse: Vec<f32>,
    /// The 90 % band of each of these errors, which follows the session's own errors too; absent if the model is not calibrated.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    mse_band_90: Vec<[f32; 2]>,
    /// How unlike the training data frames, state and actions are, 0…1; absent if the model is not calibrated.
    #[serde(skip_serializing_if = "Option::is_none")]
    novelty: Option<f32>,
    /// For each frame, whether it is beyond what the model was trained for; absent if none is.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    beyond_training: Vec<bool>,
    /// Actions and states out of the range of the training; absent if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    warnings: Vec<String>,
}

impl NextObservation {
    /// `None` if the message is no prediction.
    pub(super) fn of(message: ServerMessage, spec: &ModelSpec) -> Option<Self> {
        let ServerMessage::Prediction {
            frames,
            expected_mse,
            mse_band_90,
            novelty,
            beyond_training,
            warnings,
            ..
        } = message
        else {
            return None;
        };
        Some(Self {
            shape: [
                frames.len(),
                spec.frame_height_px as usize,
                spec.frame_width_px as usize,
            ],
            video: ImageBytes(frames.into_iter().flat_map(|frame| frame.0).collect()),
            dtype: "uint8",
            encoding: "base64_raw_tensor",
            expected_mse,
            mse_band_90,
            novelty,
            beyond_training,
            warnings,
        })
    }
}

/// About a step and its session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct WorldStepMetadata {
    /// Time of the step on the server.
    latency_ms: f64,
    /// How many observations were predicted.
    steps_generated: usize,
    /// How many observations the session has taken.
    context_length: u64,
    /// The last step that was taken; -1 if there is none.
    committed_step_id: i64,
    /// Not measured: null.
    session_memory_bytes: Option<u64>,
    /// The upper end of the 90 % band of the next observation's mean squared error, intensities 0…1: 5 % of the errors are above
    /// it. Null if the model is not calibrated.
    uncertainty: Option<f32>,
}

impl WorldStepMetadata {
    pub(super) fn new(latency: Duration, next_step: u64, observation: Option<&NextObservation>) -> Self {
        Self {
            latency_ms: latency.as_secs_f64() * 1e3,
            steps_generated: observation.map_or(0, |observation| observation.shape[0]),
            context_length: next_step,
            committed_step_id: committed(next_step),
            session_memory_bytes: None,
            uncertainty: observation
                .and_then(|observation| observation.mse_band_90.first())
                .map(|band| band[1]),
        }
    }
}

impl WorldStepAnswer {
    pub(super) fn new(
        step_id: u64,
        next_observation: Option<NextObservation>,
        model_metadata: WorldStepMetadata,
    ) -> Self {
        Self {
            step_id,
            next_observation,
            model_metadata,
            error: None,
        }
    }

    pub(super) fn refused(step_id: u64, next_step: u64, refusal: StepRefusal) -> Self {
        Self {
            error: Some(StepRefusal {
                step_id: Some(step_id),
                committed_step_id: committed(next_step),
                ..refusal
            }),
            ..Self::new(step_id, None, WorldStepMetadata::new(Duration::ZERO, next_step, None))
        }
    }
}

/// Why a step was refused.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct StepRefusal {
    /// `session_not_found`, `session_closed`, `invalid_request`, `step_already_committed`, `step_out_of_order` or
    /// `inference_error`.
    code: &'static str,
    /// What was wrong, and what would be right.
    message: String,
    /// As in the request.
    step_id: Option<u64>,
    /// The last step that was taken; -1 if there is none.
    committed_step_id: i64,
}

impl StepRefusal {
    pub(super) fn new(code: &'static str, message: String) -> Self {
        Self {
            code,
            message,
            step_id: None,
            committed_step_id: -1,
        }
    }
}

/// A session that begins again.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct ResetSession {
    /// Its id.
    pub(super) session_id: String,
    /// -1: no step was taken.
    pub(super) committed_step_id: i64,
}

/// A closed session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct ClosedSession {
    /// Its id.
    pub(super) session_id: String,
    /// True.
    pub(super) closed: bool,
}

/// The state of a session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct WorldSessionStatus {
    /// Its id.
    pub(super) session_id: String,
    /// The last step that was taken; -1 if there is none.
    pub(super) committed_step_id: i64,
    /// How many observations the session has taken.
    pub(super) context_length: u64,
    /// Whether it is closed.
    pub(super) closed: bool,
}

impl WorldSessionStatus {
    pub(super) fn of(session: &WorldSession, session_id: String) -> Self {
        Self {
            session_id,
            committed_step_id: committed(session.next_step()),
            context_length: session.next_step(),
            closed: session.is_closed,
        }
    }
}
