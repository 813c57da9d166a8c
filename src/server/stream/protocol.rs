//! The messages of a stream, the same in both sub-protocols; [`codec`] reads and writes them. Knows no socket.
//! `openapi/asyncapi.yaml` is the contract, with an example of each message.

mod flat;

pub mod codec;

use serde::{Deserialize, Serialize};

use crate::server::config::ServerConfig;
use crate::server::images::{ImageBytes, ImageFormat};
use crate::server::plans::request::SessionPlanRequest;
use crate::server::plans::response::PlanResponse;
use foreframe_core::frame::resize::Resize;
use foreframe_core::nn::ModelSpec;

pub use codec::Codec;
pub use foreframe_core::serving::Timing;

/// What a client sends.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "type", rename_all = "snake_case", try_from = "flat::AnyMessage")]
pub enum ClientMessage {
    /// The next frame.
    Frame(FrameMessage),
    /// Changes settings of the session from here on.
    Configure(ConfigureMessage),
    /// Asks for a `pong`.
    Ping(PingMessage),
    /// Ends the stream; the session stays.
    Close(CloseMessage),
}

/// A frame with the robot's action and state at that time.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct FrameMessage {
    /// Sequence number, from 0. A number that was answered before gets the last answer again and changes nothing.
    pub seq: u64,
    /// Time of the client's clock in microseconds; echoed.
    pub timestamp_us: i64,
    /// The image.
    pub image: ImageBytes,
    /// How the image is encoded, and the images of the answer unless configured.
    #[serde(default)]
    pub format: ImageFormat,
    /// The action from this frame to the next, in the model's order and units. Required if the model is conditioned on
    /// actions and there is no `plan`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub action: Option<Vec<f32>>,
    /// The robot's state at this frame. Required if the model is conditioned on it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<Vec<f32>>,
    /// The future actions, as many as `steps`. Default: `action`, repeated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<Vec<Vec<f32>>>,
    /// How many frames to predict. Default: the model's horizon. More are beyond what the model was trained for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<usize>,
}

/// Changes of a session's settings; absent settings stay as they are.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ConfigureMessage {
    /// What happens if frames are missing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_gap: Option<OnGap>,
    /// What happens to a frame if newer frames wait behind it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_late: Option<OnLate>,
    /// How predicted frames are encoded, whatever the format of the frames sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub format: Option<ImageFormat>,
    /// How a frame of another size is resized.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resize: Option<Resize>,
    /// Every N-th prediction of this stream, from the next one on, is followed by a plan; 0: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan_every: Option<u64>,
    /// What the plans are to reach and how they are searched for: the body of `POST /v1/sessions/{id}/plan`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan_request: Option<Box<SessionPlanRequest>>,
}

/// Settings of a session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SessionSettings {
    /// What happens if frames are missing.
    pub on_gap: OnGap,
    /// What happens to a frame if newer frames wait behind it.
    pub on_late: OnLate,
    /// How predicted frames are encoded; absent: in the format of the frames sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub format: Option<ImageFormat>,
    /// How a frame of another size is resized; absent: it is refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resize: Option<Resize>,
}

/// What happens if frames are missing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnGap {
    /// The frame after the gap is refused.
    #[default]
    Error,
    /// The session continues with the frame after the gap, and its answer counts the missing frames.
    Skip,
}

/// What happens to a frame if newer frames already wait behind it when its turn comes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnLate {
    /// It gets a prediction like any other frame.
    #[default]
    Predict,
    /// It goes into the context but gets no prediction, so that a busy server predicts from the newest frame. At most
    /// `pipelined_frames` in a row are skipped.
    Skip,
}

/// Asks for a `pong` with the same time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct PingMessage {
    /// Time of the client's clock in microseconds; echoed.
    #[serde(default)]
    pub timestamp_us: i64,
}

/// A message without fields.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CloseMessage {}

