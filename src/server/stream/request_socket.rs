//! A WebSocket whose client sends a message and waits for its answer: the sockets of other protocols. The limits are those of a
//! stream.

use std::time::Duration;

use axum::extract::ws::{CloseFrame, Message, WebSocket};
use futures_util::StreamExt as _;
use futures_util::stream::{SplitSink, SplitStream};
use tokio::time::Instant;
use tracing::info;

use super::protocol::ClosingReason;
use super::socket::{ClientGone, InputEnd, StreamServices, arrival, code_of, discard_input, send};
use crate::server::http::task_limit::stop_requested;

/// The rules of a protocol.
pub(in crate::server) trait Responder: Send {
    /// The server's first message, if the protocol has one.
    fn greeting(&self) -> Option<Message>;

    /// The answer to a message; `None` if the client asked for the end.
    fn answer(&mut self, message: Message) -> impl Future<Output = Option<Message>> + Send;

    /// Tells the client why the server cannot read on.
    fn refusal(&self, detail: &str) -> Message;
}

/// How the server ends a connection.
struct Farewell {
    refusal: Option<Message>,
    reason: ClosingReason,
}

/// Answers each message of the client, until one side ends the connection.
pub(in crate::server) async fn answer_all(socket: WebSocket, services: &StreamServices, mut responder: impl Responder) {
    let (mut sink, mut stream) = socket.split();
    let farewell = converse(&mut sink, &mut stream, services, &mut responder).await;
    let client_gone = farewell.is_err();
    if let Ok(farewell) = farewell {
        let limit = Duration::from_millis(services.config.stream_send_ms);
        if part(&mut sink, farewell, limit).await.is_ok() {
            // Closing with unread input would reset the connection before the client has read the reason.
            discard_input(&mut stream).await;
        }
    }
    info!(client_gone, "socket closed");
}

async fn converse(
    sink: &mut SplitSink<WebSocket, Message>,
    stream: &mut SplitStream<WebSocket>,
    services: &StreamServices,
    responder: &mut impl Responder,
) -> Result<Farewell, ClientGone> {
    let limit = Duration::from_millis(services.config.stream_send_ms);
    let mut stopping = services.streams.stopping();
    if let Some(greeting) = responder.greeting() {
        send(sink, greeting, limit).await?;
    }
    loop {
        // The message before this one has its answer.
        services.messages.message_read();
        let message = tokio::select! {
            biased;
            () = stop_requested(&mut stopping) => return Ok(Farewell::of(ClosingReason::Shutdown)),
            () = services.keys.revoked(services.caller) => return Ok(Farewell::of(ClosingReason::Revoked)),
            message = next_message(stream, services) => message,
        };
        let answer = match message {
            Ok(message) => responder.answer(message).await,
            Err(InputEnd::Gone) => return Err(ClientGone),
            Err(InputEnd::Idle) => return Ok(Farewell::of(ClosingReason::Idle)),
            Err(InputEnd::Unreadable(reason, _, detail)) => {
                let refusal = Some(responder.refusal(&detail));
                return Ok(Farewell { refusal, reason });
            }
        };
        let Some(answer) = answer else {
            return Ok(Farewell::of(ClosingReason::Asked));
        };
        send(sink, answer, limit).await?;
    }
}

async fn next_message(stream: &mut SplitStream<WebSocket>, services: &StreamServices) -> Result<Message, InputEnd> {
    let idle = Duration::from_millis(services.config.stream_idle_ms);
    loop {
        if let Some(message) = arrival(stream, &services.messages, Instant::now() + idle).await? {
            return Ok(message);
        }
    }
}

/// Sends the last message, if there is one, and the close frame with its reason.
async fn part(sink: &mut SplitSink<WebSocket, Message>, farewell: Farewell, limit: Duration) -> Result<(), ClientGone> {
    if let Some(refusal) = farewell.refusal {
        send(sink, refusal, limit).await?;
    }
    let (code, reason) = (code_of(farewell.reason), words(farewell.reason).into());
    send(sink, Message::Close(Some(CloseFrame { code, reason })), limit).await
}

impl Farewell {
    fn of(reason: ClosingReason) -> Self {
        Self { refusal: None, reason }
    }
}

/// The reason of the close frame, which the client's library shows to its user.
fn words(reason: ClosingReason) -> &'static str {
    match reason {
        ClosingReason::Asked => "",
        ClosingReason::Idle => "no message came for too long",
        ClosingReason::Replaced => "another connection has taken over",
        ClosingReason::Deleted => "the session was deleted",
        ClosingReason::Slow => "the client reads too slowly",
        ClosingReason::TooLong => "the message is too long",
        ClosingReason::Overloaded => "the server has no memory for the message; try again in 1 s",
        ClosingReason::Malformed => "not a WebSocket message",
        ClosingReason::NotUtf8 => "the text is not UTF-8",
        ClosingReason::Revoked => "the API key was revoked",
        ClosingReason::Shutdown => "the server stops",
    }
}
