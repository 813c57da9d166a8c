//! Which topics of a robot are subscribed, and how their messages become what a model takes.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::BridgeError;
use super::live_prediction::Seen;
use super::protocol::{self, RobotChannel};
use foreframe_core::nn::{ChannelScale, ModelSpec};
use foreframe_core::types::{Action, RobotState};
use foreframe_data::dataset::import::live::{LiveRole, LiveType, LiveValue};

const IMAGE_TYPES: &str =
    "sensor_msgs/msg/Image or CompressedImage in cdr, or foxglove.RawImage or CompressedImage in protobuf or json";
const ACTION_TYPES: &str = "geometry_msgs/msg/Twist or TwistStamped in cdr or json";
const STATE_TYPES: &str = "nav_msgs/msg/Odometry or sensor_msgs/msg/JointState in cdr or json";

/// The topics as their user names them; without a name, the first of the right type.
#[derive(Clone, Debug, Default)]
pub(crate) struct TopicNames {
    /// The camera.
    pub(crate) image: Option<String>,
    /// The command.
    pub(crate) action: Option<String>,
    /// The odometry.
    pub(crate) state: Option<String>,
    /// What the names of the published topics begin with.
    pub(crate) prefix: String,
}

impl TopicNames {
    /// Errors: `Topic` if one of them is published by the bridge itself.
    pub(super) fn check(&self) -> Result<(), BridgeError> {
        for role in protocol::ROLES {
            let own = self
                .named(role)
                .filter(|topic| protocol::is_published(&self.prefix, topic));
            if let Some(topic) = own {
                return Err(BridgeError::Topic(format!(
                    "--{} names {topic}, which this bridge itself publishes; name a topic of the robot, or another --prefix",
                    word(role)
                )));
            }
        }
        Ok(())
    }

    fn named(&self, role: LiveRole) -> Option<&str> {
        match role {
            LiveRole::Image => self.image.as_deref(),
            LiveRole::Command => self.action.as_deref(),
            LiveRole::Measurement => self.state.as_deref(),
        }
    }
}

/// What a topic is subscribed for, as the options call it.
pub(crate) fn word(role: LiveRole) -> &'static str {
    match role {
        LiveRole::Image => "image",
        LiveRole::Command => "action",
        LiveRole::Measurement => "state",
    }
}

/// What becomes of a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ChannelUse {
    /// It is to be subscribed for this.
    Subscribed(LiveRole),
    /// It could be used for this, but another one was chosen, by its type alone.
    Alternative(LiveRole),
    /// By its name, it has what another bridge predicted.
    Prediction,
    Unused,
}

/// The subscribed topics.
pub(super) struct Topics<'a> {
    names: &'a TopicNames,
    spec: &'a ModelSpec,
    chosen: BTreeMap<LiveRole, ChosenChannel>,
}

struct ChosenChannel {
    id: u64,
    topic: String,
    kind: LiveType,
    /// When the last message came that could be read.
    read_at: Option<Instant>,
}

impl<'a> Topics<'a> {
    pub(super) fn new(names: &'a TopicNames, spec: &'a ModelSpec) -> Self {
        Self {
            names,
            spec,
            chosen: BTreeMap::new(),
        }
    }

    /// What a channel is used for. Errors: `Topic` if it was named for what its messages cannot be.
    pub(super) fn choose(&mut self, channel: &RobotChannel) -> Result<ChannelUse, BridgeError> {
        let RobotChannel { id, topic, .. } = channel;
        let kind = LiveType::of(&channel.encoding, &channel.schema_name);
        let role = self.role(channel, kind)?.filter(|role| self.is_taken(*role));
        let Some((role, kind)) = role.zip(kind) else {
            return Ok(ChannelUse::Unused);
        };
        let is_named = self.names.named(role).is_some();
        if !is_named && protocol::is_published(&self.names.prefix, topic) {
            return Ok(ChannelUse::Unused);
        }
        if !is_named && kind.is_image() && protocol::is_prediction(topic) {
            return Ok(ChannelUse::Prediction);
        }
        if let Some(chosen) = self.chosen.get(&role) {
            let is_other = !is_named && chosen.topic != *topic;
            return Ok(if is_other {
                ChannelUse::Alternative(role)
            } else {
                ChannelUse::Unused
            });
        }
        let chosen = ChosenChannel {
            id: *id,
            topic: topic.clone(),
            kind,
            read_at: None,
        };
        self.chosen.insert(role, chosen);
        Ok(ChannelUse::Subscribed(role))
    }

    fn role(&self, channel: &RobotChannel, kind: Option<LiveType>) -> Result<Option<LiveRole>, BridgeError> {
        for role in protocol::ROLES {
            if self.names.named(role) != Some(channel.topic.as_str()) {
                continue;
            }
            // A command can be measured, and a measurement a command; an image is only an image.
            if kind.is_some_and(|kind| kind.is_image() == (role == LiveRole::Image)) {
                return Ok(Some(role));
            }
            let RobotChannel {
                topic,
                encoding,
                schema_name,
                ..
            } = channel;
            return Err(BridgeError::Topic(format!(
                "the topic {topic} has messages of the type {schema_name:?} in {encoding:?}, which cannot be used for it; images are \
                 {IMAGE_TYPES}; actions and states are {ACTION_TYPES}, {STATE_TYPES}, or any other object with numbers in json"
            )));
        }
        let own = kind.and_then(LiveType::role);
        Ok(own.filter(|own| self.names.named(*own).is_none()))
    }

