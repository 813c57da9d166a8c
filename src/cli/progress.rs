//! Progress on standard error: a bar on a terminal, a line every few seconds in a log.

use std::io::IsTerminal;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressStyle};

/// How often a line is written where there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);
/// A rate that was measured over a shorter time says nothing.
const MIN_MEASURED: Duration = Duration::from_secs(1);

/// A count towards a total.
pub(super) struct ProgressLine {
    bar: ProgressBar,
    unit: &'static str,
    start: Mutex<Option<RunStart>>,
    last_line: Option<Mutex<Instant>>,
}

/// Where this run began to count: earlier runs do not count for its rate.
#[derive(Clone, Copy)]
struct RunStart {
    time: Instant,
    done: u64,
}

impl RunStart {
    /// Units per second, and the time left. None until there is enough to measure.
    fn rate(self, done: u64, total: u64, now: Instant) -> Option<(f64, Duration)> {
        let (gained, elapsed) = (done.saturating_sub(self.done), now.saturating_duration_since(self.time));
        if gained == 0 || elapsed < MIN_MEASURED {
            return None;
        }
        let rate = gained as f64 / elapsed.as_secs_f64();
        let left = Duration::try_from_secs_f64(total.saturating_sub(done) as f64 / rate);
        Some((rate, left.unwrap_or(Duration::MAX)))
    }
}

impl ProgressLine {
    /// Counts `unit`s; the total is not known yet.
    pub(super) fn new(unit: &'static str) -> Self {
        let bar = ProgressBar::new(0);
        if let Ok(style) = ProgressStyle::with_template("{prefix} {bar:30} {human_pos}/{human_len} {msg}") {
            bar.set_style(style);
        }
        let last_line = (!std::io::stderr().is_terminal()).then(|| Mutex::new(Instant::now()));
        Self {
            bar,
            unit,
            start: Mutex::new(None),
            last_line,
        }
    }

    /// Names what is counted from now on. The first update says where the count begins.
    pub(super) fn label(&self, what: &str) {
        self.bar.set_prefix(what.to_owned());
        self.bar.reset();
        *self.start.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// Names what is counted from now on; `done` units were done before.
    pub(super) fn start(&self, what: &str, done: u64, total: u64) {
        self.label(what);
        self.run_start(done);
        self.bar.set_length(total);
        self.bar.set_position(done);
    }

    fn run_start(&self, done: u64) -> RunStart {
        let mut start = self.start.lock().unwrap_or_else(PoisonError::into_inner);
        *start.get_or_insert_with(|| RunStart {
            time: Instant::now(),
            done,
        })
    }

    /// Shows how many are done, with a message behind.
    pub(super) fn update(&self, done: u64, total: u64, message: impl FnOnce() -> String) {
        let rate = self.run_start(done).rate(done, total, Instant::now());
        let rate = rate.map_or_else(String::new, |(rate, left)| {
            format!("{rate:.1}/s, {} left ", HumanDuration(left))
        });
        self.bar.set_length(total);
        self.bar.set_position(done);
        let Some(last_line) = &self.last_line else {
            self.bar.set_message(format!("{rate}{}", message()));
            return;
        };
        let Ok(mut last) = last_line.lock() else { return };
        if last.elapsed() < LINE_INTERVAL && done < total {
            return;
        }
        *last = Instant::now();
        self.line(&format!("{done}/{total} {} {rate}{}", self.unit, message()));
    }

    /// Writes a line above the bar.
    pub(super) fn line(&self, text: &str) {
        if self.last_line.is_some() {
            eprintln!("{} {}", self.bar.prefix(), text.trim_end());
        } else {
            self.bar.println(text);
        }
    }

    /// Removes the bar.
    pub(super) fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_counts_only_the_steps_of_this_run() {
        let start = RunStart {
            time: Instant::now(),
            done: 1000,
        };
        let later = start.time + Duration::from_secs(10);
        assert_eq!(start.rate(1020, 1100, later), Some((2.0, Duration::from_secs(40))));
    }

    #[test]
    fn no_rate_is_shown_at_the_first_step() {
        let start = RunStart {
            time: Instant::now(),
            done: 0,
        };
        assert_eq!(start.rate(1, 3000, start.time + Duration::from_micros(2)), None);
        assert_eq!(start.rate(0, 3000, start.time + Duration::from_secs(5)), None);
    }
}
