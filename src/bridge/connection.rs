//! The WebSocket to a robot.

use std::io::ErrorKind;
use std::net::{TcpStream, ToSocketAddrs as _};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use serde_json::Value;
use tungstenite::client::{IntoClientRequest as _, client_with_config};
use tungstenite::http::HeaderValue;
use tungstenite::http::header::SEC_WEBSOCKET_PROTOCOL;
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Bytes, Message, WebSocket};

use super::BridgeError;
use super::protocol::{PublishedTopic, RobotData, RobotMessage, SUBPROTOCOLS, client_data};
use super::robot_stream::{RobotStream, RobotTls};
use foreframe_core::frame::MAX_SIDE_PX;

/// How long a connection may take to open, and a message to be taken by the robot.
const TIMEOUT: Duration = Duration::from_secs(10);
/// How long to wait for a message, between two looks at whether to stop.
const WAIT: Duration = Duration::from_millis(200);
/// The port of Foxglove's bridges.
const DEFAULT_PORT: u16 = 8765;
/// The largest message that is taken: an image of the largest size with 4 bytes a pixel, in base64, with 1 MiB for the rest of it.
const MAX_MESSAGE_BYTES: usize = (MAX_SIDE_PX as usize).pow(2) * 4 / 3 * 4 + (1 << 20);

/// What came from a robot.
pub(super) enum Incoming {
    Message(RobotMessage),
    /// A text that is no message of the protocol, and why.
    Unreadable(String),
    Data {
        subscription: u32,
        time_ns: u64,
        payload: Vec<u8>,
    },
}

/// Where a robot is, and how it is known to be the right one.
pub(crate) struct RobotAddress {
    /// `ws://HOST:PORT` or `wss://HOST:PORT`.
    pub(crate) url: String,
    /// A PEM file with the certificates to trust for `wss://`; without it, those that the system trusts.
    pub(crate) ca_certificate: Option<PathBuf>,
    /// How long nothing may come from it, before the connection counts as lost.
    pub(crate) idle_limit: Duration,
}

/// An open connection.
pub(super) struct RobotConnection {
    address: String,
    socket: WebSocket<RobotStream>,
    idle_limit: Duration,
    /// When the last ping was sent.
    pinged_at: Option<Instant>,
}

impl RobotConnection {
    /// Errors: `Address`, `Connection`, `Tls`.
    pub(super) fn open(address: &RobotAddress) -> Result<Self, BridgeError> {
        let RobotAddress {
            url,
            ca_certificate,
            idle_limit,
        } = address;
        let wrong = || BridgeError::Address(url.clone());
        let mut request = url.into_client_request().map_err(|_| wrong())?;
        let uri = request.uri();
        let host = uri.host().ok_or_else(wrong)?.trim_matches(['[', ']']).to_owned();
        let port = uri.port_u16().unwrap_or(DEFAULT_PORT);
        let tls = match uri.scheme_str() {
            Some("ws") if ca_certificate.is_some() => {
                return Err(BridgeError::Tls(
                    "--ca-certificate is for wss://; ws:// has no certificate".to_owned(),
                ));
            }
            Some("ws") => None,
            Some("wss") => Some(RobotTls::new(ca_certificate.as_deref())?),
            _ => return Err(wrong()),
        };
        let protocols = HeaderValue::from_static(SUBPROTOCOLS);
        request.headers_mut().insert(SEC_WEBSOCKET_PROTOCOL, protocols);
        let opened = connect(&host, port).and_then(|stream| match tls {
            None => Ok(RobotStream::plain(stream)),
            Some(tls) => tls.handshake(host, stream),
        });
        let opened = opened.and_then(|stream| {
            let limits = WebSocketConfig::default()
                .max_message_size(Some(MAX_MESSAGE_BYTES))
                .max_frame_size(Some(MAX_MESSAGE_BYTES));
            let (socket, _) = client_with_config(request, stream, Some(limits)).map_err(|error| error.to_string())?;
            let set = socket.get_ref().tcp().set_read_timeout(Some(WAIT));
            set.map(|()| socket).map_err(|error| error.to_string())
        });
        let address = url.clone();
        match opened {
            Ok(socket) => Ok(Self {
                address,
                socket,
                idle_limit: *idle_limit,
                pinged_at: None,
            }),
            Err(reason) => Err(BridgeError::Connection {
                action: "connect to",
                address,
                reason,
            }),
        }
    }

