//! Messages of a running robot, one by one: the types that bags have, in CDR, and images of Foxglove in Protocol Buffers or JSON.
//! Commands and measurements can also come as JSON.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Deserialize;
use serde_json::Value;

use super::json;
use super::messages::{self, RosType};
use super::pixels::RawImage;
use crate::protobuf::{bytes_of, number_of};
use foreframe_core::frame::{Frame, codec};

/// What the messages of a topic are for a prediction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum LiveRole {
    /// A camera's images.
    Image,
    /// What the robot is told to do: by default the action.
    Command,
    /// What the robot measures: by default the state.
    Measurement,
}

/// A type of messages that can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LiveType(MessageDecoder);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum MessageDecoder {
    Ros(RosType),
    FoxgloveRawImage,
    FoxgloveCompressedImage,
    JsonRawImage,
    JsonCompressedImage,
    /// An action or a state of ROS 2 in JSON.
    JsonRos(RosType),
    JsonPose,
    /// Any other object in JSON, for its numbers.
    JsonNumbers,
}

/// A number of a message by its name, as `linear.x`.
#[derive(Clone, Debug, PartialEq)]
pub struct LiveValue {
    /// Its name.
    pub name: String,
    /// Its value, in the unit of the type (m, m/s, rad, rad/s).
    pub value: f64,
}

// Numbers of fields of `foxglove.RawImage` and `foxglove.CompressedImage`.
const RAW_WIDTH: u32 = 2;
const RAW_HEIGHT: u32 = 3;
const RAW_ENCODING: u32 = 4;
const RAW_STEP: u32 = 5;
const RAW_DATA: u32 = 6;
const COMPRESSED_DATA: u32 = 2;

impl LiveType {
    /// By the encoding of a topic's messages and the name of their type; `None` if they cannot be read.
    #[must_use]
    pub fn of(encoding: &str, type_name: &str) -> Option<Self> {
        let decoder = match (encoding, type_name) {
            ("protobuf", "foxglove.RawImage") => MessageDecoder::FoxgloveRawImage,
            ("protobuf", "foxglove.CompressedImage") => MessageDecoder::FoxgloveCompressedImage,
            ("json", "foxglove.RawImage") => MessageDecoder::JsonRawImage,
            ("json", "foxglove.CompressedImage") => MessageDecoder::JsonCompressedImage,
            ("json", "foxglove.PoseInFrame") => MessageDecoder::JsonPose,
            (encoding, name) => match (encoding, RosType::of(name)) {
                ("json", RosType::Other) => MessageDecoder::JsonNumbers,
                ("json", kind) if kind.is_command() || kind.is_measurement() => MessageDecoder::JsonRos(kind),
                ("cdr", kind) if kind.is_image() || kind.is_command() || kind.is_measurement() => {
                    MessageDecoder::Ros(kind)
                }
                _ => return None,
            },
        };
        Some(Self(decoder))
    }

    /// What it is used for by default; `None` if it is used only for what its topic is named for: an action or a state.
    #[must_use]
    pub fn role(self) -> Option<LiveRole> {
        match self.0 {
            MessageDecoder::Ros(kind) if kind.is_image() => Some(LiveRole::Image),
            MessageDecoder::Ros(kind) | MessageDecoder::JsonRos(kind) => Some(if kind.is_command() {
                LiveRole::Command
            } else {
                LiveRole::Measurement
            }),
            MessageDecoder::JsonPose | MessageDecoder::JsonNumbers => None,
            MessageDecoder::FoxgloveRawImage
            | MessageDecoder::FoxgloveCompressedImage
            | MessageDecoder::JsonRawImage
            | MessageDecoder::JsonCompressedImage => Some(LiveRole::Image),
        }
    }

    /// Whether its messages hold images; those of the others hold numbers.
    #[must_use]
    pub fn is_image(self) -> bool {
        self.role() == Some(LiveRole::Image)
    }

    /// The image of a message, in gray. Errors: why it cannot be read, or that it holds numbers.
    pub fn image(self, message: &[u8]) -> Result<Frame, String> {
        let json_file;
        let file = match self.0 {
            MessageDecoder::Ros(RosType::Image) => return messages::image(message)?.1.gray(),
            MessageDecoder::JsonRawImage => return json_raw_image(message),
            MessageDecoder::JsonCompressedImage => {
                json_file = json::read::<JsonCompressedImage>(message)?.data.bytes()?;
                &json_file
            }
            MessageDecoder::FoxgloveRawImage => return raw_image(message)?.gray(),
            MessageDecoder::Ros(RosType::CompressedImage) => messages::compressed_image(message)?.2,
            MessageDecoder::FoxgloveCompressedImage => bytes_of(message, COMPRESSED_DATA).unwrap_or_default(),
            _ => return Err("it has numbers and no image".to_owned()),
        };
        codec::decode(file).map_err(|error| error.to_string())
    }

    /// The numbers of a message. Errors: why it cannot be read, or that it is an image.
    pub fn values(self, message: &[u8]) -> Result<Vec<LiveValue>, String> {
        let values = match self.0 {
            MessageDecoder::Ros(kind) if !kind.is_image() => messages::values(kind, message)?.1,
            MessageDecoder::JsonRos(kind) => json::values(kind, message)?,
            MessageDecoder::JsonPose => json::pose(message)?,
            MessageDecoder::JsonNumbers => json::numbers(message)?,
            _ => return Err("it is an image, which has no numbers".to_owned()),
        };
        let named = values.into_iter().map(|field| LiveValue {
            name: field.name.into_owned(),
            value: field.value,
        });
        Ok(named.collect())
    }
}

