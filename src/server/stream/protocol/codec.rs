//! Reads and writes messages: `foreframe.v1.json` is text, `foreframe.v1.msgpack` is binary.

use axum::extract::ws::Message;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::server::http::extract::Object;
use crate::server::msgpack::{self, MsgpackError};

/// The sub-protocol for people and browsers.
pub const JSON: &str = "foreframe.v1.json";
/// The sub-protocol for robots.
pub const MSGPACK: &str = "foreframe.v1.msgpack";

/// A sub-protocol.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Codec {
    /// Text.
    #[default]
    Json,
    /// `MessagePack`, structures as maps with the fields' names.
    Msgpack,
}

/// Why a message could not be read.
#[derive(Debug, thiserror::Error)]
pub enum CodecError {
    /// Text in the binary sub-protocol, or binary in the text sub-protocol.
    #[error("{} takes {} messages", .0.name(), if *.0 == Codec::Json { "text" } else { "binary" })]
    Kind(Codec),
    /// Not JSON, or not a message.
    #[error("not a message of {JSON}: {0}")]
    Json(#[from] serde_path_to_error::Error<serde_json::Error>),
    /// Not `MessagePack`, or not a message.
    #[error("not a message of {MSGPACK}: {0}")]
    Msgpack(#[source] serde_path_to_error::Error<rmp_serde::decode::Error>),
    /// Bytes after the message.
    #[error("not a message of {}: {} follow it", .0.name(), if *.0 == Codec::Json { "letters" } else { "bytes" })]
    Trailing(Codec),
}

impl From<MsgpackError> for CodecError {
    fn from(error: MsgpackError) -> Self {
        match error {
            MsgpackError::Invalid(error) => Self::Msgpack(error),
            MsgpackError::Trailing => Self::Trailing(Codec::Msgpack),
        }
    }
}

impl Codec {
    /// Both, the one for robots first.
    pub const NAMES: [&str; 2] = [MSGPACK, JSON];

    /// The codec of a sub-protocol.
    #[must_use]
    pub fn of(name: &str) -> Self {
        if name == MSGPACK { Self::Msgpack } else { Self::Json }
    }

    /// The sub-protocol's name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Json => JSON,
            Self::Msgpack => MSGPACK,
        }
    }

    /// Reads a message. Errors name the field.
    pub fn decode<T: DeserializeOwned>(self, message: &Message) -> Result<T, CodecError> {
        let Object(message) = match (self, message) {
            (Self::Json, Message::Text(text)) => from_json(text)?,
            (Self::Msgpack, Message::Binary(bytes)) => msgpack::read(bytes)?,
            _ => return Err(CodecError::Kind(self)),
        };
        Ok(message)
    }

    /// Writes a message.
    #[must_use]
    pub fn encode<T: Serialize>(self, message: &T) -> Message {
        match self {
            Self::Json => {
                let text = serde_json::to_string(message).expect("a message that is not JSON is a bug");
                Message::Text(text.into())
            }
            Self::Msgpack => Message::Binary(msgpack::write(message).into()),
        }
    }
}

