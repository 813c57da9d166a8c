//! Receives the report of a running job: into a buffer, from which the runner writes it to the store, or as events to the
//! parent process.

use std::io::Write;
use std::sync::{Arc, Mutex, PoisonError};

use super::progress::{ReportBuffer, ReportEvent};
use super::{Losses, unix_s};
use crate::store::{JobId, Lease, LossRow};

/// Where the events of a report go: into a buffer, or each one to standard output.
#[derive(Clone)]
pub(super) enum ReportTarget {
    Buffer(Arc<Mutex<ReportBuffer>>),
    Stdout(fn(ReportEvent, &mut dyn Write) -> std::io::Result<()>),
}

/// Receives the report of a running job.
#[derive(Clone)]
pub struct JobReporter {
    target: ReportTarget,
    lease: Lease,
}

impl JobReporter {
    pub(super) fn new(lease: Lease, target: ReportTarget) -> Self {
        Self { target, lease }
    }

    /// Adds an event to the report.
    pub(super) fn apply(&self, event: ReportEvent) {
        match &self.target {
            ReportTarget::Buffer(buffer) => {
                let mut buffer = buffer.lock().unwrap_or_else(PoisonError::into_inner);
                buffer.apply(event, unix_s());
            }
            ReportTarget::Stdout(write) => {
                // The parent has ended if this fails, and this process with it.
                let _ = write(event, &mut std::io::stdout().lock());
            }
        }
    }

    /// The job's id.
    #[must_use]
    pub fn id(&self) -> JobId {
        self.lease.job
    }

    /// The lease of this attempt.
    #[must_use]
    pub fn lease(&self) -> Lease {
        self.lease
    }

    /// Sets the units done, their total, and what the job is doing.
    pub fn progress(&self, done: u64, total: u64, message: &str) {
        self.apply(ReportEvent::Progress(done, total, message.to_owned()));
    }

    /// Restarts the rate measurement, because the units of a new stage take a different time.
    pub fn stage(&self) {
        self.apply(ReportEvent::Stage);
    }

    /// Sets the latest losses. A loss that is `None` keeps its last value.
    pub fn losses(&self, train: Option<f64>, validation: Option<f64>) {
        self.apply(ReportEvent::Losses(Losses { train, validation }));
    }

    /// Says what the job waits for instead of what it does; `None` once it goes on.
    pub(super) fn waiting(&self, message: Option<String>) {
        self.apply(ReportEvent::Waiting(message));
    }

    /// Adds a line to the job's log.
    pub fn line(&self, line: String) {
        self.apply(ReportEvent::Line(line));
    }

    /// Adds a point to the loss curves.
    pub fn point(&self, point: LossRow) {
        self.apply(ReportEvent::Point(point));
    }

    /// Sets how many units are saved, so that a later attempt does not repeat them.
    pub fn checkpoint(&self, units: u64) {
        self.apply(ReportEvent::Checkpoint(units));
    }
}