    /// Whether the model takes it.
    fn is_taken(&self, role: LiveRole) -> bool {
        match role {
            LiveRole::Image => true,
            LiveRole::Command => self.spec.action_inputs().is_some(),
            LiveRole::Measurement => self.spec.state_inputs().is_some(),
        }
    }

    /// The topic that is subscribed for this.
    pub(super) fn topic(&self, role: LiveRole) -> Option<&str> {
        self.chosen.get(&role).map(|chosen| chosen.topic.as_str())
    }

    /// What a prediction needs and does not have, in a sentence each: topics that the robot does not have, topics without messages, and
    /// a camera without images for this long.
    pub(super) fn missing(&self, without_images: Duration) -> Vec<String> {
        let needed = |role: &LiveRole| {
            let can_do_without = *role != LiveRole::Image && self.spec.sees_speeds();
            self.is_taken(*role) && !can_do_without
        };
        let missing = |role| {
            let word = word(role);
            let Some(ChosenChannel { topic, read_at, .. }) = self.chosen.get(&role) else {
                if let Some(topic) = self.names.named(role) {
                    return Some(format!("the robot has no topic {topic}, named by --{word}"));
                }
                return Some(match role {
                    LiveRole::Image => format!("the robot has no topic for the image ({IMAGE_TYPES})"),
                    LiveRole::Command => {
                        format!(
                            "the robot has no topic for the action ({ACTION_TYPES}; others in json are named by --action)"
                        )
                    }
                    LiveRole::Measurement => {
                        format!(
                            "the robot has no topic for the state ({STATE_TYPES}; others in json are named by --state)"
                        )
                    }
                });
            };
            match read_at {
                None => Some(format!("no message of {topic} ({word}) came that can be read")),
                // An action is held, and an old state is noticed by its time.
                Some(at) if role == LiveRole::Image && at.elapsed() >= without_images => {
                    Some(format!("{topic} has no new images that can be read"))
                }
                Some(_) => None,
            }
        };
        protocol::ROLES.into_iter().filter(needed).filter_map(missing).collect()
    }

    /// These channels are gone; others can take their place.
    pub(super) fn forget(&mut self, channels: &[u64]) {
        self.chosen.retain(|_, chosen| !channels.contains(&chosen.id));
    }

    /// What a message holds; `None` for a channel that is gone. Errors: `Message`, `Topic`.
    pub(super) fn read(&mut self, role: LiveRole, payload: &[u8]) -> Result<Option<Seen>, BridgeError> {
        let Some(chosen) = self.chosen.get_mut(&role) else {
            return Ok(None);
        };
        let seen = chosen.read(role, self.spec, payload)?;
        chosen.read_at = Some(Instant::now());
        Ok(Some(seen))
    }
}

impl ChosenChannel {
    fn read(&self, role: LiveRole, spec: &ModelSpec, payload: &[u8]) -> Result<Seen, BridgeError> {
        let Self { topic, kind, .. } = self;
        let wrong = |reason: String| BridgeError::Message {
            topic: topic.clone(),
            reason,
        };
        if role == LiveRole::Image {
            return kind.image(payload).map(Seen::Image).map_err(wrong);
        }
        let values = kind.values(payload).map_err(wrong)?;
        let channels = if role == LiveRole::Command {
            &spec.actions
        } else {
            &spec.states
        };
        let numbers = channels.iter().map(|channel| number(&values, channel));
        let numbers = numbers.collect::<Result<Vec<f32>, String>>();
        let numbers = numbers.map_err(|reason| BridgeError::Topic(format!("the messages of {topic} {reason}")))?;
        let seen = match role {
            LiveRole::Command => Action::try_from(numbers).map(Seen::Action),
            _ => RobotState::try_from(numbers).map(Seen::State),
        };
        seen.map_err(|error| wrong(error.to_string()))
    }
}

