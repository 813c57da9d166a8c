//! One socket of a session: what comes is read and checked while what came before is computed and what was computed is
//! sent, each in order.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::{CloseFrame, Message, WebSocket, close_code};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{FutureExt as _, SinkExt as _, StreamExt as _};
use metrics::{Counter, counter};
use tokio::sync::mpsc;
use tokio::time::timeout;
use tracing::{debug, info, trace};
use tungstenite::error::ProtocolError;

use super::outbox::{Next, Outbox};
use crate::server::error::bounded;
use crate::server::images;
use crate::server::protocol::{
    ClientMessage, ClosingReason, Codec, ConfigureMessage, ErrorCode, FrameMessage, ServerMessage, WarningCode,
};
use crate::server::sessions::core::{FrameStep, StepError};
use crate::server::sessions::limits;
use crate::server::sessions::session::{Hold, Holder, Session};
use crate::server::{App, streams};
use crate::serving::{ConditioningInput, RawConditioning, STEP_FIELDS};
use crate::telemetry::names;
use crate::types::{Action, RobotState};

/// How long a client may take to hang up after the end was said, so that it has read it.
const LINGER: Duration = Duration::from_secs(1);

/// What is answered in the order in which it came.
enum PipelinedItem {
    Frame(Box<FrameStep>),
    Configure(ConfigureMessage),
    Refused(ErrorCode, String),
}

impl PipelinedItem {
    /// What waits to be told is bounded as what is told.
    fn refused(code: ErrorCode, detail: String) -> Self {
        Self::Refused(code, bounded(detail))
    }
}

/// What came over the socket.
enum Received {
    Message(Message),
    /// For too long.
    Nothing,
    /// And after it no more can be told apart.
    Unreadable(ClosingReason, String),
}

/// The client is gone: nothing more can be said to it.
struct ClientGone;

pub(super) struct StreamConnection {
    app: App,
    hold: Hold,
    is_kept: bool,
    codec: Codec,
    outbox: Outbox,
    frames: Counter,
    overtaken: Counter,
}

impl StreamConnection {
    /// Takes the session from whoever holds it.
    pub(super) fn new(app: App, session: &Arc<Session>, is_kept: bool, codec: Codec) -> Self {
        let outbox = Outbox::new(app.config().max_stream_buffer_bytes);
        let hold = session.hold();
        let model = &session.model().manifest.name;
        Self {
            frames: counter!(names::STREAM_FRAMES, "model" => model.clone()),
            overtaken: counter!(names::STREAM_OVERTAKEN, "model" => model.clone()),
            app,
            hold,
            is_kept,
            codec,
            outbox,
        }
    }

    pub(super) async fn run(self, socket: WebSocket) {
        let session = self.hold.session();
        info!(session.id = %session.id(), model.id = %session.model().manifest.name, "stream opened");
        let (mut sink, mut stream) = socket.split();
        self.outbox.push(self.ready()).await;
        let worked = async {
            let (inbox, items) = mpsc::channel(self.app.config().max_pipelined_frames);
            let answered = self.answer(items).map(Ok);
            let (reason, ()) = tokio::try_join!(self.read(&mut stream, inbox), answered)?;
            self.outbox.close(reason);
            // The writer ends the stream.
            std::future::pending::<Result<(), ClientGone>>().await
        };
        let ended = tokio::select! {
            gone = worked => gone,
            written = self.write(&mut sink) => written,
        };
        if ended.is_ok() {
            // Closing with unread bytes would reset the connection before the client has read why.
            read_out(&mut stream).await;
        }
        info!(
            frames = self.hold.session().next_seq(),
            gone = ended.is_err(),
            "stream closed"
        );
    }

    fn ready(&self) -> ServerMessage {
        let session = self.hold.session();
        let manifest = &session.model().manifest;
        ServerMessage::Ready {
            session: self.is_kept.then(|| session.id().to_owned()),
            model: manifest.name.clone(),
            version: manifest.version,
            spec: Box::new(manifest.spec.clone()),
            limits: limits(self.app.config(), self.is_kept),
            next_seq: session.next_seq(),
        }
    }

    /// Reads until the stream shall end; says why.
    async fn read(
        &self,
        stream: &mut SplitStream<WebSocket>,
        inbox: mpsc::Sender<PipelinedItem>,
    ) -> Result<ClosingReason, ClientGone> {
        let mut stopping = self.app.streams().stopping();
        tokio::select! {
            biased;
            () = streams::told(&mut stopping) => Ok(ClosingReason::Shutdown),
            holder = self.hold.lost() => Ok(match holder {
                Holder::Connection(_) => ClosingReason::Replaced,
                Holder::Deleted => ClosingReason::Deleted,
            }),
            end = self.read_all(stream, &inbox) => end,
        }
    }

