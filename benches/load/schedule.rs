//! Doing things at their times.

use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A thing that is due: the how-manyth it is, and the time it was scheduled for.
#[derive(Clone, Copy)]
pub(crate) struct Tick {
    pub(crate) index: u64,
    pub(crate) scheduled: Instant,
}

/// When ticks come: evenly from `begin` on.
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

    /// Calls `due` at each tick from a thread of its own, for an async timer is a millisecond coarse. Late ones follow at
    /// once; none is left out.
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
