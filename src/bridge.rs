//! A client of a running robot that speaks Foxglove's WebSocket protocol: subscribes the camera, the command and the odometry,
//! predicts, and publishes what it predicted.
//!
//! `protocol` has the messages, `connection` the socket, `robot_stream` its bytes, `topics` chooses what is subscribed, `live_prediction` brings images to the
//! model's frame rate and compares predictions with what came.

mod connection;
mod live_prediction;
mod protocol;
mod robot_stream;
mod topics;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

pub(crate) use self::connection::RobotAddress;
use self::connection::{Incoming, RobotConnection};
pub(crate) use self::live_prediction::LiveStep;
use self::live_prediction::{LivePrediction, Seen};
use self::protocol::{PublishedTopic, RobotMessage};
pub(crate) use self::topics::TopicNames;
use self::topics::Topics;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::frame::{FrameError, codec};
use foreframe_core::registry::Model;
use foreframe_core::serving::ServingError;
use foreframe_data::dataset::export::live::{number_message, png_message};
use foreframe_data::dataset::import::live::LiveRole;

/// What a robot must let its clients do.
const CLIENT_PUBLISH: &str = "clientPublish";

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
            Self::Connection { .. } => ErrorKind::Away,
            Self::NoPublishing(_) | Self::Message { .. } => ErrorKind::Unusable,
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
}

/// Predicts for the robot at `address` until cancelled or until the connection ends. Errors: every [`BridgeError`].
pub(crate) fn run(
    address: &RobotAddress,
    names: &TopicNames,
    model: &Arc<Model>,
    on_event: &mut dyn FnMut(BridgeEvent),
    cancelled: &AtomicBool,
) -> Result<(), BridgeError> {
    let mut robot = RobotConnection::open(address)?;
    let mut topics = Topics::new(names, model.spec());
    let mut prediction = LivePrediction::new(Arc::clone(model));
    while !cancelled.load(Ordering::Relaxed) {
        match robot.next()? {
            None | Some(Incoming::Message(RobotMessage::Other)) => {}
            Some(Incoming::Message(RobotMessage::ServerInfo { name, capabilities })) => {
                if !capabilities.iter().any(|known| known == CLIENT_PUBLISH) {
                    return Err(BridgeError::NoPublishing(name));
                }
                robot.send(&protocol::advertise(&names.prefix))?;
                on_event(BridgeEvent::Connected(name));
            }
            Some(Incoming::Message(RobotMessage::Advertise { channels })) => {
                for channel in channels {
                    let Some(role) = topics.choose(&channel)? else { continue };
                    robot.send(&protocol::subscribe(role, channel.id))?;
                    let topic = channel.topic;
                    on_event(BridgeEvent::Subscribed { role, topic });
                }
            }
            Some(Incoming::Message(RobotMessage::Unadvertise { channel_ids })) => topics.forget(&channel_ids),
            Some(Incoming::Data {
                subscription,
                time_ns,
                payload,
            }) => {
                let Some(role) = protocol::role_of(subscription) else {
                    continue;
                };
                let seen = match topics.read(role, &payload) {
                    Ok(Some(seen)) => seen,
                    Ok(None) => continue,
                    Err(error @ BridgeError::Message { .. }) => {
                        on_event(BridgeEvent::LeftOut(error));
                        continue;
                    }
                    Err(error) => return Err(error),
                };
                let Some(step) = take(&mut prediction, seen, time_ns)? else {
                    continue;
                };
                publish(&mut robot, &step)?;
                on_event(BridgeEvent::Predicted(step));
            }
        }
    }
    Ok(())
}

fn take(prediction: &mut LivePrediction, seen: Seen, time_ns: u64) -> Result<Option<LiveStep>, BridgeError> {
    match seen {
        Seen::Action(action) => prediction.set_action(action),
        Seen::State(state) => prediction.set_state(state),
        Seen::Image(image) => return prediction.step(&image, time_ns),
    }
    Ok(None)
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