    async fn read_all(
        &self,
        stream: &mut SplitStream<WebSocket>,
        inbox: &mpsc::Sender<PipelinedItem>,
    ) -> Result<ClosingReason, ClientGone> {
        loop {
            let message = match self.receive(stream).await? {
                Received::Message(message) => message,
                Received::Nothing => return Ok(ClosingReason::Idle),
                Received::Unreadable(reason, detail) => {
                    inbox
                        .send(PipelinedItem::refused(ErrorCode::Malformed, detail))
                        .await
                        .map_err(|_| ClientGone)?;
                    return Ok(reason);
                }
            };
            let item = match self.codec.decode::<ClientMessage>(&message) {
                Ok(ClientMessage::Frame(frame)) => {
                    trace!(seq = frame.seq, "frame");
                    self.frames.increment(1);
                    self.checked(frame).map_or_else(
                        |error| PipelinedItem::refused(error.code(), error.to_string()),
                        PipelinedItem::Frame,
                    )
                }
                Ok(ClientMessage::Configure(message)) => PipelinedItem::Configure(message),
                Ok(ClientMessage::Ping(ping)) => {
                    let timestamp_us = ping.timestamp_us;
                    self.outbox.push(ServerMessage::Pong { timestamp_us }).await;
                    continue;
                }
                Ok(ClientMessage::Close(_)) => return Ok(ClosingReason::Asked),
                Err(error) => PipelinedItem::refused(ErrorCode::Malformed, error.to_string()),
            };
            inbox.send(item).await.map_err(|_| ClientGone)?;
        }
    }

    /// The next message of the protocol, warning once of silence.
    async fn receive(&self, stream: &mut SplitStream<WebSocket>) -> Result<Received, ClientGone> {
        let quarter = Duration::from_millis(self.app.config().stream_idle_ms) / 4;
        let mut is_warned = false;
        loop {
            let wait = if is_warned { quarter } else { 3 * quarter };
            match timeout(wait, stream.next()).await {
                Ok(Some(Ok(message @ (Message::Text(_) | Message::Binary(_))))) => {
                    return Ok(Received::Message(message));
                }
                // Answered by the WebSocket itself; a sign of life.
                Ok(Some(Ok(Message::Ping(_) | Message::Pong(_)))) => is_warned = false,
                Ok(None) => return Err(ClientGone),
                Ok(Some(Ok(Message::Close(_)))) => {
                    // The answer to a close is sent with the next read.
                    read_out(stream).await;
                    return Err(ClientGone);
                }
                Ok(Some(Err(error))) => return unreadable(error),
                Err(_) if is_warned => return Ok(Received::Nothing),
                Err(_) => {
                    is_warned = true;
                    let detail = format!("nothing came; in {} ms the stream is closed", quarter.as_millis());
                    let code = WarningCode::Idle;
                    self.outbox.push(ServerMessage::Warning { code, detail }).await;
                }
            }
        }
    }

    /// The frame, if it fits the model.
    fn checked(&self, message: FrameMessage) -> Result<Box<FrameStep>, StepError> {
        let manifest = &self.hold.session().model().manifest;
        let action = |field| {
            move |values: Vec<f32>| Action::try_from(values).map_err(|source| StepError::Value { field, source })
        };
        let past: Option<Action> = message.action.map(action("action")).transpose()?;
        let plan: Option<Vec<Action>> = message
            .plan
            .map(|plan| plan.into_iter().map(action("plan")).collect())
            .transpose()?;
        let state = message.state.map(RobotState::try_from).transpose();
        let state = state.map_err(|source| StepError::Value { field: "state", source })?;
        let told = RawConditioning {
            past: past.as_slice(),
            future: plan.as_deref(),
            state: state.as_ref(),
        };
        Ok(Box::new(FrameStep {
            seq: message.seq,
            timestamp_us: message.timestamp_us,
            premise: ConditioningInput::new(told, &STEP_FIELDS, &manifest.name, &manifest.spec)?,
            frame: images::decode("image", message.image, message.format, manifest)?,
            format: message.format,
            is_overtaken: false,
        }))
    }

