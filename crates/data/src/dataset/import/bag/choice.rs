//! Which topics become image, action and state: those named by the options, else the only one of its type.

use super::index::{BagIndex, Content, Topic, ValueStream};
use super::messages::{Projection, RosType};
use crate::dataset::import::skipped::listed;
use crate::dataset::import::{ImportError, ImportOptions};
use foreframe_core::types::Channel;

/// In place of a topic: none at all.
const NONE: &str = "none";

/// A topic of values, and which of its fields are used.
pub(super) struct ChosenValues {
    /// Position of the topic.
    pub(super) topic: usize,
    /// Positions of the fields.
    pub(super) fields: Vec<usize>,
    pub(super) channels: Vec<Channel>,
}

/// The topics of a data set, by position.
pub(super) struct ChosenTopics {
    pub(super) image: usize,
    pub(super) actions: Vec<ChosenValues>,
    pub(super) states: Vec<ChosenValues>,
    pub(super) projection: Option<Projection>,
}

/// What topics are used for.
struct Role {
    what: &'static str,
    option: &'static str,
    types: &'static str,
    is_of: fn(RosType) -> bool,
}

const IMAGE: Role = Role {
    what: "image",
    option: "--image",
    types: "sensor_msgs/msg/Image or CompressedImage",
    is_of: RosType::is_image,
};
const ACTION: Role = Role {
    what: "action",
    option: "--action",
    types: "geometry_msgs/msg/Twist, TwistStamped, nav_msgs/msg/Odometry or sensor_msgs/msg/JointState",
    is_of: RosType::is_command,
};
const STATE: Role = Role {
    what: "state",
    option: "--state",
    types: "nav_msgs/msg/Odometry, sensor_msgs/msg/JointState, geometry_msgs/msg/Twist or TwistStamped",
    is_of: RosType::is_measurement,
};

/// Chooses the topics. Errors: `Option`; it lists the topics that there are.
pub(super) fn choose(index: &BagIndex<'_>, options: &ImportOptions) -> Result<ChosenTopics, ImportError> {
    let choice = Choice { index, options };
    let image = match &options.image {
        Some(name) => choice.named(name, &IMAGE)?,
        None => choice
            .only(&IMAGE)?
            .ok_or_else(|| choice.wrong("no topic of images", &IMAGE))?,
    };
    Ok(ChosenTopics {
        image,
        actions: choice.values(&options.actions, &ACTION)?,
        states: choice.values(&options.states, &STATE)?,
        projection: choice.projection(image),
    })
}

struct Choice<'a> {
    index: &'a BagIndex<'a>,
    options: &'a ImportOptions,
}

