//! A client of the stream over real sockets, in both sub-protocols.

use axum::http::HeaderValue;
use foreframe::server::ImageBytes;
use foreframe::server::protocol::{ClientMessage, ClosingReason, Codec, FrameMessage, ServerMessage};
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::Value;
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

use crate::service::{TIMEOUT, frame, post};
use foreframe::server::{App, ImageFormat};

pub(crate) type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// Id and token of an opened session.
#[derive(Clone)]
pub(crate) struct SessionHandle {
    pub(crate) id: String,
    pub(crate) token: String,
}

impl SessionHandle {
    pub(crate) fn path(&self, rest: &str) -> String {
        format!("/v1/sessions/{}{rest}?token={}", self.id, self.token)
    }

    pub(crate) async fn open(app: &App, body: &Value) -> Self {
        let answer = post(app, "/v1/sessions", body).await;
        assert_eq!(answer.status, 201, "{}", String::from_utf8_lossy(&answer.body));
        Self::of(&answer.json())
    }

    pub(crate) fn of(answer: &Value) -> Self {
        let text = |field: &str| answer[field].as_str().unwrap().to_owned();
        Self {
            id: text("id"),
            token: text("token"),
        }
    }
}

pub(crate) struct Client {
    pub(crate) socket: Socket,
    codec: Codec,
    pub(crate) next_seq: u64,
}

impl Client {
    /// Opens a stream and reads its `ready`.
    pub(crate) async fn connect(address: std::net::SocketAddr, path: &str, codec: Codec) -> Result<Self, Box<Error>> {
        let mut request = format!("ws://{address}{path}").into_client_request().unwrap();
        let protocol = HeaderValue::from_static(codec.name());
        request.headers_mut().insert("sec-websocket-protocol", protocol);
        let (socket, response) = tokio_tungstenite::connect_async(request).await.map_err(Box::new)?;
        assert_eq!(response.headers()["sec-websocket-protocol"], codec.name());
        let mut client = Self {
            socket,
            codec,
            next_seq: 0,
        };
        let ServerMessage::Ready { next_seq, .. } = client.receive().await else {
            panic!("the first message is not `ready`");
        };
        client.next_seq = next_seq;
        Ok(client)
    }

    pub(crate) async fn send(&mut self, message: &ClientMessage) {
        self.try_send(message).await.unwrap();
    }

    /// Sends text in either sub-protocol.
    pub(crate) async fn send_text(&mut self, text: &str) {
        self.socket.send(Message::text(text)).await.unwrap();
    }

    pub(crate) async fn try_send(&mut self, message: &ClientMessage) -> Result<(), Error> {
        let message = match self.codec {
            Codec::Json => Message::text(serde_json::to_string(message).unwrap()),
            Codec::Msgpack => Message::binary(rmp_serde::to_vec_named(message).unwrap()),
        };
        self.socket.send(message).await
    }

    pub(crate) async fn receive(&mut self) -> ServerMessage {
        self.receive_or_end().await.unwrap()
    }

    /// The next message, or the code of the close frame; no code if the socket ended without one.
    pub(crate) async fn receive_or_end(&mut self) -> Result<ServerMessage, Option<u16>> {
        let message = tokio::time::timeout(TIMEOUT, self.socket.next()).await.unwrap();
        match message {
            Some(Ok(Message::Text(text))) => Ok(serde_json::from_str(&text).unwrap()),
            Some(Ok(Message::Binary(bytes))) => Ok(rmp_serde::from_slice(&bytes).unwrap()),
            Some(Ok(Message::Close(close))) => Err(close.map(|close| u16::from(close.code))),
            _ => Err(None),
        }
    }

    pub(crate) async fn ask(&mut self, message: &ClientMessage) -> ServerMessage {
        self.send(message).await;
        self.receive().await
    }

    /// Reads to the end; returns the reason and the close code.
    pub(crate) async fn end(&mut self) -> (Option<ClosingReason>, Option<u16>) {
        let mut last_reason = None;
        loop {
            match self.receive_or_end().await {
                Ok(ServerMessage::Closing { reason }) => last_reason = Some(reason),
                Ok(_) => {}
                Err(code) => return (last_reason, code),
            }
        }
    }
}

/// A frame whose image, action and state are derived from its `seq`.
pub(crate) fn numbered_frame(seq: u64) -> FrameMessage {
    let value = (seq % 7) as f32 - 3.0;
    FrameMessage {
        steps: None,
        seq,
        timestamp_us: seq as i64 * 1000,
        image: ImageBytes(frame((seq * 37) as u8).pixels().to_vec()),
        format: ImageFormat::Raw,
        action: Some(vec![value, -value]),
        state: Some(vec![value / 2.0]),
        plan: None,
    }
}

pub(crate) fn numbered_message(seq: u64) -> ClientMessage {
    ClientMessage::Frame(numbered_frame(seq))
}
