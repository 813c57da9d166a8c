//! Counts and times of the inferences over the Open Inference Protocol, by model and version.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

/// How often something happened, and how long it took altogether.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct DurationSum {
    pub(super) count: u64,
    pub(super) ns: u64,
}

impl DurationSum {
    fn add(&mut self, time: Duration) {
        self.count += 1;
        self.ns = self.ns.saturating_add(time.as_nanos() as u64);
    }
}

/// The inferences of a version.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct InferenceCounts {
    pub(super) success: DurationSum,
    pub(super) fail: DurationSum,
    pub(super) queue: DurationSum,
    pub(super) compute: DurationSum,
    /// Milliseconds since 1970.
    pub(super) last_ms: u64,
}

/// The times of an inference that succeeded.
pub(super) struct InferenceTimes {
    pub(super) whole: Duration,
    pub(super) queue: Duration,
    pub(super) compute: Duration,
}

/// The counts of all versions.
#[derive(Default)]
pub(super) struct InferenceStatistics {
    counts: Mutex<BTreeMap<(String, u32), InferenceCounts>>,
}

impl InferenceStatistics {
    pub(super) fn succeeded(&self, model: &str, version: u32, times: &InferenceTimes) {
        self.change(model, version, |counts| {
            counts.success.add(times.whole);
            counts.queue.add(times.queue);
            counts.compute.add(times.compute);
            let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
            counts.last_ms = now.map_or(counts.last_ms, |now| now.as_millis() as u64);
        });
    }

    pub(super) fn failed(&self, model: &str, version: u32, whole: Duration) {
        self.change(model, version, |counts| counts.fail.add(whole));
    }

    pub(super) fn of(&self, model: &str, version: u32) -> InferenceCounts {
        let counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        counts.get(&(model.to_owned(), version)).copied().unwrap_or_default()
    }

    fn change(&self, model: &str, version: u32, change: impl FnOnce(&mut InferenceCounts)) {
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        change(counts.entry((model.to_owned(), version)).or_default());
    }
}
