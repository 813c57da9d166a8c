//! A robot: sends frames when it is told to, and notes what comes back.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use foreframe::server::protocol::{ClientMessage, CloseMessage, ErrorCode, ServerMessage};
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::sync::mpsc;

use crate::workload::{self, Workload};
use crate::session::{self, Socket};

/// What received of a robot's frames, or of many robots'.
#[derive(Default)]
pub(crate) struct FrameCounts {
    pub(crate) sent: u64,
    /// Frames that only filled the context.
    pub(crate) buffering: u64,
    /// Usage in without a prediction, since a newer one waited.
    pub(crate) overtaken: u64,
    /// Refused because the server is too busy.
    pub(crate) overloaded: u64,
    /// Refused for other reasons, and why the first was.
    pub(crate) refused: u64,
    pub(crate) first_refusal: Option<String>,
    /// Left out because they were read too slowly.
    pub(crate) dropped: u64,
    pub(crate) answers: Vec<Answer>,
}

/// A prediction.
#[derive(Clone, Copy)]
pub(crate) struct Answer {
    /// When its frame was to be sent.
    pub(crate) scheduled: Instant,
    /// When its frame was in fact sent.
    pub(crate) sent: Instant,
    /// When it received.
    pub(crate) received: Instant,
    /// Of that the model's computation.
    pub(crate) compute: Duration,
}

impl FrameCounts {
    /// Frames of which nothing was heard again.
    pub(crate) fn unanswered(&self) -> u64 {
        let heard =
            self.answers.len() as u64 + self.buffering + self.overtaken + self.overloaded + self.refused + self.dropped;
        self.sent.saturating_sub(heard)
    }

    pub(crate) fn add(&mut self, other: Self) {
        self.sent += other.sent;
        self.buffering += other.buffering;
        self.overtaken += other.overtaken;
        self.overloaded += other.overloaded;
        self.refused += other.refused;
        self.dropped += other.dropped;
        self.answers.extend(other.answers);
        self.first_refusal = self.first_refusal.take().or(other.first_refusal);
    }
}

/// Sends a frame at each send_time, which is the time that it was scheduled for, and closes after the last. Calls `answered`
/// after each answer.
pub(crate) async fn run(
    socket: Socket,
    workload: Arc<Workload>,
    mut send_times: mpsc::Receiver<Instant>,
    mut answered: impl FnMut(),
) -> FrameCounts {
    let (mut sender, mut receiver) = socket.split();
    // Of every frame when it was to be sent, and when it was.
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
        // If it is gone, the receiver knows as well.
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
                    counts.answers.push(Answer {
                        scheduled,
                        sent,
                        received,
                        compute,
                    });
                    counts.dropped += dropped;
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
