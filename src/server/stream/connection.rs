//! One WebSocket of a session. Four things run at the same time, each in order: it reads and checks messages, computes
//! the answers to earlier ones, searches for plans that are due, and sends what is ready.

use std::convert::Infallible;
use std::fmt::Display;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::{CloseFrame, Message, WebSocket};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{FutureExt as _, SinkExt as _, StreamExt as _};
use metrics::{Counter, counter};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, timeout};
use tracing::{debug, info, trace};

use super::outbox::Outbox;
use super::plans::{DuePlan, PlanSchedule};
use super::protocol::{
    ClientMessage, ClosingReason, Codec, ConfigureMessage, ErrorCode, FrameMessage, ServerMessage, StreamLimits,
    WarningCode,
};
use super::session::{Owner, Ownership, Session};
use super::socket::{ClientGone, InputEnd, StreamServices, arrival, code_of, discard_input, send};
use super::step::{FrameStep, StepError};
use crate::server::http::task_limit::stop_requested;
use crate::server::images::ImageFormat;
use foreframe_core::error_text::without_middle;
use foreframe_core::frame::resize::Resize;
use foreframe_core::metric_names;

/// A message that is answered in the order in which it came.
enum PipelinedItem {
    Frame(Box<FrameStep>),
    /// With what is dropped when it is answered.
    Configure(Box<ConfigureMessage>, oneshot::Sender<Infallible>),
    Refused(ErrorCode, String),
}

impl PipelinedItem {
    /// The detail loses its middle here already, since it waits in memory.
    fn refused(code: ErrorCode, detail: &dyn Display) -> Self {
        Self::Refused(code, without_middle(detail))
    }
}

pub(in crate::server) struct StreamConnection {
    services: StreamServices,
    ownership: Ownership,
    /// Whether the session outlives the stream.
    is_persistent: bool,
    codec: Codec,
    outbox: Outbox,
    frames: Counter,
    overtaken: Counter,
}

impl StreamConnection {
    /// Takes over the session from the connection before. `is_persistent`: the session outlives the stream.
    pub(in crate::server) fn new(
        services: StreamServices,
        session: &Arc<Session>,
        is_persistent: bool,
        codec: Codec,
    ) -> Self {
        let outbox = Outbox::new(services.config.max_stream_buffer_bytes);
        let ownership = session.connect();
        let model = &session.model.manifest.name;
        Self {
            frames: counter!(metric_names::STREAM_FRAMES, "model" => model.to_string()),
            overtaken: counter!(metric_names::STREAM_OVERTAKEN, "model" => model.to_string()),
            services,
            ownership,
            is_persistent,
            codec,
            outbox,
        }
    }

    pub(in crate::server) async fn run(self, socket: WebSocket) {
        let session = &self.ownership.session;
        info!(session.id = %session.id, model.id = %session.model.manifest.name, "stream opened");
        let (mut sink, mut stream) = socket.split();
        self.outbox.push(self.ready()).await;
        let worked = async {
            let (inbox, items) = mpsc::channel(self.services.config.max_pipelined_frames);
            // The answers never wait for a plan, so there is one at most.
            let (plans, due) = mpsc::channel(1);
            let answered = self.answer(items, plans).map(Ok);
            let reason = tokio::select! {
                ended = async { tokio::try_join!(self.read(&mut stream, inbox), answered) } => ended?.0,
                never = self.plan(due) => match never {},
            };
            self.outbox.close(reason);
            // The writer ends the stream.
            std::future::pending::<Result<(), ClientGone>>().await
        };
        let ended = tokio::select! {
            gone = worked => gone,
            written = self.write(&mut sink) => written,
        };
        if ended.is_ok() {
            // Closing with unread input would reset the connection before the client has read the reason.
            discard_input(&mut stream).await;
        }
        info!(
            frames = self.ownership.session.next_seq(),
            client_gone = ended.is_err(),
            "stream closed"
        );
    }

