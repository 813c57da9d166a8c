//! Which topics of a robot are subscribed, and how their messages become what a model takes.

use std::collections::BTreeMap;

use super::BridgeError;
use super::live_prediction::Seen;
use super::protocol::RobotChannel;
use foreframe_core::nn::{ChannelScale, ModelSpec};
use foreframe_core::types::{Action, RobotState};
use foreframe_data::dataset::import::live::{LiveRole, LiveType, LiveValue};

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
}

impl<'a> Topics<'a> {
    pub(super) fn new(names: &'a TopicNames, spec: &'a ModelSpec) -> Self {
        Self {
            names,
            spec,
            chosen: BTreeMap::new(),
        }
    }

    /// What a channel is to be subscribed for; `None` if it is not needed. Errors: `Topic` if it was named for what its messages cannot
    /// be.
    pub(super) fn choose(&mut self, channel: &RobotChannel) -> Result<Option<LiveRole>, BridgeError> {
        let kind = LiveType::of(&channel.encoding, &channel.schema_name);
        let Some(role) = self.role(channel, kind)? else {
            return Ok(None);
        };
        let Some(kind) = kind.filter(|_| self.is_needed(role) && !self.chosen.contains_key(&role)) else {
            return Ok(None);
        };
        let (id, topic) = (channel.id, channel.topic.clone());
        self.chosen.insert(role, ChosenChannel { id, topic, kind });
        Ok(Some(role))
    }

    fn role(&self, channel: &RobotChannel, kind: Option<LiveType>) -> Result<Option<LiveRole>, BridgeError> {
        let TopicNames {
            image, action, state, ..
        } = self.names;
        let own = kind.and_then(LiveType::role);
        for (name, role) in [
            (image, LiveRole::Image),
            (action, LiveRole::Command),
            (state, LiveRole::Measurement),
        ] {
            if name.as_ref() != Some(&channel.topic) {
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
                 sensor_msgs/msg/Image or CompressedImage in cdr, or foxglove.RawImage or CompressedImage in protobuf or json; commands and \
                 states are geometry_msgs/msg/Twist or TwistStamped, nav_msgs/msg/Odometry or sensor_msgs/msg/JointState in cdr or json, or \
                 any other object with numbers in json"
            )));
        }
        let named = |role| match role {
            LiveRole::Image => image,
            LiveRole::Command => action,
            LiveRole::Measurement => state,
        };
        Ok(own.filter(|own| named(*own).is_none()))
    }

    fn is_needed(&self, role: LiveRole) -> bool {
        match role {
            LiveRole::Image => true,
            LiveRole::Command => self.spec.action_inputs().is_some(),
            LiveRole::Measurement => self.spec.state_inputs().is_some(),
        }
    }

    /// These channels are gone; others can take their place.
    pub(super) fn forget(&mut self, channels: &[u64]) {
        self.chosen.retain(|_, chosen| !channels.contains(&chosen.id));
    }

    /// What a message holds; `None` for a channel that is gone. Errors: `Message`, `Topic`.
    pub(super) fn read(&self, role: LiveRole, payload: &[u8]) -> Result<Option<Seen>, BridgeError> {
        let Some(ChosenChannel { topic, kind, .. }) = self.chosen.get(&role) else {
            return Ok(None);
        };
        let wrong = |reason: String| BridgeError::Message {
            topic: topic.clone(),
            reason,
        };
        if role == LiveRole::Image {
            return kind.image(payload).map(Seen::Image).map(Some).map_err(wrong);
        }
        let values = kind.values(payload).map_err(wrong)?;
        let channels = if role == LiveRole::Command {
            &self.spec.actions
        } else {
            &self.spec.states
        };
        let numbers = channels.iter().map(|channel| number(&values, channel));
        let numbers = numbers.collect::<Result<Vec<f32>, String>>();
        let numbers = numbers.map_err(|reason| BridgeError::Topic(format!("the messages of {topic} {reason}")))?;
        let seen = match role {
            LiveRole::Command => Action::try_from(numbers).map(Seen::Action),
            _ => RobotState::try_from(numbers).map(Seen::State),
        };
        seen.map(Some).map_err(|error| wrong(error.to_string()))
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
        assert_eq!(topics.choose(&front).unwrap(), Some(LiveRole::Image));
        assert_eq!(topics.choose(&rear).unwrap(), None);
        topics.forget(&[1]);
        assert_eq!(topics.choose(&rear).unwrap(), Some(LiveRole::Image));
        let mut topics = Topics::new(&named, &spec);
        assert_eq!(topics.choose(&front).unwrap(), None);
        assert_eq!(topics.choose(&rear).unwrap(), Some(LiveRole::Image));
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
        assert_eq!(topics.choose(&json("/other")).unwrap(), None);
        assert_eq!(topics.choose(&json("/command")).unwrap(), Some(LiveRole::Command));
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
