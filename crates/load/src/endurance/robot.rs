//! A robot that streams for the whole run. When its server is killed, it continues from the last exported state of its
//! session. It checks every prediction.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use foreframe::server::protocol::{ErrorCode, OnLate, ServerMessage};
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::json;
use tokio::sync::mpsc;
use tokio::time::{sleep, sleep_until};
use tokio_tungstenite::tungstenite::Error;

use super::recording::RobotRecording;
use super::shared::EnduranceRun;
use crate::http::{self, Http, Request};
use crate::session::{self, Handshake, Session, Socket};

/// Frames that are sent before the earlier ones are answered.
const MAX_IN_FLIGHT: usize = 16;
/// The state is exported after this many frames.
const EXPORT_PERIOD: u64 = 60;
/// A robot that is later than this leaves out frames: it wants predictions from new ones.
const MAX_LATE: Duration = Duration::from_millis(500);
/// Pause between attempts to connect.
const RECONNECT_PERIOD: Duration = Duration::from_millis(100);

/// A correct answer with a prediction.
#[derive(Clone, Copy)]
pub(super) struct RobotAnswer {
    /// When its frame was scheduled.
    pub(super) scheduled: Instant,
    pub(super) latency: Duration,
    /// Whether its frame was new, and not sent again after the stream was lost.
    pub(super) is_live: bool,
}

/// What a robot saw.
#[derive(Default)]
pub(super) struct RobotReport {
    pub(super) answers: Vec<RobotAnswer>,
    /// How often it continued from an exported state.
    pub(super) restored: u64,
    /// Frames that were sent again.
    pub(super) sent_again: u64,
    /// Frames that were left out because the stream was away or busy.
    pub(super) left_out: u64,
    /// Refused because the server was overloaded, and sent again.
    pub(super) overloaded: u64,
    /// Times from the loss of a stream until a new frame was answered.
    pub(super) recoveries: Vec<Duration>,
    /// Frames without an answer at the end.
    pub(super) unanswered: u64,
}

pub(super) struct EnduranceRobot {
    run: Arc<EnduranceRun>,
    recording: RobotRecording,
    /// When frame 0 was due; moved on when frames are left out.
    begin: Instant,
    period: Duration,
    session: Option<Session>,
    /// The last exported state, as JSON.
    state: Option<String>,
    exported: (mpsc::Sender<String>, mpsc::Receiver<String>),
    /// The next frame to send, the next to be answered, and the first that was never sent.
    next: u64,
    answered: u64,
    never_sent: u64,
    /// When each frame in flight was scheduled, and whether it is new.
    in_flight: VecDeque<(Instant, bool)>,
    /// When the stream was lost, until a new frame is answered.
    lost: Option<Instant>,
    report: RobotReport,
}

impl EnduranceRobot {
    pub(super) fn new(run: Arc<EnduranceRun>, recording: RobotRecording, begin: Instant, rate_hz: f64) -> Self {
        Self {
            run,
            recording,
            begin,
            period: Duration::from_secs_f64(1.0 / rate_hz),
            session: None,
            state: None,
            exported: mpsc::channel(1),
            next: 0,
            answered: 0,
            never_sent: 0,
            in_flight: VecDeque::new(),
            lost: None,
            report: RobotReport::default(),
        }
    }

    /// Streams until the end of the run.
    pub(super) async fn run(mut self) -> RobotReport {
        let mut http = Http::new(self.run.address);
        loop {
            let since = self.run.availability.now();
            let Some((socket, next)) = self.connect(&mut http).await else {
                sleep(RECONNECT_PERIOD).await;
                continue;
            };
            (self.next, self.answered) = (next, next);
            self.in_flight.clear();
            match self.stream(socket).await {
                Ok(()) => break,
                Err(reason) => {
                    self.lost.get_or_insert_with(Instant::now);
                    if self.run.availability.was_up_since(since) {
                        self.run
                            .fault(format!("a stream was lost from a running server: {reason}"));
                    }
                }
            }
        }
        self.report.unanswered = self.never_sent - self.answered;
        self.report
    }

    fn due(&self, seq: u64) -> Instant {
        self.begin + self.period.mul_f64(seq as f64)
    }

    /// Connects to the session, or to a new one with the exported state. Returns also the next frame.
    async fn connect(&mut self, http: &mut Http) -> Option<(Socket, u64)> {
        if self.session.is_none() {
            self.session = Some(self.open(http).await?);
        }
        let path = self.session.as_ref()?.stream_path();
        let handshake = Handshake {
            key: Some(&self.run.robot_key),
            ..Handshake::new(self.run.address, &path)
        };
        let stream = http::connect(self.run.address, None).await.ok()?;
        match handshake.over(stream).await.map_err(|error| *error) {
            Ok(mut socket) => {
                let next = session::ready(&mut socket).await.ok()?;
                Some((socket, next))
            }
            Err(Error::Http(answer)) if matches!(answer.status().as_u16(), 404 | 410) => {
                self.session = None;
                None
            }
            Err(Error::Http(answer)) if answer.status() != 503 => {
                self.run.fault(format!("a stream was refused with {}", answer.status()));
                None
            }
            Err(_) => None,
        }
    }

