//! The messages that wait to be sent to a client: a bounded number of bytes. If there is no room, the oldest predictions
//! are dropped. Other messages are never dropped; they wait for room.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use metrics::counter;
use tokio::sync::Notify;

use super::protocol::{ClosingReason, ServerMessage, WarningCode};
use foreframe_core::metric_names;

/// The assumed size of a message without its images and its detail, in bytes: more than any but `ready` takes.
const MESSAGE_BYTES: usize = 512;

pub(super) struct Outbox {
    state: Mutex<OutboxState>,
    changed: Notify,
    limit_bytes: usize,
}

#[derive(Default)]
struct OutboxState {
    waiting: VecDeque<ServerMessage>,
    bytes: usize,
    /// Predictions dropped since the last one that was sent.
    dropped: u64,
    closing: Option<ClosingReason>,
}

impl Outbox {
    pub(super) fn new(limit_bytes: usize) -> Self {
        Self {
            state: Mutex::default(),
            changed: Notify::new(),
            limit_bytes,
        }
    }

    /// Adds a message. A prediction replaces the oldest ones if there is no room; any other message waits for room.
    pub(super) async fn push(&self, message: ServerMessage) {
        if matches!(message, ServerMessage::Prediction { .. }) {
            self.state().push_prediction(message, self.limit_bytes);
        } else {
            self.room().await;
            self.state().push(message);
        }
        self.changed.notify_waiters();
    }

    /// Waits until there is room for one more message.
    async fn room(&self) {
        loop {
            let changed = self.changed.notified();
            tokio::pin!(changed);
            // From here on, no change is missed.
            changed.as_mut().enable();
            if self.state().bytes + MESSAGE_BYTES <= self.limit_bytes.max(MESSAGE_BYTES) {
                return;
            }
            changed.await;
        }
    }

    /// Ends the outbox: after the waiting messages comes only this reason.
    pub(super) fn close(&self, reason: ClosingReason) {
        self.state().closing.get_or_insert(reason);
        self.changed.notify_waiters();
    }

    /// The next message to send; `closing` is the last one.
    pub(super) async fn next(&self) -> ServerMessage {
        loop {
            let changed = self.changed.notified();
            tokio::pin!(changed);
            changed.as_mut().enable();
            let next = self.state().pop();
            if let Some(next) = next {
                self.changed.notify_waiters();
                return next;
            }
            changed.await;
        }
    }

    fn state(&self) -> MutexGuard<'_, OutboxState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl OutboxState {
    fn push(&mut self, message: ServerMessage) {
        self.bytes += bytes(&message);
        self.waiting.push_back(message);
    }

    fn push_prediction(&mut self, message: ServerMessage, limit_bytes: usize) {
        let was_dropping = self.dropped > 0;
        while self.bytes + bytes(&message) > limit_bytes && self.drop_oldest() {}
        if self.dropped > 0 && !was_dropping {
            self.push(slow());
        }
        self.push(message);
    }

    /// Drops the oldest prediction, if there is one.
    fn drop_oldest(&mut self) -> bool {
        let is_prediction = |message: &ServerMessage| matches!(message, ServerMessage::Prediction { .. });
        let oldest = self.waiting.iter().position(is_prediction);
        let Some(message) = oldest.and_then(|oldest| self.waiting.remove(oldest)) else {
            return false;
        };
        self.bytes -= bytes(&message);
        self.dropped += 1;
        counter!(metric_names::STREAM_DROPPED).increment(1);
        true
    }

    fn pop(&mut self) -> Option<ServerMessage> {
        let Some(mut message) = self.waiting.pop_front() else {
            return self.closing.map(|reason| ServerMessage::Closing { reason });
        };
        self.bytes -= bytes(&message);
        if let ServerMessage::Prediction { dropped, .. } = &mut message {
            *dropped = std::mem::take(&mut self.dropped);
        }
        Some(message)
    }
}

