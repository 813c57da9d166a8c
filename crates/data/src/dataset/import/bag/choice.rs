//! Which topics become image, action and state: those named by the options, else the only one of its type.

use super::index::{BagIndex, Content, MessageEntry, Topic, ValueStream};
use super::messages::{Projection, RosType};
use crate::dataset::import::options::are_none;
use crate::dataset::import::skipped::listed;
use crate::dataset::import::{ImportError, ImportOptions};
use foreframe_core::types::Channel;

/// A topic of values, and which of its fields are used.
pub(super) struct ChosenValues<'a> {
    pub(super) topic: &'a Topic,
    pub(super) stream: &'a ValueStream,
    /// Positions of the fields.
    pub(super) fields: Vec<usize>,
    pub(super) channels: Vec<Channel>,
}

/// The topics of a data set.
pub(super) struct ChosenTopics<'a> {
    pub(super) image: &'a Topic,
    pub(super) images: &'a [MessageEntry],
    pub(super) actions: Vec<ChosenValues<'a>>,
    pub(super) states: Vec<ChosenValues<'a>>,
    pub(super) projection: Option<&'a Projection>,
}

/// What topics are used for.
struct Role<T> {
    what: &'static str,
    option: &'static str,
    types: &'static str,
    is_of: fn(RosType) -> bool,
    /// What the role needs of a topic; `None` if the topic cannot have the role.
    content: fn(&Topic) -> Option<&T>,
}

const IMAGE: Role<Vec<MessageEntry>> = Role {
    what: "image",
    option: "--image",
    types: "sensor_msgs/msg/Image or CompressedImage",
    is_of: RosType::is_image,
    content: |topic| match &topic.content {
        Content::Images(images) => Some(images),
        _ => None,
    },
};
const ACTION: Role<ValueStream> = Role {
    what: "action",
    option: "--action",
    types: "geometry_msgs/msg/Twist, TwistStamped, nav_msgs/msg/Odometry or sensor_msgs/msg/JointState",
    is_of: RosType::is_command,
    content: values,
};
const STATE: Role<ValueStream> = Role {
    what: "state",
    option: "--state",
    types: "nav_msgs/msg/Odometry, sensor_msgs/msg/JointState, geometry_msgs/msg/Twist or TwistStamped",
    is_of: RosType::is_measurement,
    content: values,
};

fn values(topic: &Topic) -> Option<&ValueStream> {
    match &topic.content {
        Content::Values(stream) => Some(stream),
        _ => None,
    }
}

/// Chooses the topics. Errors: `Option`; it lists the topics that there are.
pub(super) fn choose<'a>(index: &'a BagIndex<'_>, options: &'a ImportOptions) -> Result<ChosenTopics<'a>, ImportError> {
    let choice = Choice {
        topics: &index.topics,
        options,
    };
    let (image, images) = match &options.image {
        Some(name) => choice.named(name, &IMAGE)?,
        None => choice
            .only(&IMAGE)?
            .ok_or_else(|| choice.wrong("no topic of images", &IMAGE))?,
    };
    Ok(ChosenTopics {
        image,
        images,
        actions: choice.values(&options.actions, &ACTION)?,
        states: choice.values(&options.states, &STATE)?,
        projection: choice.projection(&image.name),
    })
}

struct Choice<'a> {
    topics: &'a [Topic],
    options: &'a ImportOptions,
}

impl<'a> Choice<'a> {
    fn wrong<T>(&self, what: &str, role: &Role<T>) -> ImportError {
        let describe = |topic: &Topic| {
            let Topic {
                name,
                type_name,
                messages,
                encoding,
                ..
            } = topic;
            let encoding = match encoding.as_str() {
                "cdr" => String::new(),
                other => format!(", encoded as {other} instead of cdr"),
            };
            format!("{name} ({type_name}, {messages} messages{encoding})")
        };
        // Those that are read come first.
        let (unused, read): (Vec<_>, Vec<_>) = self.topics.iter().partition(|topic| topic.is_unused());
        let known = listed(read.into_iter().chain(unused).map(describe));
        ImportError::Option(format!(
            "the bag has {what}; name one of type {} with {}; its topics are: {known}",
            role.types, role.option
        ))
    }