    fn failed(&self, action: &'static str, error: &tungstenite::Error) -> BridgeError {
        BridgeError::Connection {
            action,
            address: self.address.clone(),
            reason: match error {
                tungstenite::Error::Io(error) if has_waited(error) => format!("it took no data for {TIMEOUT:?}"),
                error => error.to_string(),
            },
        }
    }

    /// What comes next; `None` if nothing came for a while, or something that is not used. Errors: `Connection`, also when the robot
    /// closes it; `Silent`.
    pub(super) fn next(&mut self) -> Result<Option<Incoming>, BridgeError> {
        let message = match self.socket.read() {
            Ok(message) => message,
            Err(tungstenite::Error::Io(error)) if has_waited(&error) => {
                self.ask_if_silent()?;
                return Ok(None);
            }
            Err(error) => return Err(self.failed("read from", &error)),
        };
        Ok(match message {
            Message::Text(text) => Some(match serde_json::from_str(&text) {
                Ok(message) => Incoming::Message(message),
                Err(error) => Incoming::Unreadable(error.to_string()),
            }),
            Message::Binary(bytes) => RobotData::of(&bytes).map(|data| Incoming::Data {
                subscription: data.subscription,
                time_ns: data.time_ns,
                payload: data.payload.to_vec(),
            }),
            _ => None,
        })
    }

    /// Sends a ping if nothing came for half of the limit. A robot that is gone without a word (no power, no network) gives no answer.
    /// Errors: `Silent` if none came for the other half; `Connection`.
    fn ask_if_silent(&mut self) -> Result<(), BridgeError> {
        let heard_at = self.socket.get_ref().heard_at();
        let half = self.idle_limit / 2;
        match self.pinged_at.filter(|pinged_at| *pinged_at > heard_at) {
            Some(pinged_at) if pinged_at.elapsed() >= half => Err(BridgeError::Silent {
                address: self.address.clone(),
                idle_limit: self.idle_limit,
            }),
            None if heard_at.elapsed() >= half => {
                self.write(Message::Ping(Bytes::new()))?;
                self.pinged_at = Some(Instant::now());
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Errors: `Connection`.
    pub(super) fn send(&mut self, message: &Value) -> Result<(), BridgeError> {
        self.write(Message::text(message.to_string()))
    }

    /// Sends data of one of the bridge's topics. Errors: `Connection`.
    pub(super) fn publish(&mut self, topic: PublishedTopic, payload: &[u8]) -> Result<(), BridgeError> {
        self.write(Message::binary(client_data(topic, payload)))
    }

    fn write(&mut self, message: Message) -> Result<(), BridgeError> {
        let sent = self.socket.send(message);
        sent.map_err(|error| self.failed("write to", &error))
    }
}

/// Whether a call ended because nothing came, or went, for its time.
fn has_waited(error: &std::io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
    )
}

/// A connection to the first of the host's addresses where something answers. Errors: why there is none.
fn connect(host: &str, port: u16) -> Result<TcpStream, String> {
    let found = (host, port).to_socket_addrs().map_err(|error| error.to_string())?;
    let mut last = "its name has no address".to_owned();
    for one in found {
        match TcpStream::connect_timeout(&one, TIMEOUT).and_then(|stream| prepare(&stream).map(|()| stream)) {
            Ok(stream) => return Ok(stream),
            Err(error) => last = error.to_string(),
        }
    }
    Err(last)
}

fn prepare(stream: &TcpStream) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.set_write_timeout(Some(TIMEOUT))
}
