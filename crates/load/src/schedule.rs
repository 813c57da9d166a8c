//! Calls at scheduled times.

use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// One scheduled call: its index from 0, and the time that it was scheduled for.
#[derive(Clone, Copy)]
pub(crate) struct Tick {
    pub(crate) index: u64,
    pub(crate) scheduled: Instant,
}

/// Evenly spaced ticks from `begin` on.
#[derive(Clone, Copy)]
pub(crate) struct Schedule {
    pub(crate) begin: Instant,
    pub(crate) rate_hz: f64,
    pub(crate) count: u64,
}

impl Schedule {
    pub(crate) fn lasting(begin: Instant, rate_hz: f64, time: Duration) -> Self {
        Self {
            begin,
            rate_hz,
            count: (rate_hz * time.as_secs_f64()).ceil() as u64,
        }
    }

    /// Calls `due` at each tick from its own thread, because an async timer has a resolution of only a millisecond. Late
    /// ticks follow immediately; none is left out.
    pub(crate) fn start(self, mut due: impl FnMut(Tick) + Send + 'static) -> JoinHandle<()> {
        std::thread::spawn(move || {
            for index in 0..self.count {
                let scheduled = self.begin + Duration::from_secs_f64(index as f64 / self.rate_hz);
                std::thread::sleep(scheduled.saturating_duration_since(Instant::now()));
                due(Tick { index, scheduled });
            }
        })
    }
}
