//! How much memory the messages of one WebSocket take: part of the budget for all bodies in flight.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::body_budget::{BodyBudget, BodyShare};

/// This many bytes of a stream do not count: the buffer that each stream has in any case. So streams of small frames
/// continue when large bodies have used up the budget.
pub(in crate::server) const UNCOUNTED_BYTES: usize = 16 << 10;

/// The bytes of the message that a WebSocket receives. Its connection adds them as they arrive, its stream resets them
/// when the message is handled. The largest message so far stays counted until the stream ends, because the WebSocket
/// library keeps a buffer of that size. Clones share the count.
#[derive(Clone, Default)]
pub(in crate::server) struct MessageBytes {
    counts: Arc<Mutex<Counts>>,
}

#[derive(Default)]
struct Counts {
    /// `None` before the stream begins.
    share: Option<BodyShare>,
    unfinished: usize,
    largest: usize,
}

impl MessageBytes {
    /// Counts from here on.
    pub(in crate::server) fn begin(&self, budget: &BodyBudget) {
        self.counts().share.get_or_insert_with(|| budget.share());
    }

    /// Adds bytes that have arrived. Errors: they exceed the budget.
    pub(super) fn add(&self, bytes: usize) -> io::Result<()> {
        let counts = &mut *self.counts();
        let Some(share) = &counts.share else { return Ok(()) };
        counts.unfinished += bytes;
        let counted = |bytes: usize| bytes.saturating_sub(UNCOUNTED_BYTES);
        let largest = counts.largest.max(counts.unfinished);
        let more = counted(largest) - counted(counts.largest);
        share.take(more).map_err(io::Error::other)?;
        counts.largest = largest;
        Ok(())
    }

    /// A ping or pong with `content_bytes` of content was read. It can come in the middle of a message.
    pub(in crate::server) fn control_read(&self, content_bytes: usize) {
        /// Flags, length and mask.
        const HEAD_BYTES: usize = 6;
        let mut counts = self.counts();
        counts.unfinished = counts.unfinished.saturating_sub(HEAD_BYTES + content_bytes);
    }

    /// The message was read and handled.
    pub(in crate::server) fn message_read(&self) {
        self.counts().unfinished = 0;
    }

    /// Whether a message has begun and has not ended.
    pub(in crate::server) fn is_unfinished(&self) -> bool {
        self.counts().unfinished > 0
    }

    fn counts(&self) -> MutexGuard<'_, Counts> {
        self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::config::ServerConfig;

    #[test]
    fn a_stream_counts_its_largest_message_until_it_ends() {
        let budget = BodyBudget::new(&ServerConfig {
            max_total_body_bytes: 1000,
            ..ServerConfig::default()
        });
        let (first, second) = (MessageBytes::default(), MessageBytes::default());
        first.add(1 << 20).unwrap();
        first.begin(&budget);
        second.begin(&budget);
        for _ in 0..2 {
            first.add(UNCOUNTED_BYTES).unwrap();
            first.add(600).unwrap();
            assert!(first.is_unfinished());
            first.message_read();
            assert!(!first.is_unfinished());
        }
        second.add(UNCOUNTED_BYTES + 400).unwrap();
        let error = second.add(1).unwrap_err().to_string();
        assert!(error.contains("exceed 1000 bytes"), "{error}");
        drop(first);
        second.add(500).unwrap();
    }

    #[test]
    fn pings_do_not_count() {
        let bytes = MessageBytes::default();
        bytes.begin(&BodyBudget::new(&ServerConfig::default()));
        for _ in 0..10 {
            bytes.add(6 + 5).unwrap();
            bytes.control_read(5);
        }
        assert!(!bytes.is_unfinished());
    }
}
