//! A stream's socket: reads messages, asks the session what to do, sends the answers.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code};
use axum::response::Response;
use tokio::time::timeout;
use tracing::{Instrument, Span, debug, info, trace};

use super::App;
use super::error::ApiError;
use super::extract::Path;
use super::protocol::{self, ClientMessage, ClosingReason, ErrorCode, FrameMessage, SUBPROTOCOL, ServerMessage};
use super::session::{Session, Step, StreamError};
use super::streams;
use crate::registry::Manifest;

/// Opens a stream: a WebSocket that takes frames with action and state and answers each with the frames to come.
/// Sub-protocol `foreframe.v1.json`. Client: `frame`, `ping`, `close`. Server: `ready`, `warming`, `prediction`, `error`,
/// `pong`, `closing`.
#[utoipa::path(
    get, path = "/v1/models/{model}/stream", tag = "models",
    params(("model" = String, Path, description = "The model's name")),
    responses(
        (status = 101, description = "The WebSocket is open"),
        (status = 400, description = "None of the sub-protocols asked for is spoken here", body = super::error::Problem),
        (status = 404, description = "No such model", body = super::error::Problem),
        (status = 426, description = "Not a WebSocket handshake", body = super::error::Problem),
        (status = 503, description = "Too many streams", body = super::error::Problem),
    )
)]
pub(super) async fn stream(
    State(app): State<App>,
    Path(model): Path<String>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, ApiError> {
    let manifest = app.predictor().model(&model)?;
    let upgrade = upgrade.map_err(|_| ApiError::UpgradeRequired)?.protocols([SUBPROTOCOL]);
    if upgrade.selected_protocol().is_none() && upgrade.requested_protocols().next().is_some() {
        return Err(ApiError::Malformed(format!(
            "the sub-protocol spoken here is {SUBPROTOCOL}"
        )));
    }
    let place = app.streams().enter()?;
    let limit = app.config().max_body_bytes;
    let upgrade = upgrade.max_message_size(limit).max_frame_size(limit);
    Ok(upgrade.on_upgrade(move |socket| {
        let stream = Stream {
            session: Session::new(Arc::clone(&manifest)),
            socket,
            app,
        };
        async move {
            stream.run(&manifest).await;
            drop(place);
        }
        .instrument(Span::current())
    }))
}

struct Stream {
    session: Session,
    socket: WebSocket,
    app: App,
}

/// The client is gone or reads too slowly: nothing more can be said to it.
struct Gone;

impl Stream {
    async fn run(mut self, manifest: &Manifest) {
        info!(model.id = %manifest.name, "stream opened");
        if self.serve(manifest).await.is_err() {
            debug!("the client went away");
        }
        info!(frames = self.session.next_seq(), "stream closed");
    }

    async fn serve(&mut self, manifest: &Manifest) -> Result<(), Gone> {
        let (idle_ms, message_bytes) = (self.app.config().stream_idle_ms, self.app.config().max_body_bytes);
        self.send(&ServerMessage::Ready {
            model: manifest.name.clone(),
            version: manifest.version,
            spec: Box::new(manifest.spec.clone()),
            limits: protocol::StreamLimits { message_bytes, idle_ms },
            next_seq: self.session.next_seq(),
        })
        .await?;
        let mut stopping = self.app.streams().stopping();
        loop {
            let message = tokio::select! {
                biased;
                () = streams::told(&mut stopping) => {
                    return self.close(ClosingReason::Shutdown, close_code::AWAY).await;
                }
                message = timeout(Duration::from_millis(idle_ms), self.socket.recv()) => message,
            };
            match message {
                Err(_) => return self.close(ClosingReason::Idle, close_code::NORMAL).await,
                Ok(None | Some(Err(_) | Ok(Message::Close(_)))) => return Err(Gone),
                Ok(Some(Ok(Message::Text(text)))) => match protocol::decode(&text) {
                    Ok(ClientMessage::Close(_)) => return self.close(ClosingReason::Asked, close_code::NORMAL).await,
                    Ok(message) => self.answer(message, &manifest.name).await?,
                    Err(detail) => self.refuse(ErrorCode::Malformed, detail).await?,
                },
                Ok(Some(Ok(Message::Binary(_)))) => {
                    let detail = format!("{SUBPROTOCOL} takes text messages, not binary ones");
                    self.refuse(ErrorCode::Malformed, detail).await?;
                }
                // Answered by the WebSocket itself.
                Ok(Some(Ok(Message::Ping(_) | Message::Pong(_)))) => {}
            }
        }
    }

    async fn answer(&mut self, message: ClientMessage, model: &str) -> Result<(), Gone> {
        match message {
            ClientMessage::Frame(frame) => match self.step(&frame, model).await {
                Ok(answer) => self.send(&answer).await,
                Err(error) => self.refuse(error.code(), error.to_string()).await,
            },
            ClientMessage::Ping(ping) => {
                let timestamp_us = ping.timestamp_us;
                self.send(&ServerMessage::Pong { timestamp_us }).await
            }
            ClientMessage::Close(_) => Ok(()),
        }
    }

    async fn step(&mut self, frame: &FrameMessage, model: &str) -> Result<ServerMessage, StreamError> {
        trace!(seq = frame.seq, "frame");
        match self.session.accept(frame)? {
            Step::Answer(answer) => Ok(answer),
            Step::Predict(input) => {
                let outcome = self.app.predictor().predict(model, input).await;
                self.session.predicted(frame, outcome)
            }
        }
    }

    async fn refuse(&mut self, code: ErrorCode, detail: String) -> Result<(), Gone> {
        let next_seq = self.session.next_seq();
        self.send(&ServerMessage::Error { code, detail, next_seq }).await
    }

    async fn close(&mut self, reason: ClosingReason, code: u16) -> Result<(), Gone> {
        self.send(&ServerMessage::Closing { reason }).await?;
        let frame = CloseFrame {
            code,
            reason: "".into(),
        };
        self.deliver(Message::Close(Some(frame))).await
    }

    async fn send(&mut self, message: &ServerMessage) -> Result<(), Gone> {
        self.deliver(Message::Text(protocol::encode(message).into())).await
    }

    async fn deliver(&mut self, message: Message) -> Result<(), Gone> {
        let limit = Duration::from_millis(self.app.config().stream_send_ms);
        match timeout(limit, self.socket.send(message)).await {
            Ok(Ok(())) => Ok(()),
            _ => Err(Gone),
        }
    }
}
