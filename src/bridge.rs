//! A client of a running robot that speaks Foxglove's WebSocket protocol: subscribes the camera, the command and the odometry,
//! predicts, and publishes what it predicted.
//!
//! `protocol` has the messages, `connection` the socket, `robot_stream` its bytes, `topics` chooses what is subscribed, `live_prediction`
//! brings images to the model's frame rate and compares predictions with what came, `waiting` decides when to say what is missing.

mod connection;
mod live_prediction;
mod protocol;
mod robot_stream;
mod topics;
mod waiting;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde_json::Value;

pub(crate) use self::connection::RobotAddress;
use self::connection::{Incoming, RobotConnection};
pub(crate) use self::live_prediction::LiveStep;
use self::live_prediction::{LivePrediction, Seen};
use self::protocol::{PublishedTopic, RobotChannel, RobotMessage};
use self::topics::{ChannelUse, Topics};
pub(crate) use self::topics::{TopicNames, word};
use self::waiting::Waiting;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::frame::{FrameError, codec};
use foreframe_core::registry::Model;
use foreframe_core::serving::ServingError;
use foreframe_data::dataset::export::live::{number_message, png_message};
use foreframe_data::dataset::import::live::LiveRole;

/// What a robot must let its clients do.
const CLIENT_PUBLISH: &str = "clientPublish";
/// As many topics are named in a sentence.
const MOST_LISTED: usize = 5;

/// Why the bridge ended.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BridgeError {
    /// The address cannot be used.
    #[error("\"{0}\" is no address of a robot; give one like ws://192.168.1.20:8765")]
    Address(String),
    /// TLS cannot be used as it was asked.
    #[error("{0}")]
    Tls(String),
    /// Nothing answers there, or the connection ended.
    #[error("could not {action} the robot at {address}: {reason}")]
    Connection {
        /// `connect to`, …
        action: &'static str,
        /// The robot.
        address: String,
        /// Why.
        reason: String,
    },
    /// The connection is open, but the robot is gone.
    #[error(
        "nothing came from the robot at {address} for {idle_limit:?}, not even the answer to a ping; it may have no power or no network"
    )]
    Silent {
        /// The robot.
        address: String,
        /// For how long.
        idle_limit: Duration,
    },
    /// A text of the robot is no message of the protocol.
    #[error("a text of the robot is no message of Foxglove's protocol: {0}")]
    Text(String),
    /// The robot takes no messages of clients.
    #[error("the robot \"{0}\" takes no messages of clients; start its bridge with the capability clientPublish")]
    NoPublishing(String),
    /// A topic cannot be used as it was asked.
    #[error("{0}")]
    Topic(String),
    /// A message cannot be read.
    #[error("a message of {topic} cannot be read: {reason}")]
    Message {
        /// Its topic.
        topic: String,
        /// Why.
        reason: String,
    },
    /// The model cannot predict.
    #[error(transparent)]
    Serving(#[from] ServingError),
    /// An image cannot be resized or encoded.
    #[error(transparent)]
    Frame(#[from] FrameError),
}

impl HasErrorKind for BridgeError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Address(_) | Self::Tls(_) | Self::Topic(_) => ErrorKind::Usage,
            Self::Connection { .. } | Self::Silent { .. } => ErrorKind::Away,
            Self::NoPublishing(_) | Self::Text(_) | Self::Message { .. } => ErrorKind::Unusable,
            Self::Serving(error) => error.kind(),
            Self::Frame(_) => ErrorKind::Internal,
        }
    }
}

/// What the bridge tells its user.
#[derive(Debug)]
pub(crate) enum BridgeEvent {
    /// It is connected to a robot of that name.
    Connected(String),
    /// It gets messages of a topic.
    Subscribed {
        /// What for.
        role: LiveRole,
        /// The topic.
        topic: String,
    },
    /// It predicted.
    Predicted(LiveStep),
    /// A message could not be read, and was left out.
    LeftOut(BridgeError),
    /// Its user should know this: what it waits for, which topics it could use instead.
    Notice(String),
}

/// What the bridge is to do.
pub(crate) struct BridgeSettings {
    /// The robot.
    pub(crate) address: RobotAddress,
    /// What to subscribe, and under which names to publish.
    pub(crate) names: TopicNames,
    /// How far the times of a state and an image may be apart; an older state does not count.
    pub(crate) state_age_limit: Duration,
}

/// Predicts for a robot until cancelled or until the connection ends. Errors: every [`BridgeError`].
pub(crate) fn run(
    settings: &BridgeSettings,
    model: &Arc<Model>,
    on_event: &mut dyn FnMut(BridgeEvent),
    cancelled: &AtomicBool,
) -> Result<(), BridgeError> {
    settings.names.check()?;
    let mut bridge = Bridge {
        settings,
        robot: RobotConnection::open(&settings.address)?,
        is_introduced: false,
        topics: Topics::new(&settings.names, model.spec()),
        prediction: LivePrediction::new(Arc::clone(model), settings.state_age_limit),
        can_do_without_state: model.spec().sees_speeds(),
        waiting: Waiting::new(model.spec().frame_period_s),
        on_event,
    };
    while !cancelled.load(Ordering::Relaxed) {
        match bridge.robot.next()? {
            None => {}
            Some(Incoming::Message(message)) => bridge.on_message(message)?,
            Some(Incoming::Unreadable(reason)) => (bridge.on_event)(BridgeEvent::LeftOut(BridgeError::Text(reason))),
            Some(Incoming::Data {
                subscription,
                time_ns,
                payload,
            }) => bridge.on_data(subscription, time_ns, &payload)?,
        }
        bridge.say_what_is_missing();
    }
    Ok(())
}

