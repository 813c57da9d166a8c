//! When the bridge says what it waits for.

use std::time::{Duration, Instant};

/// So long nothing is said: topics and first messages come one after the other.
const AT_LEAST: Duration = Duration::from_secs(3);
/// As many frame periods, if they are longer.
const PERIODS: f64 = 3.0;

/// Since when something is missing.
pub(super) struct Waiting {
    /// How long it may be missing before that is said.
    time: Duration,
    since: Instant,
    said: String,
}

impl Waiting {
    pub(super) fn new(frame_period_s: f64) -> Self {
        let periods = Duration::try_from_secs_f64(PERIODS * frame_period_s).unwrap_or(Duration::MAX);
        Self {
            time: AT_LEAST.max(periods),
            since: Instant::now(),
            said: String::new(),
        }
    }

    /// How long something may be missing before that is said.
    pub(super) fn time(&self) -> Duration {
        self.time
    }

    /// Nothing is missing now.
    pub(super) fn end(&mut self) {
        self.since = Instant::now();
        self.said.clear();
    }

    /// What to say of `missing`, now and then; `None` if it is too early, or was said.
    pub(super) fn sentence(&mut self, missing: impl FnOnce() -> Vec<String>) -> Option<String> {
        if self.since.elapsed() < self.time {
            return None;
        }
        self.since = Instant::now();
        let sentence = missing().join("; ");
        if sentence.is_empty() || sentence == self.said {
            return None;
        }
        self.said.clone_from(&sentence);
        Some(sentence)
    }
}