fn raw_image(message: &[u8]) -> Result<RawImage<'_>, String> {
    let number = |field| u32::try_from(number_of(message, field).unwrap_or(0)).unwrap_or(u32::MAX);
    let encoding = bytes_of(message, RAW_ENCODING).unwrap_or_default();
    Ok(RawImage {
        width_px: number(RAW_WIDTH),
        height_px: number(RAW_HEIGHT),
        encoding: std::str::from_utf8(encoding).map_err(|_| "its encoding is no UTF-8 text".to_owned())?,
        big_endian: false,
        row_bytes: number(RAW_STEP),
        bytes: bytes_of(message, RAW_DATA).unwrap_or_default(),
    })
}

// Images of Foxglove in JSON. Other fields are ignored: time and coordinate frame.

/// Bytes in base64.
#[derive(Deserialize)]
struct Base64(String);

impl Base64 {
    fn bytes(self) -> Result<Vec<u8>, String> {
        let decoded = STANDARD.decode(self.0);
        decoded.map_err(|error| format!("its data is not base64: {error}"))
    }
}

#[derive(Deserialize)]
struct JsonCompressedImage {
    data: Base64,
}

#[derive(Deserialize)]
struct JsonRawImage {
    data: Base64,
    encoding: String,
    // Read later: the errors of a whole message do not say which field is wrong.
    #[serde(default)]
    width: Value,
    #[serde(default)]
    height: Value,
    #[serde(default)]
    step: Value,
}

fn json_raw_image(message: &[u8]) -> Result<Frame, String> {
    let image = json::read::<JsonRawImage>(message)?;
    let number = |name, value: &Value| {
        let whole = value.as_u64().and_then(|number| u32::try_from(number).ok());
        whole.ok_or_else(|| {
            let found = if value.is_null() {
                "is missing"
            } else {
                "is no whole number"
            };
            format!("its {name} {found}; a foxglove.RawImage has width and height in px, and step: the bytes of a row")
        })
    };
    let raw = RawImage {
        width_px: number("width", &image.width)?,
        height_px: number("height", &image.height)?,
        encoding: &image.encoding,
        big_endian: false,
        row_bytes: number("step", &image.step)?,
        bytes: &image.data.bytes()?,
    };
    raw.gray()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_raw_image_of_foxglove_is_read() {
        // As foxglove-sdk writes RawImage(width=3, height=2, encoding="mono8", step=3, data=b"abcdef").
        let message = b"\x15\x03\0\0\0\x1d\x02\0\0\0\x22\x05mono8\x2d\x03\0\0\0\x32\x06abcdef";
        let kind = LiveType::of("protobuf", "foxglove.RawImage").unwrap();
        let frame = kind.image(message).unwrap();
        assert_eq!((frame.width(), frame.height(), frame.pixels()), (3, 2, &b"abcdef"[..]));
        assert!(kind.image(&message[..20]).is_err() && kind.values(message).is_err());
        assert!(kind.image(b"").unwrap_err().contains("its encoding is \"\""));
    }

    #[test]
    fn images_of_foxglove_in_json_are_read() {
        let [raw, compressed] =
            ["RawImage", "CompressedImage"].map(|name| LiveType::of("json", &format!("foxglove.{name}")).unwrap());
        assert_eq!(raw.role(), Some(LiveRole::Image));
        let time = r#""timestamp":{"sec":1,"nsec":2},"frame_id":"camera""#;
        let message = format!(r#"{{{time},"width":3,"height":2,"encoding":"mono8","step":3,"data":"YWJjZGVm"}}"#);
        let frame = raw.image(message.as_bytes()).unwrap();
        assert_eq!((frame.width(), frame.height(), frame.pixels()), (3, 2, &b"abcdef"[..]));
        let png = STANDARD.encode(codec::encode_png(&frame).unwrap());
        let message = format!(r#"{{{time},"format":"png","data":"{png}"}}"#);
        assert_eq!(compressed.image(message.as_bytes()).unwrap().pixels(), b"abcdef");
        for wrong in ["", "{}", r#"{"data":"?"}"#, r#"{"data":""}"#] {
            for kind in [raw, compressed] {
                assert!(kind.image(wrong.as_bytes()).is_err(), "{wrong}");
            }
        }
    }

    #[test]
    fn types_are_known_by_encoding_and_name() {
        let role = |encoding, name| LiveType::of(encoding, name).and_then(LiveType::role);
        assert_eq!(role("cdr", "sensor_msgs/msg/CompressedImage"), Some(LiveRole::Image));
        assert_eq!(role("cdr", "nav_msgs/msg/Odometry"), Some(LiveRole::Measurement));
        assert_eq!(role("cdr", "geometry_msgs/msg/Twist"), Some(LiveRole::Command));
        assert_eq!(role("json", "nav_msgs/Odometry"), Some(LiveRole::Measurement));
        assert_eq!(role("json", "geometry_msgs/msg/TwistStamped"), Some(LiveRole::Command));
        for named in ["foxglove.PoseInFrame", "robot.Command"] {
            let kind = LiveType::of("json", named).unwrap();
            assert!(kind.role().is_none() && !kind.is_image(), "{named}");
        }
        for unknown in [
            ("json", "sensor_msgs/msg/Image"),
            ("cdr", "sensor_msgs/msg/Imu"),
            ("ros1", "x"),
        ] {
            assert_eq!(LiveType::of(unknown.0, unknown.1), None, "{unknown:?}");
        }
    }
}