/// What the server sends.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum ServerMessage {
    /// The first message.
    Ready {
        /// The session's id; absent if the session ends with its stream.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        session: Option<String>,
        /// The model's name.
        model: String,
        /// The model's version.
        version: u32,
        /// The model's inputs and outputs.
        spec: Box<ModelSpec>,
        /// The stream's bounds.
        limits: StreamLimits,
        /// The `seq` of the next frame.
        next_seq: u64,
    },
    /// The context is not yet full.
    Buffering {
        /// The `seq` of the frame.
        seq: u64,
        /// The time of the frame, echoed.
        timestamp_us: i64,
        /// Frames in the context.
        have: usize,
        /// Frames that the context takes.
        need: usize,
        /// Missing frames before this one.
        skipped: u64,
    },
    /// The predicted frames.
    Prediction {
        /// The `seq` of the frame.
        seq: u64,
        /// The time of the frame, echoed.
        timestamp_us: i64,
        /// t+1, t+2, ….
        frames: Vec<ImageBytes>,
        /// How they are encoded.
        format: ImageFormat,
        /// The mean squared error to expect of each frame up to the model's horizon, which follows the session's own errors so far;
        /// absent if the model is not calibrated.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        expected_mse: Vec<f32>,
        /// The 90 % band of each of these errors, which follows the session's own errors too; absent if the model is not calibrated.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        mse_band_90: Vec<[f32; 2]>,
        /// How unlike the training data frames, state and actions are, 0…1; absent if the model is not calibrated.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        novelty: Option<f32>,
        /// For each frame, whether it is beyond what the model was trained for; absent if none is.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        beyond_training: Vec<bool>,
        /// Actions and states out of the range of the training and, once in a session, each input that the model does not use; absent
        /// if there are none.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        warnings: Vec<String>,
        /// How long it took.
        timing: Timing,
        /// Predictions dropped since the last one that was sent, because the client did not read them in time.
        dropped: u64,
        /// Missing frames before this one.
        skipped: u64,
    },
    /// The plan that was asked for with `plan_every`, searched for from this frame on.
    Plan {
        /// The `seq` of the frame.
        seq: u64,
        /// The time of the frame, echoed.
        timestamp_us: i64,
        /// The answer of `POST /v1/sessions/{id}/plan`.
        answer: Box<PlanResponse>,
        /// Plans that were due since the last one, but skipped, because the search before had not ended or the server was busy.
        skipped: u64,
    },
    /// The frame is in the context but got no prediction, because newer frames were waiting.
    Overtaken {
        /// The `seq` of the frame.
        seq: u64,
        /// The time of the frame, echoed.
        timestamp_us: i64,
        /// Missing frames before this one.
        skipped: u64,
    },
    /// Answers `configure` with the settings of the session now.
    Configured(SessionSettings),
    /// A warning; nothing was refused.
    Warning {
        /// The kind, for programs.
        code: WarningCode,
        /// The reason and the remedy, for people.
        detail: String,
    },
    /// A message was refused. The stream continues unless `closing` follows.
    Error {
        /// The kind, for programs.
        code: ErrorCode,
        /// What was wrong, and what would be right.
        detail: String,
        /// The `seq` of the next frame.
        next_seq: u64,
    },
    /// Answers `ping`.
    Pong {
        /// The client's clock, echoed.
        timestamp_us: i64,
    },
    /// The last message.
    Closing {
        /// The reason.
        reason: ClosingReason,
    },
}

/// Bounds of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct StreamLimits {
    /// Maximum size of a message in bytes.
    pub message_bytes: usize,
    /// Maximum number of frames that are read before the earlier ones are answered; more are read later.
    pub pipelined_frames: usize,
    /// Maximum size of the messages that wait for a slow reader, in bytes; beyond it, the oldest predictions are dropped.
    pub buffered_bytes: usize,
    /// Maximum idle time in milliseconds.
    pub idle_ms: u64,
    /// Milliseconds for which the session outlives its stream; 0 if it ends with the stream.
    pub grace_ms: u64,
}

impl StreamLimits {
    /// The bounds of a stream. `is_kept`: the session outlives its stream.
    pub(in crate::server) fn new(config: &ServerConfig, is_kept: bool) -> Self {
        Self {
            message_bytes: config.max_body_bytes,
            pipelined_frames: config.max_pipelined_frames,
            buffered_bytes: config.max_stream_buffer_bytes,
            idle_ms: config.stream_idle_ms,
            grace_ms: if is_kept { config.session_grace_ms } else { 0 },
        }
    }
}

/// The kinds of warnings of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WarningCode {
    /// The client reads too slowly: predictions are dropped.
    Slow,
    /// No message came for long; the stream will be closed.
    Idle,
    /// A plan that was due could not be made.
    Plan,
}

/// The kinds of errors of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorCode {
    /// Not a message of this protocol.
    Malformed,
    /// A message that does not fit the model.
    Invalid,
    /// Frames are missing before this one.
    Gap,
    /// Too busy to predict; send the same frame again.
    Overloaded,
    /// The server failed.
    Internal,
}

/// Why a stream ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ClosingReason {
    /// The client asked for it.
    Asked,
    /// No message came for too long.
    Idle,
    /// A newer stream replaced this one.
    Replaced,
    /// The session was deleted.
    Deleted,
    /// The client reads too slowly.
    Slow,
    /// A message was longer than `limits.message_bytes`.
    TooLong,
    /// The bodies and messages that the server receives exceed its memory for them; try again in 1 s.
    Overloaded,
    /// An error of the WebSocket protocol.
    Malformed,
    /// Text that is not UTF-8.
    NotUtf8,
    /// The API key that opened the stream was revoked.
    Revoked,
    /// The server stops.
    Shutdown,
}