    fn ready(&self) -> ServerMessage {
        let session = &self.ownership.session;
        let manifest = &session.model.manifest;
        ServerMessage::Ready {
            session: self.is_persistent.then(|| session.id.clone()),
            model: manifest.name.to_string(),
            version: manifest.version,
            spec: Box::new(manifest.spec.clone()),
            limits: StreamLimits::new(&self.services.config, self.is_persistent),
            next_seq: session.next_seq(),
        }
    }

    /// Reads until the stream ends; gives the reason.
    async fn read(
        &self,
        stream: &mut SplitStream<WebSocket>,
        inbox: mpsc::Sender<PipelinedItem>,
    ) -> Result<ClosingReason, ClientGone> {
        let mut stopping = self.services.streams.stopping();
        tokio::select! {
            biased;
            () = stop_requested(&mut stopping) => Ok(ClosingReason::Shutdown),
            owner = self.ownership.lost() => Ok(match owner {
                Owner::Connection(_) => ClosingReason::Replaced,
                Owner::Deleted => ClosingReason::Deleted,
            }),
            () = self.services.keys.revoked(self.services.caller) => Ok(ClosingReason::Revoked),
            end = self.read_all(stream, &inbox) => end,
        }
    }

    async fn read_all(
        &self,
        stream: &mut SplitStream<WebSocket>,
        inbox: &mpsc::Sender<PipelinedItem>,
    ) -> Result<ClosingReason, ClientGone> {
        // Frames are read before the messages ahead of them are answered, so the reader keeps its own copy.
        let mut resize = self.ownership.session.settings().resize;
        loop {
            // The message before this one was decoded: only its frame is left, in the model's size.
            self.services.messages.message_read();
            let message = match self.receive(stream).await {
                Ok(message) => message,
                Err(InputEnd::Gone) => return Err(ClientGone),
                Err(InputEnd::Idle) => return Ok(ClosingReason::Idle),
                Err(InputEnd::Unreadable(reason, code, detail)) => {
                    inbox
                        .send(PipelinedItem::refused(code, &detail))
                        .await
                        .map_err(|_| ClientGone)?;
                    return Ok(reason);
                }
            };
            let item = match self.codec.decode::<ClientMessage>(&message) {
                Ok(ClientMessage::Frame(frame)) => {
                    trace!(seq = frame.seq, "frame");
                    self.frames.increment(1);
                    self.checked(frame, resize).await.map_or_else(
                        |error| PipelinedItem::refused(error.code(), &error),
                        |step| PipelinedItem::Frame(Box::new(step)),
                    )
                }
                Ok(ClientMessage::Configure(message)) => {
                    // It can be large, and refused: nothing more is read until it is answered.
                    let (is_answered, answered) = oneshot::channel();
                    let item = PipelinedItem::Configure(Box::new(message), is_answered);
                    inbox.send(item).await.map_err(|_| ClientGone)?;
                    let _ = answered.await;
                    resize = self.ownership.session.settings().resize;
                    continue;
                }
                Ok(ClientMessage::Ping(ping)) => {
                    let timestamp_us = ping.timestamp_us;
                    self.outbox.push(ServerMessage::Pong { timestamp_us }).await;
                    continue;
                }
                Ok(ClientMessage::Close(_)) => return Ok(ClosingReason::Asked),
                Err(error) => PipelinedItem::refused(ErrorCode::Malformed, &error),
            };
            inbox.send(item).await.map_err(|_| ClientGone)?;
        }
    }

    /// The next message of the protocol. Sends a warning once if none comes for long.
    async fn receive(&self, stream: &mut SplitStream<WebSocket>) -> Result<Message, InputEnd> {
        let quarter = Duration::from_millis(self.services.config.stream_idle_ms) / 4;
        let mut is_warned = false;
        let mut idle_since = Instant::now();
        loop {
            let wait = if is_warned { 4 * quarter } else { 3 * quarter };
            match arrival(stream, &self.services.messages, idle_since + wait).await {
                Ok(Some(message)) => return Ok(message),
                Ok(None) => (is_warned, idle_since) = (false, Instant::now()),
                Err(InputEnd::Idle) if !is_warned => {
                    is_warned = true;
                    let detail = format!("no message came; in {} ms the stream is closed", quarter.as_millis());
                    let code = WarningCode::Idle;
                    self.outbox.push(ServerMessage::Warning { code, detail }).await;
                }
                Err(end) => return Err(end),
            }
        }
    }