/// The number of a model's channel: that of its name or, of the simulator's names, that of a robot on wheels.
fn number(values: &[LiveValue], channel: &ChannelScale) -> Result<f32, String> {
    let of_wheels = match channel.name.as_str() {
        "linear" => "linear.x",
        "angular" => "angular.z",
        other => other,
    };
    let found = values
        .iter()
        .find(|value| value.name == channel.name || value.name == of_wheels);
    found.map(|value| value.value as f32).ok_or_else(|| {
        let known: Vec<&str> = values.iter().map(|value| value.name.as_str()).collect();
        format!(
            "have no \"{}\", which the model takes; they have: {}",
            channel.name,
            known.join(", ")
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::nn::Conditioning;

    fn channel(id: u64, topic: &str, schema_name: &str) -> RobotChannel {
        RobotChannel {
            id,
            topic: topic.to_owned(),
            encoding: "cdr".to_owned(),
            schema_name: schema_name.to_owned(),
        }
    }

    #[test]
    fn the_first_topic_of_a_type_is_chosen_unless_one_is_named() {
        let spec = ModelSpec::default();
        let (any, named) = (
            TopicNames::default(),
            TopicNames {
                image: Some("/rear".to_owned()),
                ..TopicNames::default()
            },
        );
        let (front, rear) = (
            channel(1, "/front", "sensor_msgs/msg/Image"),
            channel(2, "/rear", "sensor_msgs/msg/Image"),
        );
        let mut topics = Topics::new(&any, &spec);
        let image = ChannelUse::Subscribed(LiveRole::Image);
        assert_eq!(topics.choose(&front).unwrap(), image);
        assert_eq!(topics.choose(&rear).unwrap(), ChannelUse::Alternative(LiveRole::Image));
        topics.forget(&[1]);
        assert_eq!(topics.choose(&rear).unwrap(), image);
        let mut topics = Topics::new(&named, &spec);
        assert_eq!(topics.choose(&front).unwrap(), ChannelUse::Unused);
        assert_eq!(topics.choose(&rear).unwrap(), image);
        assert_eq!(
            topics.choose(&rear).unwrap(),
            ChannelUse::Unused,
            "the same topic again"
        );
        let wrong = channel(3, "/rear", "nav_msgs/msg/Odometry");
        assert!(
            topics
                .choose(&wrong)
                .unwrap_err()
                .to_string()
                .contains("cannot be used for it")
        );
    }

    #[test]
    fn what_a_bridge_publishes_is_a_camera_only_if_named() {
        let spec = ModelSpec::default();
        let names = |image: Option<&str>| TopicNames {
            image: image.map(str::to_owned),
            prefix: "/rooms".to_owned(),
            ..TopicNames::default()
        };
        let predicted = |prefix| channel(1, &format!("{prefix}/predicted"), "sensor_msgs/msg/CompressedImage");
        let any = names(None);
        let mut topics = Topics::new(&any, &spec);
        assert_eq!(topics.choose(&predicted("/rooms")).unwrap(), ChannelUse::Unused);
        assert_eq!(topics.choose(&predicted("/moving")).unwrap(), ChannelUse::Prediction);
        let other = names(Some("/moving/predicted"));
        assert!(other.check().is_ok());
        let chosen = Topics::new(&other, &spec).choose(&predicted("/moving")).unwrap();
        assert_eq!(chosen, ChannelUse::Subscribed(LiveRole::Image));
        let error = names(Some("/rooms/predicted")).check().unwrap_err().to_string();
        assert!(error.starts_with("--image names /rooms/predicted, which this bridge itself publishes"));
    }

    #[test]
    fn an_object_in_json_is_used_for_what_its_topic_is_named_for() {
        let spec = ModelSpec {
            conditioning: Conditioning::Action,
            actions: vec![scale("speed")],
            ..ModelSpec::default()
        };
        let json = |topic: &str| RobotChannel {
            encoding: "json".to_owned(),
            ..channel(1, topic, "robot.Command")
        };
        let named = TopicNames {
            action: Some("/command".to_owned()),
            image: Some("/camera".to_owned()),
            ..TopicNames::default()
        };
        let mut topics = Topics::new(&named, &spec);
        assert_eq!(topics.choose(&json("/other")).unwrap(), ChannelUse::Unused);
        let command = ChannelUse::Subscribed(LiveRole::Command);
        assert_eq!(topics.choose(&json("/command")).unwrap(), command);
        let seen = topics
            .read(LiveRole::Command, br#"{"speed":0.5,"mode":"auto"}"#)
            .unwrap();
        let action = Action::try_from(vec![0.5]).unwrap();
        assert!(matches!(seen, Some(Seen::Action(found)) if found == action));
        let error = topics.read(LiveRole::Command, br#"{"velocity":0.5}"#).err().unwrap();
        assert!(
            error
                .to_string()
                .contains("have no \"speed\", which the model takes; they have: velocity")
        );
        assert!(topics.choose(&json("/camera")).is_err(), "it is no image");
    }

    fn scale(name: &str) -> ChannelScale {
        ChannelScale {
            name: name.to_owned(),
            unit: String::new(),
            mean: 0.0,
            std: 1.0,
        }
    }

    #[test]
    fn channels_of_the_simulator_are_those_of_wheels() {
        let value = |name: &str, value| LiveValue {
            name: name.to_owned(),
            value,
        };
        let values = [value("linear.x", 0.5), value("angular.z", 0.25)];
        assert_eq!(number(&values, &scale("linear")), Ok(0.5));
        assert_eq!(number(&values, &scale("angular.z")), Ok(0.25));
        assert!(
            number(&values, &scale("throttle"))
                .unwrap_err()
                .contains("they have: linear.x, angular.z")
        );
    }
}