fn slow() -> ServerMessage {
    ServerMessage::Warning {
        code: WarningCode::Slow,
        detail: "answers are read too slowly: the oldest predictions are dropped and counted".to_owned(),
    }
}

fn bytes(message: &ServerMessage) -> usize {
    MESSAGE_BYTES
        + match message {
            ServerMessage::Prediction { frames, .. } => frames.iter().map(|frame| frame.0.len()).sum(),
            ServerMessage::Plan { answer, .. } => answer.bytes(),
            ServerMessage::Error { detail, .. } => detail.len(),
            _ => 0,
        }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt as _;
    use proptest::prelude::*;

    use super::*;
    use crate::server::images::{ImageBytes, ImageFormat};
    use crate::server::stream::protocol::Timing;

    fn prediction(seq: u64, size: usize) -> ServerMessage {
        ServerMessage::Prediction {
            seq,
            timestamp_us: 0,
            frames: vec![ImageBytes(vec![0; size])],
            format: ImageFormat::Raw,
            expected_mse: Vec::new(),
            mse_band_90: Vec::new(),
            novelty: None,
            beyond_training: Vec::new(),
            warnings: Vec::new(),
            timing: Timing::default(),
            dropped: 0,
            skipped: 0,
        }
    }

    fn pong(timestamp_us: i64) -> ServerMessage {
        ServerMessage::Pong { timestamp_us }
    }

    #[test]
    fn the_oldest_predictions_are_dropped_and_counted() {
        let mut state = OutboxState::default();
        state.push(pong(1));
        for seq in 0..5 {
            state.push_prediction(prediction(seq, 1000), 4000);
        }
        let mut sent = Vec::new();
        while let Some(message) = state.pop() {
            sent.push(message);
        }
        let kinds: Vec<String> = sent
            .iter()
            .map(|message| match message {
                ServerMessage::Prediction { seq, dropped, .. } => format!("{seq} after {dropped}"),
                ServerMessage::Warning { .. } => "warning".to_owned(),
                _ => "pong".to_owned(),
            })
            .collect();
        assert_eq!(kinds, ["pong", "warning", "4 after 4"]);
        assert_eq!((state.bytes, state.dropped), (0, 0));
    }

    #[test]
    fn other_messages_wait_for_room_and_the_end_comes_last() {
        let outbox = Outbox::new(2 * MESSAGE_BYTES);
        for timestamp_us in 0..2 {
            assert!(outbox.push(pong(timestamp_us)).now_or_never().is_some());
        }
        let mut third = Box::pin(outbox.push(pong(2)));
        assert!(third.as_mut().now_or_never().is_none());
        outbox.close(ClosingReason::Asked);
        assert_eq!(outbox.next().now_or_never(), Some(pong(0)));
        assert!(third.now_or_never().is_some());
        assert_eq!(outbox.next().now_or_never(), Some(pong(1)));
        assert_eq!(outbox.next().now_or_never(), Some(pong(2)));
        let reason = ClosingReason::Asked;
        assert_eq!(outbox.next().now_or_never(), Some(ServerMessage::Closing { reason }));
    }

    proptest! {
        #[test]
        fn the_outbox_stays_within_its_limit_and_counts_drops(
            pushes in proptest::collection::vec((any::<bool>(), 0usize..3000), 0..60),
        ) {
            let (mut state, limit) = (OutboxState::default(), 8000);
            let (mut pushed, mut accounted) = (0, 0);
            let mut count = |state: &mut OutboxState| {
                let next = state.pop();
                if let Some(ServerMessage::Prediction { dropped, .. }) = next {
                    accounted += dropped + 1;
                }
                next.is_some()
            };
            for (is_read, size) in pushes {
                if is_read {
                    count(&mut state);
                } else {
                    state.push_prediction(prediction(pushed, size), limit);
                    pushed += 1;
                }
                // One prediction and the warning are accepted even over the limit.
                prop_assert!(state.bytes <= limit + bytes(&slow()), "{}", state.bytes);
            }
            while count(&mut state) {}
            prop_assert_eq!(pushed, accounted);
        }
    }
}
