//! A limit of requests a second.

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

/// Allows a number of requests a second on average, and those of one second at once.
pub(super) struct RateLimit {
    per_s: f64,
    state: Mutex<RateState>,
}

struct RateState {
    /// How many requests are allowed now.
    allowed: f64,
    /// When that was computed.
    at: Instant,
}

impl RateLimit {
    pub(super) fn new(per_s: f64, now: Instant) -> Self {
        let state = RateState {
            allowed: per_s.max(1.0),
            at: now,
        };
        Self {
            per_s,
            state: Mutex::new(state),
        }
    }

    /// Counts a request. Errors: the seconds after which one is allowed again.
    pub(super) fn take(&self, now: Instant) -> Result<(), f64> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let elapsed_s = now.saturating_duration_since(state.at).as_secs_f64();
        state.allowed = (state.allowed + elapsed_s * self.per_s).min(self.per_s.max(1.0));
        state.at = now;
        if state.allowed >= 1.0 {
            state.allowed -= 1.0;
            return Ok(());
        }
        Err((1.0 - state.allowed) / self.per_s)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_rate_allows_its_number_in_each_second() {
        let start = Instant::now();
        let limit = RateLimit::new(5.0, start);
        let at = |ms| start + Duration::from_millis(ms);
        let count = |ms: u64| (0..100).filter(|_| limit.take(at(ms)).is_ok()).count();
        assert_eq!(
            [count(0), count(0), count(1000), count(1200), count(60_000)],
            [5, 0, 5, 1, 5]
        );
    }

    #[test]
    fn a_refusal_says_when_to_try_again() {
        let start = Instant::now();
        let limit = RateLimit::new(0.5, start);
        assert_eq!(limit.take(start), Ok(()));
        assert_eq!(limit.take(start), Err(2.0));
    }
}
