//! The messages of a stream, the same in both sub-protocols; [`codec`] takes them from and to the wire. Knows no socket.
//! `openapi/asyncapi.yaml` is the contract, with an example of each.

mod flat;

pub mod codec;

use serde::{Deserialize, Serialize};

use crate::frame::fit::Fit;
use crate::nn::ModelSpec;
use crate::server::config::ServerConfig;
use crate::server::images::{ImageBytes, ImageFormat};

pub use codec::Codec;

/// What a client sends.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "type", rename_all = "snake_case", try_from = "flat::AnyMessage")]
pub enum ClientMessage {
    /// The next frame.
    Frame(FrameMessage),
    /// How the session shall behave from here on.
    Configure(ConfigureMessage),
    /// Asks for a sign of life.
    Ping(PingMessage),
    /// Ends the stream; the session stays.
    Close(CloseMessage),
}

/// A frame with what the robot does and says of itself when it is taken.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct FrameMessage {
    /// Counts from 0; a number once answered gets the last answer again and changes nothing.
    pub seq: u64,
    /// The client's clock in microseconds; echoed.
    pub timestamp_us: i64,
    /// The image.
    pub image: ImageBytes,
    /// How the image is encoded, and how those of the answer shall be, unless configured.
    #[serde(default)]
    pub format: ImageFormat,
    /// What acts from this frame to the next, in the model's order and units; needed where the model is conditioned on
    /// actions and there is no `plan`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub action: Option<Vec<f32>>,
    /// What the robot says of itself at this frame; needed where the model is conditioned on it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<Vec<f32>>,
    /// The actions to predict under, as many as the model's horizon; default: `action`, held.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<Vec<Vec<f32>>>,
}

/// Settings of a session; what is absent stays as it is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ConfigureMessage {
    /// What a missing frame means.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_gap: Option<OnGap>,
    /// What a frame means that a newer one has overtaken.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_late: Option<OnLate>,
    /// How predicted frames are encoded, whatever the format of those sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub format: Option<ImageFormat>,
    /// How a frame of another size is resized.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<Fit>,
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
    pub fit: Option<Fit>,
}

/// What a missing frame means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnGap {
    /// The frame that leaves others out is refused.
    #[default]
    Error,
    /// The session goes on with it, and its answer says how many are missing.
    Skip,
}

/// What a frame means that a newer one has overtaken: it waits behind it when its turn comes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnLate {
    /// It is predicted from as any other.
    #[default]
    Predict,
    /// It is taken into the context, and nothing is predicted from it: what is predicted is never of the past for long,
    /// and a server that is too busy for all frames predicts from the newest. Of at most `pipelined_frames` in a row.
    Skip,
}

/// Asks for a `pong` with the same time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct PingMessage {
    /// The client's clock in microseconds; echoed.
    #[serde(default)]
    pub timestamp_us: i64,
}

/// Nothing but its type.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CloseMessage {}

/// What the server sends.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum ServerMessage {
    /// First of all.
    Ready {
        /// The session's id; absent where the session ends with its stream.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        session: Option<String>,
        /// The model's name.
        model: String,
        /// The model's version.
        version: u32,
        /// What it takes and gives.
        spec: Box<ModelSpec>,
        /// The stream's bounds.
        limits: StreamLimits,
        /// The number the next frame shall have.
        next_seq: u64,
    },
    /// Frames are missing until the context is full.
    Buffering {
        /// The frame's number.
        seq: u64,
        /// The frame's time, echoed.
        timestamp_us: i64,
        /// Frames there are.
        have: usize,
        /// Frames needed.
        need: usize,
        /// Frames left out before this one.
        skipped: u64,
    },
    /// The frames to come.
    Prediction {
        /// The frame's number.
        seq: u64,
        /// The frame's time, echoed.
        timestamp_us: i64,
        /// t+1, t+2, ….
        frames: Vec<ImageBytes>,
        /// How they are encoded.
        format: ImageFormat,
        /// How long it took.
        timing: Timing,
        /// Predictions left out since the last one that was sent, because they were not read in time.
        dropped: u64,
        /// Frames left out before this one.
        skipped: u64,
    },
    /// The frame is in the context; nothing was predicted from it, for a newer one had overtaken it.
    Overtaken {
        /// The frame's number.
        seq: u64,
        /// The frame's time, echoed.
        timestamp_us: i64,
        /// Frames left out before this one.
        skipped: u64,
    },
    /// Answers `configure`: the settings of the session now.
    Configured(SessionSettings),
    /// Something that the client should know of; nothing was refused.
    Warning {
        /// What kind, for programs.
        code: WarningCode,
        /// What it is, and what would help.
        detail: String,
    },
    /// Something was refused; unless `closing` follows, the stream goes on.
    Error {
        /// What kind, for programs.
        code: ErrorCode,
        /// What was wrong, and what would be right.
        detail: String,
        /// The number the next frame shall have.
        next_seq: u64,
    },
    /// Answers `ping`.
    Pong {
        /// The client's clock, echoed.
        timestamp_us: i64,
    },
    /// Last of all.
    Closing {
        /// Why.
        reason: ClosingReason,
    },
}

/// Bounds of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct StreamLimits {
    /// Bytes of a message at most.
    pub message_bytes: usize,
    /// Frames that may be sent before their answers have come; more are read later.
    pub pipelined_frames: usize,
    /// Bytes of answers that wait for a slow reader; beyond them the oldest predictions are dropped.
    pub buffered_bytes: usize,
    /// Milliseconds of silence at most.
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

/// How long a prediction took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Timing {
    /// Microseconds in the queue.
    pub queue_us: u64,
    /// Microseconds of computation, with the others of its batch.
    pub compute_us: u64,
}

/// The kinds of warnings of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WarningCode {
    /// The client reads too slowly: predictions are dropped.
    Slow,
    /// Nothing came for long; the stream will be closed.
    Idle,
}

/// The kinds of errors of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorCode {
    /// Not a message of this protocol.
    Malformed,
    /// A message that does not fit the model.
    Invalid,
    /// A frame's number leaves some out.
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
    /// The client asked.
    Asked,
    /// Nothing came for too long.
    Idle,
    /// The session was taken over by a newer connection.
    Replaced,
    /// The session was deleted.
    Deleted,
    /// The client reads too slowly.
    Slow,
    /// A message was longer than `limits.message_bytes`.
    TooLong,
    /// What came is against the WebSocket's own rules.
    Malformed,
    /// Text that is not UTF-8.
    NotUtf8,
    /// The server stops.
    Shutdown,
}
