//! The messages of Foxglove's WebSocket protocol that the bridge uses: <https://github.com/foxglove/ws-protocol>.

use serde::Deserialize;
use serde_json::{Value, json};

use foreframe_data::dataset::import::live::LiveRole;

/// The sub-protocols that are offered: that of the SDK, and the one of older servers. What the bridge uses is the same in both.
pub(super) const SUBPROTOCOLS: &str = "foxglove.sdk.v1, foxglove.websocket.v1";

/// The first byte of a binary message with data, in both directions.
const MESSAGE_DATA: u8 = 1;
/// So much of a robot's text is repeated in a message.
const MAX_QUOTED_CHARS: usize = 100;

/// What a robot says in text.
#[derive(Debug, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
pub(super) enum RobotMessage {
    ServerInfo {
        #[serde(default)]
        name: String,
        #[serde(default)]
        capabilities: Vec<String>,
    },
    Advertise {
        /// To be read one by one: see [`RobotChannel::read`].
        channels: Vec<Value>,
    },
    Unadvertise {
        channel_ids: Vec<u64>,
    },
    #[serde(other)]
    Other,
}

/// A topic that a robot publishes.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct RobotChannel {
    pub(super) id: u64,
    pub(super) topic: String,
    pub(super) encoding: String,
    #[serde(default)]
    pub(super) schema_name: String,
}

impl RobotChannel {
    /// Errors: which channel it is, and why it cannot be read.
    pub(super) fn read(channel: &Value) -> Result<Self, String> {
        Self::deserialize(channel).map_err(|error| {
            let name = channel["topic"].as_str().map_or_else(
                || "without a topic".to_owned(),
                |topic| topic.chars().take(MAX_QUOTED_CHARS).collect(),
            );
            format!("{name}: {error}")
        })
    }
}

/// What the bridge publishes. The number is that of its channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PublishedTopic {
    Predicted = 1,
    Error = 2,
    ExpectedError = 3,
}

impl PublishedTopic {
    const ALL: [Self; 3] = [Self::Predicted, Self::Error, Self::ExpectedError];

    /// The last part of its name.
    fn name(self) -> &'static str {
        match self {
            Self::Predicted => "predicted",
            Self::Error => "error",
            Self::ExpectedError => "expected_error",
        }
    }

    fn schema_name(self) -> &'static str {
        match self {
            Self::Predicted => "sensor_msgs/msg/CompressedImage",
            Self::Error | Self::ExpectedError => "std_msgs/msg/Float64",
        }
    }
}

/// The request to publish, below a prefix as `/foreframe`.
pub(super) fn advertise(prefix: &str) -> Value {
    let channels = PublishedTopic::ALL.map(|topic| {
        let name = format!("{prefix}/{}", topic.name());
        json!({"id": topic as u32, "topic": name, "encoding": "cdr", "schemaName": topic.schema_name()})
    });
    json!({"op": "advertise", "channels": channels})
}

/// Whether a bridge with this prefix publishes this topic. ROS 2 adds a slash before a name without one.
pub(super) fn is_published(prefix: &str, topic: &str) -> bool {
    let bare = |name: &str| name.trim_start_matches('/').to_owned();
    PublishedTopic::ALL
        .into_iter()
        .any(|published| bare(&format!("{prefix}/{}", published.name())) == bare(topic))
}

/// Whether the name of a topic with images is as another bridge names its predictions.
pub(super) fn is_prediction(topic: &str) -> bool {
    topic.rsplit('/').next() == Some(PublishedTopic::Predicted.name())
}

pub(super) const ROLES: [LiveRole; 3] = [LiveRole::Image, LiveRole::Command, LiveRole::Measurement];

/// The request for the messages of a channel. A subscription has the number of its role.
pub(super) fn subscribe(role: LiveRole, channel: u64) -> Value {
    json!({"op": "subscribe", "subscriptions": [{"id": role as u32, "channelId": channel}]})
}

