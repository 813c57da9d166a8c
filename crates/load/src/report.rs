//! Printed measurements, and the bounds that they must keep.

use std::fmt::{Display, Formatter};
use std::process::ExitCode;
use std::time::Duration;

/// The bounds of all scenarios. Collects those that failed.
#[derive(Default)]
pub(crate) struct Bounds {
    failed: Vec<String>,
}

impl Bounds {
    /// Prints whether a bound holds, and records it if it does not.
    pub(crate) fn check(&mut self, holds: bool, what: impl Into<String>) {
        let what = what.into();
        println!("{} {what}", if holds { "  ok:    " } else { "  FAILED:" });
        if !holds {
            self.failed.push(what);
        }
    }

    /// Success if every bound holds.
    pub(crate) fn exit_code(self) -> ExitCode {
        if self.failed.is_empty() {
            return ExitCode::SUCCESS;
        }
        println!("FAILED: {}", self.failed.join("; "));
        ExitCode::FAILURE
    }
}

/// Latencies, sorted; quantiles are in milliseconds.
pub(crate) struct Latencies(Vec<Duration>);

impl Latencies {
    pub(crate) fn of(times: impl IntoIterator<Item = Duration>) -> Self {
        let mut times: Vec<_> = times.into_iter().collect();
        times.sort_unstable();
        Self(times)
    }

    pub(crate) fn len(&self) -> usize {
        self.0.len()
    }

    /// The quantile at `share` in milliseconds; infinite if there are no latencies.
    pub(crate) fn at_ms(&self, share: f64) -> f64 {
        let last = self.0.len().saturating_sub(1);
        let time = self.0.get((last as f64 * share).ceil() as usize);
        time.map_or(f64::INFINITY, |time| time.as_secs_f64() * 1e3)
    }
}

impl Display for Latencies {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let [p50, p90, p99, max] = [0.5, 0.9, 0.99, 1.0].map(|share| self.at_ms(share));
        write!(f, "p50 {p50:.2} ms, p90 {p90:.2}, p99 {p99:.2}, max {max:.2}")
    }
}

/// The median; NaN if there are no values.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}