fn from_json<T: DeserializeOwned>(text: &str) -> Result<T, CodecError> {
    let mut deserializer = serde_json::Deserializer::from_str(text);
    let message = serde_path_to_error::deserialize(&mut deserializer)?;
    deserializer.end().map_err(|_| CodecError::Trailing(Codec::Json))?;
    Ok(message)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::*;
    use super::*;

    fn frame(seq: u64, image: Vec<u8>, action: Option<Vec<f32>>) -> ClientMessage {
        ClientMessage::Frame(FrameMessage {
            seq,
            timestamp_us: -1,
            image: ImageBytes(image),
            format: ImageFormat::Raw,
            state: action.clone(),
            steps: action.as_ref().map(Vec::len),
            plan: action.clone().map(|action| vec![action; 2]),
            action,
        })
    }

    proptest! {
        #[test]
        fn a_message_survives_both_ways(
            seq in any::<u64>(),
            image in proptest::collection::vec(any::<u8>(), 0..60),
            action in proptest::option::of(proptest::collection::vec(-9.0f32..9.0, 0..4)),
        ) {
            let message = frame(seq, image, action);
            for codec in [Codec::Json, Codec::Msgpack] {
                prop_assert_eq!(&codec.decode::<ClientMessage>(&codec.encode(&message)).unwrap(), &message);
            }
        }

        #[test]
        fn no_bytes_make_the_codecs_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200), text in ".{0,200}") {
            let _ = Codec::Msgpack.decode::<ClientMessage>(&Message::Binary(bytes.into()));
            let _ = Codec::Json.decode::<ClientMessage>(&Message::Text(text.into()));
        }

        #[test]
        fn a_damaged_message_never_panics(at in 0usize..60, value in any::<u8>(), cut in 0usize..60) {
            let Message::Binary(bytes) = Codec::Msgpack.encode(&frame(1, vec![7; 9], Some(vec![1.0]))) else { panic!() };
            let mut bytes = bytes.to_vec();
            let at = at % bytes.len();
            bytes[at] = value;
            bytes.truncate(bytes.len() - cut % 3);
            let _ = Codec::Msgpack.decode::<ClientMessage>(&Message::Binary(bytes.into()));
        }
    }

    #[test]
    fn an_image_is_bytes_in_binary_and_base64_in_text() {
        let message = frame(0, vec![1, 2, 3], None);
        let Message::Text(text) = Codec::Json.encode(&message) else {
            panic!()
        };
        assert!(text.contains(r#""image":"AQID""#), "{text}");
        let Message::Binary(bytes) = Codec::Msgpack.encode(&message) else {
            panic!()
        };
        // MessagePack: a binary string of three bytes.
        assert!(bytes.windows(5).any(|window| window == [0xC4, 3, 1, 2, 3]));
    }

    #[test]
    fn unknown_fields_half_messages_and_extra_bytes_are_refused() {
        let text = |text: &str| {
            Codec::Json
                .decode::<ClientMessage>(&Message::Text(text.into()))
                .unwrap_err()
                .to_string()
        };
        let unknown = text(r#"{"type":"frame","seq":0,"timestamp_us":0,"image":"","colour":1}"#);
        assert!(unknown.contains("unknown field `colour`"), "{unknown}");
        assert!(text(r#"{"type":"close","why":1}"#).contains("unknown field `why`"));
        assert!(text(r#"["ping",null,5]"#).contains("expected an object"));
        assert!(text(r#"{"type":"dance"}"#).contains("expected one of `frame`, `configure`, `ping`, `close`"));
        assert!(text(r#"{"type":"frame","seq":0,"timestamp_us":0,"image":"%"}"#).contains("the image is not base64"));
        let Message::Binary(whole) = Codec::Msgpack.encode(&frame(0, vec![1], None)) else {
            panic!()
        };
        let binary = |bytes: Vec<u8>| Codec::Msgpack.decode::<ClientMessage>(&Message::Binary(bytes.into()));
        assert!(binary(whole[..whole.len() - 1].to_vec()).is_err());
        for more in [&[0][..], &[0x92, 0], &[0xC1]] {
            assert!(matches!(
                binary([&whole[..], more].concat()),
                Err(CodecError::Trailing(Codec::Msgpack))
            ));
        }
        // An image that states four thousand million bytes and has none.
        assert!(
            binary(vec![
                0x81, 0xA5, b'i', b'm', b'a', b'g', b'e', 0xC6, 0xFF, 0xFF, 0xFF, 0xFF
            ])
            .is_err()
        );
    }

    #[test]
    fn text_is_refused_in_binary_and_binary_in_text() {
        let error = Codec::Msgpack
            .decode::<ClientMessage>(&Message::Text("{}".into()))
            .unwrap_err();
        assert_eq!(error.to_string(), "foreframe.v1.msgpack takes binary messages");
        let error = Codec::Json
            .decode::<ClientMessage>(&Message::Binary(vec![1].into()))
            .unwrap_err();
        assert_eq!(error.to_string(), "foreframe.v1.json takes text messages");
    }

    #[test]
    fn the_wire_text_of_the_answers_is_as_promised() {
        let text = |message| match Codec::Json.encode(&message) {
            Message::Text(text) => text.to_string(),
            _ => panic!(),
        };
        let prediction = ServerMessage::Prediction {
            seq: 7,
            timestamp_us: 9,
            frames: vec![ImageBytes(vec![0; 3])],
            format: ImageFormat::Raw,
            expected_mse: vec![0.5],
            mse_band_90: vec![[0.25, 0.75]],
            novelty: Some(0.5),
            beyond_training: Vec::new(),
            warnings: Vec::new(),
            timing: Timing {
                queue_us: 1,
                compute_us: 2,
            },
            dropped: 0,
            skipped: 0,
        };
        insta::assert_snapshot!(text(prediction), @r#"{"type":"prediction","seq":7,"timestamp_us":9,"frames":["AAAA"],"format":"raw","expected_mse":[0.5],"mse_band_90":[[0.25,0.75]],"novelty":0.5,"timing":{"queue_us":1,"compute_us":2},"dropped":0,"skipped":0}"#);
        let gap = ServerMessage::Error {
            code: ErrorCode::Gap,
            detail: "seq is 9; seq 7 is next".to_owned(),
            next_seq: 7,
        };
        insta::assert_snapshot!(text(gap), @r#"{"type":"error","code":"gap","detail":"seq is 9; seq 7 is next","next_seq":7}"#);
        let closing = ServerMessage::Closing {
            reason: ClosingReason::Shutdown,
        };
        insta::assert_snapshot!(text(closing), @r#"{"type":"closing","reason":"shutdown"}"#);
    }
}