impl Choice<'_> {
    fn topics(&self) -> &[Topic] {
        &self.index.topics
    }

    fn wrong(&self, what: &str, role: &Role) -> ImportError {
        let describe = |topic: &Topic| {
            let encoding = match topic.encoding.as_str() {
                "cdr" => String::new(),
                other => format!(", encoded as {other} instead of cdr"),
            };
            format!(
                "{} ({}, {} messages{encoding})",
                topic.name, topic.type_name, topic.messages
            )
        };
        // Those that are read come first.
        let is_read = |topic: &&Topic| !matches!(topic.content, Content::Unused);
        let read = self.topics().iter().filter(is_read);
        let others = self.topics().iter().filter(|topic| !is_read(topic));
        let known = listed(read.chain(others).map(describe));
        ImportError::Option(format!(
            "the bag has {what}; name one of type {} with {}; its topics are: {known}",
            role.types, role.option
        ))
    }

    /// The topic of that name. Errors: `Option`.
    fn named(&self, name: &str, role: &Role) -> Result<usize, ImportError> {
        let of_name = || self.topics().iter().enumerate().filter(|(_, topic)| topic.name == name);
        if of_name().next().is_none() {
            return Err(self.wrong(&format!("no topic \"{name}\""), role));
        }
        let is_right = |topic: &Topic| match topic.content {
            Content::Images(_) => role.option == IMAGE.option,
            Content::Values(_) => role.option != IMAGE.option,
            _ => false,
        };
        let right = of_name().find(|(_, topic)| is_right(topic));
        right
            .map(|(position, _)| position)
            .ok_or_else(|| self.wrong(&format!("a topic \"{name}\" that cannot be the {}", role.what), role))
    }

    /// The only topic of the role's types that has messages. Errors: `Option` if there are more.
    fn only(&self, role: &Role) -> Result<Option<usize>, ImportError> {
        let is_of =
            |topic: &Topic| (role.is_of)(topic.kind) && topic.messages > 0 && !matches!(topic.content, Content::Unused);
        let mut found = (0..self.topics().len()).filter(|&position| is_of(&self.topics()[position]));
        let first = found.next();
        if found.next().is_some() {
            let none = if role.option == IMAGE.option { "" } else { " (or none)" };
            return Err(self.wrong(&format!("more than one topic for the {}{none}", role.what), role));
        }
        Ok(first)
    }

    fn values(&self, given: &[String], role: &Role) -> Result<Vec<ChosenValues>, ImportError> {
        match given {
            [] => {
                let only = self.only(role)?.into_iter();
                only.map(|topic| self.fields(topic, None, false, role)).collect()
            }
            [one] if one == NONE => Ok(Vec::new()),
            many => {
                let choose = |text: &String| {
                    let (name, fields) = match text.split_once(':') {
                        Some((name, fields)) => (name, Some(fields)),
                        None => (text.as_str(), None),
                    };
                    self.fields(self.named(name, role)?, fields, many.len() > 1, role)
                };
                many.iter().map(choose).collect()
            }
        }
    }

    /// The fields of a topic: those of `TOPIC:FIELD,FIELD`, else those that its type has by default.
    fn fields(
        &self,
        position: usize,
        given: Option<&str>,
        with_topic: bool,
        role: &Role,
    ) -> Result<ChosenValues, ImportError> {
        let topic = &self.topics()[position];
        let Content::Values(stream) = &topic.content else {
            return Err(self.wrong(&format!("no values in \"{}\"", topic.name), role));
        };
        let fields = match given {
            Some(given) => given
                .split(',')
                .map(|name| field_position(stream, topic, name))
                .collect::<Result<Vec<_>, _>>()?,
            None => (0..stream.fields.len())
                .filter(|&field| {
                    let (name, changed) = (&stream.fields[field].0, stream.is_ever_other_than_0[field]);
                    topic.kind.is_default_field(name, changed)
                })
                .collect(),
        };
        let channel = |&field: &usize| {
            let (name, unit) = &stream.fields[field];
            let name = if with_topic {
                format!("{}.{name}", topic.name.trim_start_matches('/'))
            } else {
                name.clone()
            };
            let given = self.options.unit(&name);
            Channel::new(&name, if given.is_empty() { unit } else { &given })
        };
        Ok(ChosenValues {
            topic: position,
            channels: fields.iter().map(channel).collect(),
            fields,
        })
    }

    /// What the camera's `camera_info` says: the one beside the image's topic.
    fn projection(&self, image: usize) -> Option<Projection> {
        let image = &self.topics()[image].name;
        self.topics().iter().find_map(|topic| match &topic.content {
            Content::Camera(found) => {
                let folder = topic.name.strip_suffix("camera_info")?;
                found.filter(|_| image.starts_with(folder))
            }
            _ => None,
        })
    }
}

fn field_position(stream: &ValueStream, topic: &Topic, name: &str) -> Result<usize, ImportError> {
    let found = stream.fields.iter().position(|(field, _)| field == name);
    found.ok_or_else(|| {
        ImportError::Option(format!(
            "{} has no field \"{name}\"; its fields are: {}",
            topic.name,
            listed(stream.fields.iter().map(|(field, _)| field))
        ))
    })
}
