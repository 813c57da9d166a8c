//! Sessions and their streams.

use std::io;
use std::net::SocketAddr;
use std::time::Instant;

use axum::http::HeaderValue;
use foreframe::server::protocol::{ClientMessage, Codec, ConfigureMessage, OnLate, ServerMessage};
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::json;
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{Error, Message};

use crate::http::{self, Http, Request, Response, TIMEOUT};
use crate::workload;

/// Size of the read buffer: larger than an answer, but small, because it is zeroed before every read.
const READ_BYTES: usize = 32 << 10;

pub(crate) type Socket = WebSocketStream<TcpStream>;

/// Id and token of an opened session.
pub(crate) struct Session {
    id: String,
    token: String,
}

impl Session {
    /// The request that opens a session. It accepts gaps, as robots do that want predictions from new frames.
    pub(crate) fn request(model: &str, on_late: OnLate) -> Request {
        let settings = json!({"model": model, "on_gap": "skip", "on_late": on_late});
        Request::json("/v1/sessions", &settings)
    }

    pub(crate) fn of(answer: &Response) -> Self {
        let answer = answer.json();
        let text = |field: &str| answer[field].as_str().expect("a session has this field").to_owned();
        Self {
            id: text("id"),
            token: text("token"),
        }
    }

    pub(crate) async fn open(http: &mut Http, model: &str, on_late: OnLate) -> Self {
        Self::of(&http.expect(201, &Self::request(model, on_late)).await)
    }

    pub(crate) fn stream_path(&self) -> String {
        format!("/v1/sessions/{}/stream?token={}", self.id, self.token)
    }

    /// The request that exports its state.
    pub(crate) fn export(&self) -> Request {
        Request::get(&format!("/v1/sessions/{}/state?token={}", self.id, self.token))
    }

    pub(crate) fn deletion(&self) -> Request {
        Request::delete(&format!("/v1/sessions/{}?token={}", self.id, self.token))
    }
}

/// Opens a stream and reads its `ready`.
pub(crate) async fn connect(address: SocketAddr, path: &str) -> Result<Socket, Box<Error>> {
    let stream = http::connect(address, None).await.map_err(Error::Io)?;
    over(stream, address, path).await
}

/// The same over an existing socket.
pub(crate) async fn over(stream: TcpStream, address: SocketAddr, path: &str) -> Result<Socket, Box<Error>> {
    let mut socket = Handshake::new(address, path).over(stream).await?;
    ready(&mut socket).await.map(|_| socket)
}

/// Reads `ready`, which says the next frame's sequence number.
pub(crate) async fn ready(socket: &mut Socket) -> Result<u64, Box<Error>> {
    match receive(socket).await {
        Some(ServerMessage::Ready { next_seq, .. }) => Ok(next_seq),
        _ => Err(Box::new(Error::Io(io::ErrorKind::InvalidData.into()))),
    }
}

/// Asks for a plan with every prediction: the best of `samples` plans.
pub(crate) async fn ask_for_plans(socket: &mut Socket, samples: usize) {
    let request =
        json!({"goal": {"position_m": [0.5, 0.1]}, "search": {"solver": {"samples": samples, "iterations": 1}}});
    let configure = ClientMessage::Configure(ConfigureMessage {
        plan_every: Some(1),
        plan_request: serde_json::from_value(request).expect("a request for plans"),
        ..ConfigureMessage::default()
    });
    socket
        .send(workload::message(&configure))
        .await
        .expect("the stream is open");
    let answer = receive(socket).await;
    assert!(matches!(answer, Some(ServerMessage::Configured(_))), "{answer:?}");
}

/// How a stream is opened.
pub(crate) struct Handshake<'a> {
    pub(crate) address: SocketAddr,
    pub(crate) path: &'a str,
    /// The API key.
    pub(crate) key: Option<&'a str>,
    pub(crate) codec: Codec,
}

impl<'a> Handshake<'a> {
    pub(crate) fn new(address: SocketAddr, path: &'a str) -> Self {
        Self {
            address,
            path,
            key: None,
            codec: Codec::Msgpack,
        }
    }

    /// Opens the stream over a connection.
    pub(crate) async fn over(&self, stream: TcpStream) -> Result<Socket, Box<Error>> {
        let mut request = format!("ws://{}{}", self.address, self.path).into_client_request()?;
        let headers = request.headers_mut();
        headers.insert("sec-websocket-protocol", HeaderValue::from_static(self.codec.name()));
        if let Some(key) = self.key {
            let key = HeaderValue::from_str(&format!("Bearer {key}")).expect("a key is ASCII");
            headers.insert("authorization", key);
        }
        let config = WebSocketConfig::default().read_buffer_size(READ_BYTES);
        let (socket, _) = tokio_tungstenite::client_async_with_config(request, stream, Some(config)).await?;
        Ok(socket)
    }
}

/// The next message of the server; none at the end of the stream or after the time limit.
pub(crate) async fn receive(
    socket: &mut (impl futures_util::Stream<Item = Result<Message, Error>> + Unpin),
) -> Option<ServerMessage> {
    receive_timed(socket).await.map(|(_, message)| message)
}

/// The same, with the time of its arrival before it was decoded.
pub(crate) async fn receive_timed(
    socket: &mut (impl futures_util::Stream<Item = Result<Message, Error>> + Unpin),
) -> Option<(Instant, ServerMessage)> {
    loop {
        match timeout(TIMEOUT, socket.next()).await {
            Ok(Some(Ok(Message::Binary(bytes)))) => {
                let received = Instant::now();
                return Some((received, rmp_serde::from_slice(&bytes).unwrap()));
            }
            Ok(Some(Ok(Message::Ping(_) | Message::Pong(_)))) => {}
            _ => return None,
        }
    }
}