    /// Answers what was read, in order, until there is no more.
    async fn answer(&self, mut items: mpsc::Receiver<PipelinedItem>) {
        // So that who never stops sending hears of the future at times.
        let limit = self.app.config().max_pipelined_frames;
        let (mut following, mut overtaken_in_a_row) = (None, 0);
        loop {
            let item = match following.take() {
                Some(item) => Some(item),
                None => items.recv().await,
            };
            let Some(item) = item else { return };
            following = items.try_recv().ok();
            let answer = match item {
                PipelinedItem::Frame(mut step) => {
                    let is_behind = matches!(&following, Some(PipelinedItem::Frame(newer)) if newer.seq > step.seq);
                    step.is_overtaken = is_behind && overtaken_in_a_row < limit;
                    match self.hold.step(self.app.predictor(), *step).await {
                        Ok(answer) => answer,
                        // The reader has been told as well, and says why.
                        Err(StepError::NotHeld) => return,
                        Err(error) => self.error(error.code(), bounded(error.to_string())),
                    }
                }
                PipelinedItem::Configure(message) => self.hold.session().configure(message),
                PipelinedItem::Refused(code, detail) => self.error(code, detail),
            };
            if let ServerMessage::Overtaken { .. } = answer {
                self.overtaken.increment(1);
                overtaken_in_a_row += 1;
            } else {
                overtaken_in_a_row = 0;
            }
            self.outbox.push(answer).await;
        }
    }

    fn error(&self, code: ErrorCode, detail: String) -> ServerMessage {
        let next_seq = self.hold.session().next_seq();
        ServerMessage::Error { code, detail, next_seq }
    }

    /// Sends what waits until the end, which is said; a client that reads nothing for too long is told so and left.
    async fn write(&self, sink: &mut SplitSink<WebSocket, Message>) -> Result<(), ClientGone> {
        let limit = Duration::from_millis(self.app.config().stream_send_ms);
        loop {
            let (message, reason) = match self.outbox.next().await {
                Next::Message(message) => (message, None),
                Next::Close(reason) => (ServerMessage::Closing { reason }, Some(reason)),
            };
            match timeout(limit, sink.send(self.codec.encode(&message))).await {
                Ok(sent) => sent.map_err(|_| ClientGone)?,
                Err(_) => return self.leave(sink, limit).await,
            }
            if let Some(reason) = reason {
                return close(sink, code_of(reason), limit).await;
            }
        }
    }

    async fn leave(&self, sink: &mut SplitSink<WebSocket, Message>, limit: Duration) -> Result<(), ClientGone> {
        debug!("the client reads nothing");
        let reason = ClosingReason::Slow;
        let last = self.codec.encode(&ServerMessage::Closing { reason });
        timeout(limit, sink.send(last))
            .await
            .map_err(|_| ClientGone)?
            .map_err(|_| ClientGone)?;
        close(sink, code_of(reason), limit).await
    }
}

/// Why what came could not be read, if its sender is still there to be told.
fn unreadable(error: axum::Error) -> Result<Received, ClientGone> {
    let error = error.into_inner();
    let reason = match error.downcast_ref::<tungstenite::Error>() {
        Some(tungstenite::Error::Capacity(_)) => ClosingReason::TooLong,
        Some(tungstenite::Error::Utf8(_)) => ClosingReason::NotUtf8,
        Some(tungstenite::Error::Protocol(ProtocolError::ResetWithoutClosingHandshake)) => return Err(ClientGone),
        Some(tungstenite::Error::Protocol(_)) => ClosingReason::Malformed,
        _ => return Err(ClientGone),
    };
    Ok(Received::Unreadable(reason, error.to_string()))
}

/// Reads what still comes, for a moment.
async fn read_out(stream: &mut SplitStream<WebSocket>) {
    let all = async { while let Some(Ok(_)) = stream.next().await {} };
    // Whoever does not hang up by then is left.
    let _ = timeout(LINGER, all).await;
}

async fn close(sink: &mut SplitSink<WebSocket, Message>, code: u16, limit: Duration) -> Result<(), ClientGone> {
    let frame = CloseFrame {
        code,
        reason: "".into(),
    };
    let sent = timeout(limit, sink.send(Message::Close(Some(frame)))).await;
    sent.map_err(|_| ClientGone)?.map_err(|_| ClientGone)
}

fn code_of(reason: ClosingReason) -> u16 {
    match reason {
        ClosingReason::Asked | ClosingReason::Idle | ClosingReason::Deleted => close_code::NORMAL,
        ClosingReason::Replaced => close_code::POLICY,
        ClosingReason::TooLong => close_code::SIZE,
        ClosingReason::Malformed => close_code::PROTOCOL,
        ClosingReason::NotUtf8 => close_code::INVALID,
        ClosingReason::Slow => close_code::AGAIN,
        ClosingReason::Shutdown => close_code::AWAY,
    }
}
