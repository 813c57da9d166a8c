//! The messages of a stream in the sub-protocol `foreframe.v1.json`, from and to text. Knows no socket.

use serde::{Deserialize, Serialize};

use super::images::ImageFormat;
use crate::nn::ModelSpec;

/// The sub-protocol's name.
pub const SUBPROTOCOL: &str = "foreframe.v1.json";

/// What a client sends.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum ClientMessage {
    /// The next frame.
    Frame(FrameMessage),
    /// Asks for a sign of life.
    Ping(PingMessage),
    /// Ends the stream.
    Close(CloseMessage),
}

/// A frame with what the robot does and says of itself when it is taken.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct FrameMessage {
    /// Counts from 0; a number once answered gets the same answer and changes nothing.
    pub seq: u64,
    /// The client's clock in microseconds; echoed.
    pub timestamp_us: i64,
    /// The image, base64.
    pub image: String,
    /// How the image is encoded, and how those of the answer shall be.
    #[serde(default)]
    pub format: ImageFormat,
    /// What acts from this frame to the next, in the model's order and units; needed where the model is conditioned on
    /// actions.
    #[serde(default)]
    pub action: Option<Vec<f32>>,
    /// What the robot says of itself at this frame; needed where the model is conditioned on it.
    #[serde(default)]
    pub state: Option<Vec<f32>>,
    /// The actions to predict under, as many as the model's horizon; default: `action`, held.
    #[serde(default)]
    pub plan: Option<Vec<Vec<f32>>>,
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
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum ServerMessage {
    /// First of all.
    Ready {
        /// The model's name.
        model: String,
        /// The model's version.
        version: u32,
        /// What it takes and gives.
        spec: Box<ModelSpec>,
        /// The stream's bounds.
        limits: StreamLimits,
        /// The number the first frame shall have.
        next_seq: u64,
    },
    /// Frames are missing until the context is full.
    Warming {
        /// The frame's number.
        seq: u64,
        /// The frame's time, echoed.
        timestamp_us: i64,
        /// Frames there are.
        have: usize,
        /// Frames needed.
        need: usize,
    },
    /// The frames to come.
    Prediction {
        /// The frame's number.
        seq: u64,
        /// The frame's time, echoed.
        timestamp_us: i64,
        /// t+1, t+2, …, base64.
        frames: Vec<String>,
        /// How they are encoded.
        format: ImageFormat,
        /// How long it took.
        timing: Timing,
        /// Frames since the last prediction that got none because the server was busy.
        dropped: u64,
    },
    /// Something was refused; the stream goes on.
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct StreamLimits {
    /// Bytes of a message at most.
    pub message_bytes: usize,
    /// Milliseconds of silence at most.
    pub idle_ms: u64,
}

/// How long a prediction took.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct Timing {
    /// Microseconds in the queue.
    pub queue_us: u64,
    /// Microseconds of computation, with the others of its batch.
    pub compute_us: u64,
}

/// The kinds of errors of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ClosingReason {
    /// The client asked.
    Asked,
    /// Nothing came for too long.
    Idle,
    /// The server stops.
    Shutdown,
}

/// A client's message from its text. Errors: a sentence that says where the text goes wrong.
pub fn decode(text: &str) -> Result<ClientMessage, String> {
    serde_json::from_str(text).map_err(|error| format!("not a message of {SUBPROTOCOL}: {error}"))
}

/// A server's message as text.
#[must_use]
pub fn encode(message: &ServerMessage) -> String {
    // No message holds a map with keys that are not text, the one thing that JSON cannot hold.
    serde_json::to_string(message).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_frame_message_survives_its_text(seq in any::<u64>(), timestamp_us in any::<i64>(), linear in -9.0f32..9.0) {
            let message = ClientMessage::Frame(FrameMessage {
                seq,
                timestamp_us,
                image: "AAAA".to_owned(),
                format: ImageFormat::Raw,
                action: Some(vec![linear]),
                state: None,
                plan: Some(vec![vec![linear]; 2]),
            });
            prop_assert_eq!(decode(&serde_json::to_string(&message).unwrap()).unwrap(), message);
        }

        #[test]
        fn no_text_makes_the_codec_panic(text in ".{0,200}") {
            let _ = decode(&text);
        }
    }

    #[test]
    fn an_unknown_field_is_refused_by_its_name() {
        let error = decode(r#"{"type":"frame","seq":0,"timestamp_us":0,"image":"","colour":1}"#).unwrap_err();
        assert!(error.contains("unknown field `colour`"), "{error}");
        assert!(decode(r#"{"type":"close","why":1}"#).is_err());
    }

    #[test]
    fn an_unknown_type_is_refused_with_those_there_are() {
        let error = decode(r#"{"type":"configure"}"#).unwrap_err();
        assert!(error.contains("expected one of `frame`, `ping`, `close`"), "{error}");
    }

    #[test]
    fn the_wire_text_of_the_answers_is_as_promised() {
        let prediction = ServerMessage::Prediction {
            seq: 7,
            timestamp_us: 9,
            frames: vec!["AAAA".to_owned()],
            format: ImageFormat::Raw,
            timing: Timing {
                queue_us: 1,
                compute_us: 2,
            },
            dropped: 0,
        };
        insta::assert_snapshot!(encode(&prediction), @r#"{"type":"prediction","seq":7,"timestamp_us":9,"frames":["AAAA"],"format":"raw","timing":{"queue_us":1,"compute_us":2},"dropped":0}"#);
        let gap = ServerMessage::Error {
            code: ErrorCode::Gap,
            detail: "seq is 9; seq 7 is next".to_owned(),
            next_seq: 7,
        };
        insta::assert_snapshot!(encode(&gap), @r#"{"type":"error","code":"gap","detail":"seq is 9; seq 7 is next","next_seq":7}"#);
        let closing = ServerMessage::Closing {
            reason: ClosingReason::Shutdown,
        };
        insta::assert_snapshot!(encode(&closing), @r#"{"type":"closing","reason":"shutdown"}"#);
    }
}