    async fn open(&mut self, http: &mut Http) -> Option<Session> {
        let request = match &self.state {
            Some(state) => Request::post(
                "/v1/sessions",
                "application/json",
                format!(r#"{{"state":{state}}}"#).as_bytes(),
            ),
            None => Request::json(
                "/v1/sessions",
                &json!({"model": self.run.workload.model(), "on_late": OnLate::Predict}),
            ),
        };
        let answer = http.ask(&request.with_key(&self.run.robot_key)).await.ok()?;
        if answer.status == 201 {
            self.report.restored += u64::from(self.state.is_some());
            return Some(Session::of(&answer));
        }
        if !answer.is_refusal() {
            self.run
                .fault(format!("a session was refused: {} {}", answer.status, answer.text()));
        }
        None
    }

    /// Sends and checks until the end of the run. Errors: why the stream was lost.
    async fn stream(&mut self, socket: Socket) -> Result<(), String> {
        let (mut sender, mut receiver) = socket.split();
        loop {
            self.leave_out_late_frames();
            let (is_over, is_new) = (self.run.is_over(), self.next >= self.never_sent);
            if is_over && is_new && self.in_flight.is_empty() {
                return Ok(());
            }
            let may_send = self.in_flight.len() < MAX_IN_FLIGHT && !(is_over && is_new);
            tokio::select! {
                () = sleep_until(self.due(self.next).into()), if may_send => {
                    let sent = sender.send(self.recording.frame(self.next)).await;
                    self.sent();
                    sent.map_err(|error| error.to_string())?;
                }
                received = session::receive_timed(&mut receiver) => {
                    let (at, message) = received.ok_or("the connection ended")?;
                    self.take(at, message)?;
                }
                Some(state) = self.exported.1.recv() => self.state = Some(state),
            }
        }
    }

    fn sent(&mut self) {
        let is_new = self.next >= self.never_sent;
        self.report.sent_again += u64::from(!is_new);
        self.in_flight.push_back((self.due(self.next), is_new));
        self.next += 1;
        self.never_sent = self.never_sent.max(self.next);
        if self.next.is_multiple_of(EXPORT_PERIOD) && self.lost.is_none() {
            self.export();
        }
    }

    /// Exports the session's state on another connection.
    fn export(&self) {
        let Some(session) = &self.session else { return };
        let request = session.export().with_key(&self.run.robot_key);
        let (run, exported) = (Arc::clone(&self.run), self.exported.0.clone());
        tokio::spawn(async move {
            // After a failure, the next export comes soon.
            if let Ok(answer) = Http::new(run.address).ask(&request).await
                && answer.status == 200
            {
                let _ = exported.try_send(answer.text());
            }
        });
    }

    /// Moves the schedule on if the next new frame is too late.
    fn leave_out_late_frames(&mut self) {
        let late = Instant::now().saturating_duration_since(self.due(self.never_sent));
        if late > MAX_LATE {
            let frames = (late.as_secs_f64() / self.period.as_secs_f64()) as u64;
            self.report.left_out += frames;
            self.begin += self.period.mul_f64(frames as f64);
        }
    }

    /// Checks a message. Errors: the stream cannot go on.
    fn take(&mut self, at: Instant, message: ServerMessage) -> Result<(), String> {
        let expected = self.answered;
        match message {
            ServerMessage::Prediction {
                seq, frames, dropped, ..
            } if seq == expected && dropped == 0 => {
                if !self.recording.is_right(seq, &frames) {
                    self.run.fault("a prediction of a stream was not the library's");
                }
                let (scheduled, is_live) = *self.in_flight.front().ok_or("an answer without a frame")?;
                self.report.answers.push(RobotAnswer {
                    scheduled,
                    latency: at.saturating_duration_since(scheduled),
                    is_live,
                });
                if let Some(lost) = self.lost.take_if(|_| is_live) {
                    self.report.recoveries.push(at - lost);
                }
            }
            ServerMessage::Buffering { seq, .. } if seq == expected && self.recording.is_buffered(seq) => {}
            ServerMessage::Error {
                code: ErrorCode::Overloaded,
                ..
            } => {
                // The frames behind it are refused as well: connect again, and continue with the frame that is due.
                self.report.overloaded += 1;
                return Err("a frame was refused as overload".to_owned());
            }
            ServerMessage::Warning { .. } | ServerMessage::Pong { .. } => return Ok(()),
            ServerMessage::Closing { reason } => return Err(format!("closing: {reason:?}")),
            other => {
                let what: String = format!("{other:?}").chars().take(120).collect();
                return Err(format!("frame {expected} was answered with {what}"));
            }
        }
        self.in_flight.pop_front();
        self.answered += 1;
        Ok(())
    }
}