    /// The frame, if it fits the model. Raw pixels need no other thread; an image file does.
    async fn checked(&self, message: FrameMessage, resize: Option<Resize>) -> Result<FrameStep, StepError> {
        let manifest = Arc::clone(&self.ownership.session.model.manifest);
        let max_steps = self.services.config.max_steps;
        if message.format == ImageFormat::Raw {
            return FrameStep::new(message, resize, &manifest, max_steps);
        }
        let check = move || FrameStep::new(message, resize, &manifest, max_steps);
        self.services.blocking.run(check).await?
    }

    /// Answers the items in order, until there is no more.
    async fn answer(&self, mut items: mpsc::Receiver<PipelinedItem>, plans: mpsc::Sender<DuePlan>) {
        // A client that never stops sending still gets a prediction at times.
        let limit = self.services.config.max_pipelined_frames;
        let (predictor, blocking) = (&self.services.predictor, &self.services.blocking);
        let (mut following, mut overtaken_in_a_row, mut schedule) = (None, 0, PlanSchedule::new());
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
                    match self.ownership.step(predictor, blocking, *step).await {
                        Ok(answer) => answer,
                        // The reader notices it too, and gives the reason.
                        Err(StepError::NotOwner) => return,
                        Err(error) => self.error(error.code(), without_middle(&error)),
                    }
                }
                PipelinedItem::Configure(message, _is_answered) => self.configure(&message, &mut schedule).await,
                PipelinedItem::Refused(code, detail) => self.error(code, detail),
            };
            if let ServerMessage::Overtaken { .. } = answer {
                self.overtaken.increment(1);
                overtaken_in_a_row += 1;
            } else {
                overtaken_in_a_row = 0;
            }
            let due = schedule.due(&answer, &self.ownership.session, &self.services);
            self.outbox.push(answer).await;
            if let Some(due) = due {
                plans.try_send(due).expect("a second plan that waits is a bug");
            }
        }
    }

    async fn configure(&self, message: &ConfigureMessage, schedule: &mut PlanSchedule) -> ServerMessage {
        let session = &self.ownership.session;
        match schedule.configure(message, session, &self.services).await {
            Ok(()) => session.configure(message),
            Err(error) => self.error(ErrorCode::Invalid, without_middle(&error.into_detail())),
        }
    }

    /// Searches for the plans that are due.
    async fn plan(&self, mut due: mpsc::Receiver<DuePlan>) -> Infallible {
        while let Some(plan) = due.recv().await {
            let _places = plan.places();
            let found = plan.search(&self.ownership.session, &self.services).await;
            self.outbox.push(found).await;
        }
        // The answers have ended, and whoever waits for them ends the stream.
        std::future::pending().await
    }

    fn error(&self, code: ErrorCode, detail: String) -> ServerMessage {
        let next_seq = self.ownership.session.next_seq();
        ServerMessage::Error { code, detail, next_seq }
    }

    /// Sends the messages in the outbox, then the reason for the end. If the client reads nothing for too long, the stream
    /// ends with that reason.
    async fn write(&self, sink: &mut SplitSink<WebSocket, Message>) -> Result<(), ClientGone> {
        let limit = Duration::from_millis(self.services.config.stream_send_ms);
        loop {
            let mut message = self.outbox.next().await;
            if let Ok(sent) = timeout(limit, sink.send(self.codec.encode(&message))).await {
                sent.map_err(|_| ClientGone)?;
            } else {
                debug!("the client does not read");
                let reason = ClosingReason::Slow;
                message = ServerMessage::Closing { reason };
                send(sink, self.codec.encode(&message), limit).await?;
            }
            if let ServerMessage::Closing { reason } = message {
                let (code, reason) = (code_of(reason), "".into());
                return send(sink, Message::Close(Some(CloseFrame { code, reason })), limit).await;
            }
        }
    }
}