    /// The topic of that name, and what the role needs of it. Errors: `Option`.
    fn named<T>(&self, name: &str, role: &Role<T>) -> Result<(&'a Topic, &'a T), ImportError> {
        let mut of_name = self.topics.iter().filter(|topic| topic.name == name).peekable();
        let what = match of_name.peek() {
            None => format!("no topic \"{name}\""),
            Some(_) => format!("a topic \"{name}\" that cannot be the {}", role.what),
        };
        let found = of_name.find_map(|topic| Some((topic, (role.content)(topic)?)));
        found.ok_or_else(|| self.wrong(&what, role))
    }

    /// The only topic of the role's types that has messages. Errors: `Option` if there are more.
    fn only<T>(&self, role: &Role<T>) -> Result<Option<(&'a Topic, &'a T)>, ImportError> {
        let of_type = self
            .topics
            .iter()
            .filter(|topic| (role.is_of)(topic.kind) && topic.messages > 0);
        let mut found = of_type.filter_map(|topic| Some((topic, (role.content)(topic)?)));
        let first = found.next();
        if found.next().is_some() {
            let none = if role.option == IMAGE.option { "" } else { " (or none)" };
            return Err(self.wrong(&format!("more than one topic for the {}{none}", role.what), role));
        }
        Ok(first)
    }

    fn values(&self, given: &[String], role: &Role<ValueStream>) -> Result<Vec<ChosenValues<'a>>, ImportError> {
        match given {
            [] => {
                let only = self.only(role)?.into_iter();
                only.map(|found| self.fields(found, None, false)).collect()
            }
            names if are_none(names) => Ok(Vec::new()),
            many => {
                let choose = |text: &String| {
                    let (name, fields) = match text.split_once(':') {
                        Some((name, fields)) => (name, Some(fields)),
                        None => (text.as_str(), None),
                    };
                    self.fields(self.named(name, role)?, fields, many.len() > 1)
                };
                many.iter().map(choose).collect()
            }
        }
    }

    /// The fields of a topic: those of `TOPIC:FIELD,FIELD`, else those that its type has by default.
    fn fields(
        &self,
        (topic, stream): (&'a Topic, &'a ValueStream),
        given: Option<&str>,
        with_topic: bool,
    ) -> Result<ChosenValues<'a>, ImportError> {
        let position = |name: &str| {
            stream.fields.get_index_of(name).ok_or_else(|| {
                let known = listed(stream.fields.keys());
                ImportError::Option(format!(
                    "{} has no field \"{name}\"; its fields are: {known}",
                    topic.name
                ))
            })
        };
        let names = stream.fields.keys();
        let is_default = |&field: &usize| {
            let is_ever_other_than_0 = stream.fields[field].is_ever_other_than_0;
            topic.kind.is_default_field(&names[field], is_ever_other_than_0)
        };
        let fields: Vec<usize> = match given {
            Some(given) => given.split(',').map(position).collect::<Result<_, _>>()?,
            None => (0..names.len()).filter(is_default).collect(),
        };
        let channel = |&field: &usize| {
            let (name, unit) = (&*names[field], stream.fields[field].unit);
            if with_topic {
                let name = format!("{}.{name}", topic.name.trim_start_matches('/'));
                self.options.channel(&name, unit)
            } else {
                self.options.channel(name, unit)
            }
        };
        Ok(ChosenValues {
            topic,
            stream,
            channels: fields.iter().map(channel).collect(),
            fields,
        })
    }

    /// What the camera's `camera_info` says, the one beside the image's topic; none where it changes.
    fn projection(&self, image: &str) -> Option<&'a Projection> {
        self.topics.iter().find_map(|topic| match &topic.content {
            Content::Camera(different) => {
                let folder = topic.name.strip_suffix("camera_info")?;
                match &different[..] {
                    [projection] if image.starts_with(folder) => Some(projection),
                    _ => None,
                }
            }
            _ => None,
        })
    }
}
