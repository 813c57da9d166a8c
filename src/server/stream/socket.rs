//! What every WebSocket of this server needs: its limits, why no message comes any more, and how it ends.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::{Message, WebSocket, close_code};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::time::{Instant, timeout, timeout_at};
use tungstenite::error::ProtocolError;

use super::protocol::{ClosingReason, ErrorCode};
use crate::server::blocking::BlockingWork;
use crate::server::config::ServerConfig;
use crate::server::http::admission::Admission;
use crate::server::http::body_budget::{self, BodyBudgetError};
use crate::server::http::keys::{Caller, Keys};
use crate::server::http::message_bytes::MessageBytes;
use crate::server::http::task_limit::TaskLimit;
use foreframe_core::serving::Predictor;

/// How long a client may take to close the socket after the last message, so that it can read it.
const LINGER: Duration = Duration::from_secs(1);

/// Why no message comes any more.
pub(super) enum InputEnd {
    Gone,
    /// No message for too long.
    Idle,
    /// Bytes that are not a WebSocket message; nothing after them can be read.
    Unreadable(ClosingReason, ErrorCode, String),
}

/// The client has closed the connection: nothing can be sent any more.
pub(super) struct ClientGone;

/// What a stream needs of the server.
pub(in crate::server) struct StreamServices {
    pub(in crate::server) config: Arc<ServerConfig>,
    pub(in crate::server) predictor: Predictor,
    pub(in crate::server) blocking: BlockingWork,
    /// The places of plans among other requests.
    pub(in crate::server) admission: Admission,
    pub(in crate::server) streams: TaskLimit,
    pub(in crate::server) keys: Keys,
    /// Who opened the stream.
    pub(in crate::server) caller: Caller,
    /// Counts the bytes that the connection receives.
    pub(in crate::server) messages: MessageBytes,
}

/// The next message of the protocol; `None` if the client only showed that it is there. The WebSocket library answers pings.
/// Errors: `Idle` at the deadline. A ping does not extend the time for a message that has begun.
pub(super) async fn arrival(
    stream: &mut SplitStream<WebSocket>,
    messages: &MessageBytes,
    deadline: Instant,
) -> Result<Option<Message>, InputEnd> {
    loop {
        match timeout_at(deadline, stream.next()).await {
            Ok(Some(Ok(message @ (Message::Text(_) | Message::Binary(_))))) => return Ok(Some(message)),
            Ok(Some(Ok(Message::Ping(content) | Message::Pong(content)))) => {
                messages.control_read(content.len());
                if !messages.is_unfinished() {
                    return Ok(None);
                }
            }
            Ok(None) => return Err(InputEnd::Gone),
            Ok(Some(Ok(Message::Close(_)))) => {
                // The library answers a close with the next read.
                discard_input(stream).await;
                return Err(InputEnd::Gone);
            }
            Ok(Some(Err(error))) => return Err(unreadable(error)),
            Err(_) => return Err(InputEnd::Idle),
        }
    }
}

/// Why the bytes could not be read.
fn unreadable(error: axum::Error) -> InputEnd {
    let error = error.into_inner();
    if let Some(exceeded) = body_budget::cause(error.as_ref()) {
        let (reason, code) = match exceeded {
            BodyBudgetError::TooLong { .. } => (ClosingReason::TooLong, ErrorCode::Malformed),
            BodyBudgetError::Full { .. } => (ClosingReason::Overloaded, ErrorCode::Overloaded),
        };
        return InputEnd::Unreadable(reason, code, exceeded.to_string());
    }
    let reason = match error.downcast_ref::<tungstenite::Error>() {
        Some(tungstenite::Error::Capacity(_)) => ClosingReason::TooLong,
        Some(tungstenite::Error::Utf8(_)) => ClosingReason::NotUtf8,
        Some(tungstenite::Error::Protocol(ProtocolError::ResetWithoutClosingHandshake)) => return InputEnd::Gone,
        Some(tungstenite::Error::Protocol(_)) => ClosingReason::Malformed,
        _ => return InputEnd::Gone,
    };
    InputEnd::Unreadable(reason, ErrorCode::Malformed, error.to_string())
}

/// Discards input for a moment.
pub(super) async fn discard_input(stream: &mut SplitStream<WebSocket>) {
    let all = async { while let Some(Ok(_)) = stream.next().await {} };
    // A client that has not closed by then gets no more time.
    let _ = timeout(LINGER, all).await;
}

/// Errors: the message cannot be sent within the limit.
pub(super) async fn send(
    sink: &mut SplitSink<WebSocket, Message>,
    message: Message,
    limit: Duration,
) -> Result<(), ClientGone> {
    let sent = timeout(limit, sink.send(message)).await;
    sent.map_err(|_| ClientGone)?.map_err(|_| ClientGone)
}

/// The code of the close frame.
pub(super) fn code_of(reason: ClosingReason) -> u16 {
    match reason {
        ClosingReason::Asked | ClosingReason::Idle | ClosingReason::Deleted => close_code::NORMAL,
        ClosingReason::Replaced | ClosingReason::Revoked => close_code::POLICY,
        ClosingReason::TooLong => close_code::SIZE,
        ClosingReason::Malformed => close_code::PROTOCOL,
        ClosingReason::NotUtf8 => close_code::INVALID,
        ClosingReason::Slow | ClosingReason::Overloaded => close_code::AGAIN,
        ClosingReason::Shutdown => close_code::AWAY,
    }
}
