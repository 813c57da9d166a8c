//! Runs the jobs of the table one after another on a thread of its own.

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use metrics::{counter, gauge};
use tracing::{info, warn};

use crate::telemetry::names;

use super::{Event, Job, JobError, JobSpec, JobState, JobTable, Losses, TableLimits};

/// How a job's work ended without what was asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Failure {
    /// It was asked to stop and did.
    Cancelled,
    /// What went wrong, in a sentence.
    Failed(String),
}

/// What does the work of a job.
pub trait Execute: Send + Sync + 'static {
    /// Checks what is asked for before it is taken. Errors: `Invalid`, `NotFound`, `Taken`.
    fn check(&self, spec: &JobSpec) -> Result<(), JobError>;

    /// Does the work; returns `Cancelled` soon after `cancelled` is raised.
    fn execute(&self, spec: &JobSpec, report: &Report<'_>, cancelled: &AtomicBool) -> Result<(), Failure>;
}

/// Where a job's work says how far it is.
pub struct Report<'a> {
    shared: &'a Shared,
    id: &'a str,
}

impl Report<'_> {
    /// Notes units done of a total, and what is being done.
    pub fn progress(&self, done: u64, total: u64, message: &str) {
        self.shared
            .table()
            .note_progress(self.id, (done, total), message, unix_s());
    }

    /// Measures the rate anew, for a stage whose units take another time.
    pub fn stage(&self) {
        self.shared.table().note_stage(self.id);
    }

    /// Notes the latest losses.
    pub fn losses(&self, losses: Losses) {
        for (split, loss) in [("train", losses.train), ("validation", losses.validation)] {
            if let Some(loss) = loss {
                gauge!(names::TRAINING_LOSS, "split" => split).set(loss);
            }
        }
        self.shared.table().note_losses(self.id, losses);
    }
}

struct Shared {
    table: Mutex<JobTable>,
    changed: Condvar,
    stopping: AtomicBool,
    execute: Box<dyn Execute>,
}

impl Shared {
    fn table(&self) -> MutexGuard<'_, JobTable> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_stopping(&self) -> bool {
        self.stopping.load(std::sync::atomic::Ordering::Acquire)
    }
}

/// The handle to the jobs; clones share them.
#[derive(Clone)]
pub struct Jobs {
    shared: Arc<Shared>,
    runner: Arc<Mutex<Option<JoinHandle<()>>>>,
}

impl Jobs {
    /// Starts the thread that runs them. Errors: `Thread`.
    pub fn start(limits: TableLimits, execute: Box<dyn Execute>) -> Result<Self, JobError> {
        let shared = Arc::new(Shared {
            table: Mutex::new(JobTable::new(limits)),
            changed: Condvar::new(),
            stopping: AtomicBool::new(false),
            execute,
        });
        let of_thread = Arc::clone(&shared);
        let runner = std::thread::Builder::new()
            .name("jobs".to_owned())
            .spawn(move || run(&of_thread))
            .map_err(JobError::Thread)?;
        Ok(Self {
            shared,
            runner: Arc::new(Mutex::new(Some(runner))),
        })
    }

    /// Takes a job. Blocks for the disk. Errors: what [`Execute::check`] refuses, `QueueFull`, `Taken`, `Stopping`.
    pub fn submit(&self, spec: JobSpec) -> Result<Job, JobError> {
        if self.shared.is_stopping() {
            return Err(JobError::Stopping);
        }
        self.shared.execute.check(&spec)?;
        let job = self.shared.table().add(spec, unix_s())?;
        self.shared.changed.notify_all();
        info!(job.id = %job.id, "job queued");
        Ok(job)
    }

    /// Every job, the newest first.
    #[must_use]
    pub fn all(&self) -> Vec<Job> {
        self.shared.table().all().cloned().collect()
    }

    /// One job. Errors: `Unknown`.
    pub fn get(&self, id: &str) -> Result<Job, JobError> {
        self.shared.table().get(id).cloned()
    }

    /// Asks a job to stop. Errors: `Unknown`, `IllegalTransition`.
    pub fn cancel(&self, id: &str) -> Result<Job, JobError> {
        self.shared.table().cancel(id, unix_s())
    }

    /// Cancels every job that has not ended and takes no more; returns at once.
    pub fn begin_stop(&self) {
        self.shared.stopping.store(true, std::sync::atomic::Ordering::Release);
        let mut table = self.shared.table();
        let open: Vec<String> = table
            .all()
            .filter(|job| !job.state.is_final())
            .map(|job| job.id.clone())
            .collect();
        for id in open {
            // Listed under the same lock as open, so it can be cancelled.
            let _ = table.cancel(&id, unix_s());
        }
        self.shared.changed.notify_all();
    }

    /// Waits until no job runs and the thread has ended, at most until `deadline`; says whether it has. Blocks.
    #[must_use]
    pub fn finish_stop(&self, deadline: Instant) -> bool {
        let mut table = self.shared.table();
        while table.all().any(|job| job.state == JobState::Running) {
            let left = deadline.saturating_duration_since(Instant::now());
            if left == Duration::ZERO {
                warn!("a job did not reach its checkpoint within the deadline");
                return false;
            }
            table = self
                .shared
                .changed
                .wait_timeout(table, left)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
        drop(table);
        let runner = self.runner.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(runner) = runner {
            // A panic of the runner has already been printed; there is nothing left to stop.
            let _ = runner.join();
        }
        true
    }
}

fn run(shared: &Shared) {
    while let Some((id, spec, cancelled)) = next(shared) {
        info!(job.id = %id, "job started");
        let report = Report { shared, id: &id };
        let result = shared.execute.execute(&spec, &report, &cancelled);
        let (event, error) = match result {
            Ok(()) => (Event::Succeed, None),
            Err(Failure::Cancelled) => (Event::Cancel, None),
            Err(Failure::Failed(reason)) => (Event::Fail, Some(reason)),
        };
        counter!(names::JOBS_ENDED, "outcome" => outcome(event)).increment(1);
        match &error {
            None => info!(job.id = %id, job.outcome = ?event, "job ended"),
            Some(reason) => warn!(job.id = %id, reason, "job failed"),
        }
        // A running job can succeed, fail and be cancelled: every event here is legal.
        let _ = shared.table().end(&id, event, error, unix_s());
        shared.changed.notify_all();
    }
}

fn outcome(event: Event) -> &'static str {
    match event {
        Event::Cancel => "cancelled",
        Event::Fail => "failed",
        Event::Succeed => "succeeded",
        Event::Start | Event::Leave | Event::Resume => "left",
    }
}

/// The next job, or `None` when stopping. Blocks.
fn next(shared: &Shared) -> Option<(String, JobSpec, Arc<AtomicBool>)> {
    let mut table = shared.table();
    loop {
        if shared.is_stopping() {
            return None;
        }
        if let Some(next) = table.start_next(unix_s()) {
            return Some(next);
        }
        table = shared.changed.wait(table).unwrap_or_else(PoisonError::into_inner);
    }
}

fn unix_s() -> f64 {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since_1970.unwrap_or_default().as_secs_f64()
}