pub(super) fn role_of(subscription: u32) -> Option<LiveRole> {
    ROLES.into_iter().find(|role| *role as u32 == subscription)
}

/// The message of a client with data of one of its channels.
pub(super) fn client_data(topic: PublishedTopic, payload: &[u8]) -> Vec<u8> {
    [&[MESSAGE_DATA][..], &(topic as u32).to_le_bytes(), payload].concat()
}

/// A robot's message with data.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct RobotData<'a> {
    pub(super) subscription: u32,
    /// When the robot got it, in nanoseconds.
    pub(super) time_ns: u64,
    pub(super) payload: &'a [u8],
}

impl<'a> RobotData<'a> {
    /// `None` for other binary messages (times, assets, answers of services).
    pub(super) fn of(message: &'a [u8]) -> Option<Self> {
        let (&MESSAGE_DATA, rest) = message.split_first()? else {
            return None;
        };
        let (subscription, rest) = rest.split_first_chunk()?;
        let (time_ns, payload) = rest.split_first_chunk()?;
        Some(Self {
            subscription: u32::from_le_bytes(*subscription),
            time_ns: u64::from_le_bytes(*time_ns),
            payload,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_a_robot_are_read() {
        let text = r#"{"op":"advertise","channels":[{"id":3,"topic":"/odom","encoding":"cdr","schemaName":"nav_msgs/msg/Odometry","schema":""}]}"#;
        let RobotMessage::Advertise { channels } = serde_json::from_str(text).unwrap() else {
            panic!()
        };
        let channel = RobotChannel::read(&channels[0]).unwrap();
        assert_eq!((channel.id, &*channel.schema_name), (3, "nav_msgs/msg/Odometry"));
        let wrong = json!({"id": 1, "topic": "/x", "encoding": "json", "schemaName": null});
        let error = RobotChannel::read(&wrong).unwrap_err();
        assert!(error.contains("/x: invalid type: null"), "{error}");
        assert!(RobotChannel::read(&json!(5)).unwrap_err().contains("without a topic"));
        let text = r#"{"op":"unadvertise","channelIds":[3]}"#;
        assert!(
            matches!(serde_json::from_str(text).unwrap(), RobotMessage::Unadvertise { channel_ids } if channel_ids == [3])
        );
        assert!(matches!(
            serde_json::from_str(r#"{"op":"status","level":1}"#).unwrap(),
            RobotMessage::Other
        ));
    }

    #[test]
    fn a_bridge_knows_its_topics_and_those_of_others() {
        for (prefix, topic) in [
            ("/foreframe", "/foreframe/predicted"),
            ("foreframe", "/foreframe/expected_error"),
            ("", "/error"),
        ] {
            assert!(is_published(prefix, topic), "{prefix} {topic}");
        }
        for (prefix, topic) in [
            ("/camera", "/camera/image_raw"),
            ("", "/image"),
            ("/rooms", "/moving/predicted"),
            ("/rooms", "/roomspredicted"),
        ] {
            assert!(!is_published(prefix, topic), "{prefix} {topic}");
        }
        assert!(is_prediction("/moving/predicted") && !is_prediction("/predicted/image"));
    }

    #[test]
    fn data_has_its_subscription_and_time() {
        let message = [&[1, 2, 0, 0, 0][..], &7u64.to_le_bytes(), b"abc"].concat();
        let expected = RobotData {
            subscription: 2,
            time_ns: 7,
            payload: b"abc",
        };
        assert_eq!(RobotData::of(&message), Some(expected));
        assert_eq!(role_of(2), Some(LiveRole::Measurement));
        for other in [&message[..12], &[2, 0][..], &[]] {
            assert_eq!(RobotData::of(other), None);
        }
        assert_eq!(client_data(PublishedTopic::Error, b"x"), b"\x01\x02\0\0\0x");
    }
}