/// A bridge that is connected.
struct Bridge<'a> {
    settings: &'a BridgeSettings,
    robot: RobotConnection,
    /// Whether the robot's `serverInfo` came: before it, nothing can be published.
    is_introduced: bool,
    topics: Topics<'a>,
    prediction: LivePrediction,
    can_do_without_state: bool,
    waiting: Waiting,
    on_event: &'a mut dyn FnMut(BridgeEvent),
}

impl Bridge<'_> {
    fn on_message(&mut self, message: RobotMessage) -> Result<(), BridgeError> {
        match message {
            RobotMessage::ServerInfo { name, capabilities } => {
                if !capabilities.iter().any(|known| known == CLIENT_PUBLISH) {
                    return Err(BridgeError::NoPublishing(name));
                }
                self.robot.send(&protocol::advertise(&self.settings.names.prefix))?;
                self.is_introduced = true;
                (self.on_event)(BridgeEvent::Connected(name));
            }
            RobotMessage::Advertise { channels } => self.subscribe(&channels)?,
            RobotMessage::Unadvertise { channel_ids } => self.topics.forget(&channel_ids),
            RobotMessage::Other => {}
        }
        Ok(())
    }

    /// Subscribes those that are needed, and says what else there is.
    fn subscribe(&mut self, channels: &[Value]) -> Result<(), BridgeError> {
        let (mut unreadable, mut predictions) = (Vec::new(), Vec::new());
        let mut alternatives = BTreeMap::<LiveRole, Vec<String>>::new();
        for channel in channels {
            let channel = match RobotChannel::read(channel) {
                Ok(channel) => channel,
                Err(reason) => {
                    unreadable.push(reason);
                    continue;
                }
            };
            let used = self.topics.choose(&channel)?;
            let RobotChannel { id, topic, .. } = channel;
            match used {
                ChannelUse::Subscribed(role) => {
                    self.robot.send(&protocol::subscribe(role, id))?;
                    (self.on_event)(BridgeEvent::Subscribed { role, topic });
                }
                ChannelUse::Alternative(role) => alternatives.entry(role).or_default().push(topic),
                ChannelUse::Prediction => predictions.push(topic),
                ChannelUse::Unused => {}
            }
        }
        for (role, others) in alternatives {
            let (word, others) = (word(role), listed(&others));
            let chosen = self.topics.topic(role).unwrap_or_default();
            self.notice(format!(
                "{chosen} was chosen as {word} by its type; so could be: {others}; name the right one with --{word}"
            ));
        }
        if !predictions.is_empty() {
            let predictions = listed(&predictions);
            self.notice(format!(
                "not chosen as image, because by their name other bridges predict them: {predictions}; name one with --image to use it"
            ));
        }
        if !unreadable.is_empty() {
            let unreadable = listed(&unreadable);
            self.notice(format!("channels that cannot be read are left out: {unreadable}"));
        }
        Ok(())
    }

    fn on_data(&mut self, subscription: u32, time_ns: u64, payload: &[u8]) -> Result<(), BridgeError> {
        let Some(role) = protocol::role_of(subscription).filter(|_| self.is_introduced) else {
            return Ok(());
        };
        let step = match self.topics.read(role, payload) {
            Ok(None) => None,
            Ok(Some(Seen::Action(action))) => {
                self.prediction.set_action(action);
                None
            }
            Ok(Some(Seen::State(state))) => {
                self.prediction.set_state(state, time_ns);
                None
            }
            Ok(Some(Seen::Image(image))) => self.prediction.step(&image, time_ns)?,
            Err(error @ BridgeError::Message { .. }) => {
                (self.on_event)(BridgeEvent::LeftOut(error));
                None
            }
            Err(error) => return Err(error),
        };
        if let Some(step) = step {
            publish(&mut self.robot, &step)?;
            (self.on_event)(BridgeEvent::Predicted(step));
            if !self.prediction.has_old_state() {
                self.waiting.end();
            }
        }
        Ok(())
    }

    fn say_what_is_missing(&mut self) {
        let time = self.waiting.time();
        let sentence = self.waiting.sentence(|| {
            if !self.is_introduced {
                return vec!["the robot has sent no serverInfo, with which Foxglove's protocol begins".to_owned()];
            }
            let mut missing = self.topics.missing(time);
            if self.prediction.has_old_state() {
                let topic = self.topics.topic(LiveRole::Measurement).unwrap_or("its topic");
                let limit = self.settings.state_age_limit;
                let then = if self.can_do_without_state {
                    "predictions go on without it"
                } else {
                    "predictions pause until a new one comes"
                };
                missing.push(format!(
                    "the last state of {topic} is more than {limit:?} from the last image; {then}"
                ));
            }
            missing
        });
        if let Some(sentence) = sentence {
            self.notice(sentence);
        }
    }

    fn notice(&mut self, text: String) {
        (self.on_event)(BridgeEvent::Notice(text));
    }
}

/// The first ones, and how many others there are.
fn listed(texts: &[String]) -> String {
    let (first, others) = texts.split_at(texts.len().min(MOST_LISTED));
    let first = first.join(", ");
    match others.len() {
        0 => first,
        count => format!("{first} and {count} more"),
    }
}

/// Sends what was predicted, and its errors as far as they are known.
fn publish(robot: &mut RobotConnection, step: &LiveStep) -> Result<(), BridgeError> {
    if let Some(predicted) = &step.predicted {
        let png = codec::encode_png(predicted)?;
        robot.publish(PublishedTopic::Predicted, &png_message(step.predicted_time_ns, &png))?;
    }
    for (topic, value) in [
        (PublishedTopic::Error, step.error),
        (PublishedTopic::ExpectedError, step.expected_error),
    ] {
        if let Some(value) = value {
            robot.publish(topic, &number_message(value))?;
        }
    }
    Ok(())
}
