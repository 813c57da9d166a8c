//! A robot: sends frames at given times, and records the answers.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use foreframe::server::protocol::{ClientMessage, CloseMessage, ErrorCode, ServerMessage};
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::sync::mpsc;

use crate::session::{self, Socket};
use crate::workload::{self, Workload};

/// Answers to the frames of one robot or of many.
#[derive(Default)]
pub(crate) struct FrameCounts {
    pub(crate) sent: u64,
    /// Frames that only filled the context.
    pub(crate) buffering: u64,
    /// Answered with `overtaken`: a newer frame was waiting.
    pub(crate) overtaken: u64,
    /// Refused because the server is overloaded.
    pub(crate) overloaded: u64,
    /// Refused for other reasons.
    pub(crate) refused: u64,
    pub(crate) first_refusal: Option<String>,
    /// Predictions that the server dropped because this client read too slowly.
    pub(crate) dropped: u64,
    pub(crate) answers: Vec<PredictionTimes>,
    pub(crate) plans: Vec<PredictionTimes>,
    /// Plans that were due while another one was searched for.
    pub(crate) plans_skipped: u64,
}

/// A prediction, or a plan.
#[derive(Clone, Copy)]
pub(crate) struct PredictionTimes {
    /// When its frame was scheduled.
    pub(crate) scheduled: Instant,
    /// When its frame was sent.
    pub(crate) sent: Instant,
    /// When the prediction was received.
    pub(crate) received: Instant,
    /// Time that the model computed, or that the search took.
    pub(crate) compute: Duration,
}

impl FrameCounts {
    /// Frames without an answer.
    pub(crate) fn unanswered(&self) -> u64 {
        let answered =
            self.answers.len() as u64 + self.buffering + self.overtaken + self.overloaded + self.refused + self.dropped;
        self.sent.saturating_sub(answered)
    }

    pub(crate) fn add(&mut self, other: Self) {
        self.sent += other.sent;
        self.buffering += other.buffering;
        self.overtaken += other.overtaken;
        self.overloaded += other.overloaded;
        self.refused += other.refused;
        self.dropped += other.dropped;
        self.answers.extend(other.answers);
        self.plans.extend(other.plans);
        self.plans_skipped += other.plans_skipped;
        self.first_refusal = self.first_refusal.take().or(other.first_refusal);
    }
}

/// Sends a frame for each scheduled time that it receives, and closes the stream after the last. Calls `answered` after
/// each answer.
pub(crate) async fn run(
    socket: Socket,
    workload: Arc<Workload>,
    mut send_times: mpsc::Receiver<Instant>,
    mut answered: impl FnMut(),
) -> FrameCounts {
    let (mut sender, mut receiver) = socket.split();
    // When each frame was scheduled, and when it was sent.
    let log = Mutex::new(Vec::<(Instant, Instant)>::new());
    let sending = async {
        while let Some(scheduled) = send_times.recv().await {
            let frame = workload.frame(log.lock().unwrap().len() as u64);
            log.lock().unwrap().push((scheduled, Instant::now()));
            if sender.send(frame).await.is_err() {
                return;
            }
        }
        let close = workload::message(&ClientMessage::Close(CloseMessage {}));
        // If the stream has ended, the receiver notices it as well.
        let _ = sender.send(close).await;
    };
    let receiving = async {
        let mut counts = FrameCounts::default();
        while let Some((received, message)) = session::receive_timed(&mut receiver).await {
            match message {
                ServerMessage::Prediction {
                    seq, timing, dropped, ..
                } => {
                    let (scheduled, sent) = log.lock().unwrap()[seq as usize];
                    let compute = Duration::from_micros(timing.compute_us);
                    counts.answers.push(PredictionTimes {
                        scheduled,
                        sent,
                        received,
                        compute,
                    });
                    counts.dropped += dropped;
                }
                ServerMessage::Plan {
                    seq, answer, skipped, ..
                } => {
                    let (scheduled, sent) = log.lock().unwrap()[seq as usize];
                    counts.plans.push(PredictionTimes {
                        scheduled,
                        sent,
                        received,
                        compute: answer.time(),
                    });
                    counts.plans_skipped += skipped;
                    continue;
                }
                ServerMessage::Buffering { .. } => counts.buffering += 1,
                ServerMessage::Overtaken { .. } => counts.overtaken += 1,
                ServerMessage::Error {
                    code: ErrorCode::Overloaded,
                    ..
                } => counts.overloaded += 1,
                ServerMessage::Error { code, detail, .. } => {
                    counts.refused += 1;
                    counts.first_refusal.get_or_insert(format!("{code:?}: {detail}"));
                }
                _ => continue,
            }
            answered();
        }
        counts
    };
    let ((), mut counts) = tokio::join!(sending, receiving);
    counts.sent = log.lock().unwrap().len() as u64;
    counts
}
