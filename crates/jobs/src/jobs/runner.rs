//! Claims jobs one after another. Runs each on its own threads, renews its lease, writes its reports, and records its
//! outcome.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use metrics::counter;
use rayon::ThreadPool;
use tokio::sync::oneshot;
use tracing::{info, warn};

use super::executor::{JobFailure, JobResult};
use super::instance::Instance;
use super::progress::{ReportBuffer, StoredProgress};
use super::report::{JobReporter, ReportTarget};
use super::shared::SharedJobs;
use super::{Job, JobError, JobSpec, JobState, JobTransition, priority};
use crate::store::{JobId, JobOutcome, JobReport, JobRow, Lease, StoreError};
use foreframe_core::metric_names;

/// How often a job's report is written, unless the lease needs it more often.
const WRITE_EVERY: Duration = Duration::from_millis(500);
/// How often the store is asked for jobs that other processes submitted.
const POLL_EVERY: Duration = Duration::from_secs(1);
/// How often it is logged that it cannot be asked.
const TELL_EVERY: Duration = Duration::from_mins(1);
/// How often a runner that is asked to stop tries to write a job's outcome.
const END_ATTEMPTS: u32 = 5;

/// The threads for jobs, separate from those for predictions and with lower priority. Errors: `Threads`.
pub(super) fn pool(threads: usize) -> Result<ThreadPool, JobError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|index| format!("jobs-{index}"))
        .start_handler(|_| priority::lower())
        .build()
        .map_err(JobError::Threads)
}

pub(super) async fn run(shared: Arc<SharedJobs>, instance: Instance, pool: ThreadPool) {
    let pool = Arc::new(pool);
    // This process holds the lock of the id, so all leases under the id are of an earlier process that has ended.
    if let Err(error) = shared.store.release_leases(&instance.id).await {
        warn!(%error, "could not release the leases of an earlier process; its jobs resume when the leases expire");
    }
    let lease_s = shared.limits.lease.as_secs_f64();
    let mut told: Option<Instant> = None;
    while !shared.is_stopping() {
        let claimed = shared.store.claim(&instance.id, lease_s).await;
        told = told.filter(|_| claimed.is_err());
        match claimed {
            Ok(Some((row, lease))) => {
                Box::pin(JobRun::new(&shared, row, lease).run(&pool)).await;
                continue;
            }
            Err(error) if told.is_none_or(|told| told.elapsed() >= TELL_EVERY) => {
                warn!(%error, "could not claim a job");
                told = Some(Instant::now());
            }
            Ok(None) | Err(_) => {}
        }
        tokio::select! {
            () = shared.wake.notified() => {}
            () = tokio::time::sleep(POLL_EVERY) => {}
            () = shared.stop_requested() => {}
        }
    }
}

/// One attempt of a job.
struct JobRun<'a> {
    shared: &'a SharedJobs,
    /// The job when this attempt started.
    row: JobRow,
    report: JobReporter,
    buffer: Arc<Mutex<ReportBuffer>>,
    cancelled: Arc<AtomicBool>,
    /// Whether the job was cancelled by request.
    cancel_requested: bool,
    lease_lost: bool,
    /// When the time limit is reached.
    deadline: Option<Instant>,
    /// The latest number of changes of the report, and when it was first seen.
    latest_change: (u64, Instant),
    /// Whether the work was stopped because it reported no progress.
    has_stalled: bool,
}

/// Stops the work when its supervision ends, for whatever reason.
impl Drop for JobRun<'_> {
    fn drop(&mut self) {
        self.stop_work();
    }
}

impl<'a> JobRun<'a> {
    fn new(shared: &'a SharedJobs, row: JobRow, lease: Lease) -> Self {
        let stored: StoredProgress = serde_json::from_str(&row.progress).unwrap_or_default();
        let buffer = Arc::new(Mutex::new(ReportBuffer::new(stored)));
        Self {
            shared,
            report: JobReporter::new(lease, ReportTarget::Buffer(Arc::clone(&buffer))),
            buffer,
            cancelled: Arc::new(AtomicBool::new(false)),
            cancel_requested: row.cancelling,
            lease_lost: false,
            deadline: shared.limits.time_limit.map(|limit| Instant::now() + limit),
            latest_change: (0, Instant::now()),
            has_stalled: false,
            row,
        }
    }

    fn buffer(&self) -> MutexGuard<'_, ReportBuffer> {
        self.buffer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn stop_work(&self) {
        self.cancelled.store(true, Ordering::Release);
    }

    async fn run(mut self, pool: &Arc<ThreadPool>) {
        let id = self.row.id;
        info!(job.id = %id, job.attempt = self.row.token, "job started");
        self.report.line(match self.row.token {
            1 => "started".to_owned(),
            attempt => format!("attempt {attempt}: resuming from the last checkpoint"),
        });
        let mut result = match Job::of(&self.row) {
            Ok(_) if self.cancel_requested => Err(JobFailure::Cancelled),
            Ok(_) if self.row.stalled_attempts >= self.max_attempts() => Err(self.give_up("its process was killed")),
            Ok(job) => self.supervise(job.spec, pool).await,
            Err(error) => Err(JobFailure::Failed(error.to_string())),
        };
        if result == Err(JobFailure::Cancelled) && !self.cancel_requested {
            // The job may have been cancelled since the last renewal.
            self.renew().await;
        }
        if self.lease_lost {
            warn!(job.id = %id, "the job's lease was lost; another worker continues it");
            return;
        }
        let was_stopped_here =
            result == Err(JobFailure::Cancelled) && !self.cancel_requested && !self.shared.is_stopping();
        if was_stopped_here && let Some(failure) = self.reached_limit() {
            result = Err(failure);
        }
        Box::pin(self.end(self.check_attempts(result))).await;
    }

    /// The limit for which the work was stopped.
    fn reached_limit(&self) -> Option<JobFailure> {
        let seconds = |limit: Option<Duration>| limit.unwrap_or_default().as_secs();
        if self.is_over_time() {
            return Some(JobFailure::Failed(format!(
                "the attempt reached the time limit of {} s (setting job_time_limit_s); a resumed job continues from its last \
                 checkpoint",
                seconds(self.shared.limits.time_limit)
            )));
        }
        self.has_stalled.then(|| {
            let limit_s = seconds(self.shared.limits.stall_limit);
            JobFailure::Crashed(format!(
                "the job reported no progress for {limit_s} s (setting job_stall_limit_s)"
            ))
        })
    }

    /// Runs the work on its own thread, and writes its report until the work returns.
    async fn supervise(&mut self, spec: JobSpec, pool: &Arc<ThreadPool>) -> Result<JobResult, JobFailure> {
        let shared = self.shared;
        let (sender, mut result) = oneshot::channel();
        let (execute, pool) = (Arc::clone(&shared.execute), Arc::clone(pool));
        let (report, cancelled) = (self.report.clone(), Arc::clone(&self.cancelled));
        let thread = std::thread::Builder::new().name("jobs".to_owned()).spawn(move || {
            priority::lower();
            let result = pool.install(|| execute.execute(&spec, &report, &cancelled));
            // The receiver is gone if the runner has stopped.
            let _ = sender.send(result);
        });
        if let Err(error) = thread {
            return Err(JobFailure::Failed(format!("could not start a thread: {error}")));
        }
        let mut ticks = tokio::time::interval(WRITE_EVERY.min(shared.limits.lease / 3));
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut is_stopping = false;
        loop {
            tokio::select! {
                result = &mut result => {
                    let panicked = || JobFailure::Failed("the job panicked; the server's log says why".to_owned());
                    return result.unwrap_or_else(|_| Err(panicked()));
                }
                () = shared.stop_requested(), if !is_stopping => {
                    is_stopping = true;
                    self.stop_work();
                    // If the process ends before the work has stopped, that is no failure of the job.
                    if let Err(error) = shared.store.excuse_attempt(self.report.lease()).await {
                        warn!(%error, "could not mark an attempt as stopped");
                    }
                }
                _ = ticks.tick() => {
                    self.renew().await;
                    self.check_limits();
                }
            }
        }
    }

    /// Renews the lease and writes the report since the last call.
    async fn renew(&mut self) {
        let report = self.take_report();
        let (lines, losses) = (report.lines.clone(), report.losses.clone());
        let lease_s = self.shared.limits.lease.as_secs_f64();
        match self.shared.store.renew(self.report.lease(), lease_s, report).await {
            Ok(Some(cancelling)) => self.cancel_requested |= cancelling,
            Ok(None) => self.lease_lost = true,
            Err(error) => {
                warn!(job.id = %self.report.id(), %error, "could not renew a job's lease");
                self.buffer().restore_unwritten(lines, losses);
            }
        }
        if self.cancel_requested || self.lease_lost {
            self.stop_work();
        }
    }

    fn take_report(&self) -> JobReport {
        let mut buffer = self.buffer();
        let (lines, losses) = buffer.drain();
        JobReport {
            // Two structs of numbers and strings always serialize.
            progress: serde_json::to_string(buffer.stored()).unwrap_or_default(),
            lines,
            losses,
            max_lines: self.shared.limits.log_lines as i64,
            checkpoint: buffer.saved() as i64,
        }
    }

    fn max_attempts(&self) -> i64 {
        i64::from(self.shared.limits.max_attempts)
    }

    fn give_up(&self, how: &str) -> JobFailure {
        JobFailure::Failed(format!(
            "{} attempts in a row ended without progress (setting job_max_attempts); the last one: {how}",
            self.max_attempts()
        ))
    }

    /// Turns a crash into a failure if too many attempts in a row made no progress.
    fn check_attempts(&self, result: Result<JobResult, JobFailure>) -> Result<JobResult, JobFailure> {
        let is_stalled = self.buffer().saved() as i64 <= self.row.checkpoint;
        match result {
            Err(JobFailure::Crashed(reason)) if is_stalled && self.row.stalled_attempts + 1 >= self.max_attempts() => {
                Err(self.give_up(&reason))
            }
            result => result,
        }
    }

    /// Stops the work when the time limit is reached, or when it has reported no progress for too long.
    fn check_limits(&mut self) {
        let changes = self.buffer().changes();
        if changes != self.latest_change.0 {
            self.latest_change = (changes, Instant::now());
        }
        let limit = self.shared.limits.stall_limit;
        self.has_stalled |= limit.is_some_and(|limit| self.latest_change.1.elapsed() >= limit);
        if self.has_stalled || self.is_over_time() {
            self.stop_work();
        }
    }

    fn is_over_time(&self) -> bool {
        self.deadline.is_some_and(|deadline| Instant::now() >= deadline)
    }

    async fn end(&self, result: Result<JobResult, JobFailure>) {
        let id = self.row.id;
        let event = match &result {
            Ok(_) => JobTransition::Succeed,
            Err(JobFailure::Failed(_)) => JobTransition::Fail,
            Err(_) if self.cancel_requested => JobTransition::Cancel,
            Err(_) => JobTransition::Release,
        };
        // All of these transitions are legal for a running job.
        let state = JobState::Running.after(event).unwrap_or(JobState::Failed);
        let outcome_name = if state.is_final() { state.name() } else { "released" };
        counter!(metric_names::JOBS_ENDED, "kind" => self.row.kind.clone(), "outcome" => outcome_name).increment(1);
        if let Err(JobFailure::Failed(reason)) = &result {
            warn!(job.id = %id, reason, "job failed");
        } else {
            info!(job.id = %id, job.outcome = ?event, "job ended");
        }
        if let Err(JobFailure::Crashed(reason)) = &result {
            warn!(job.id = %id, reason, "an attempt of a job crashed");
        }
        self.report.line(match &result {
            Err(JobFailure::Failed(reason)) => format!("failed: {reason}"),
            Err(JobFailure::Crashed(reason)) if state == JobState::Queued => format!("the attempt crashed: {reason}"),
            _ if state == JobState::Queued => "stopped with the server; the next attempt resumes it".to_owned(),
            _ => state.name().to_owned(),
        });
        let mut outcome = JobOutcome {
            state: state.name(),
            // Set when it is written, by the database's clock.
            ended_s: state.is_final().then_some(0.0),
            crashed: matches!(result, Err(JobFailure::Crashed(_))),
            ..JobOutcome::default()
        };
        match result {
            Ok(done) => {
                outcome.outcome = Some(done.result.to_string());
                (outcome.published, outcome.measured) = (done.published, done.measured);
            }
            Err(JobFailure::Failed(reason)) => outcome.error = Some(reason),
            Err(_) => {}
        }
        self.write_outcome(id, outcome).await;
        self.shared.ended.notify_one();
    }

    /// Writes the outcome. While the database is away, tries until it is back: nothing else can be claimed meanwhile.
    async fn write_outcome(&self, id: JobId, outcome: JobOutcome) {
        let report = self.take_report();
        for attempt in 1.. {
            match self.try_to_end(outcome.clone(), report.clone()).await {
                Ok(true) => return self.shared.forget_oldest().await,
                Ok(false) => return warn!(job.id = %id, "the job's lease was lost before its outcome was written"),
                Err(error) => warn!(job.id = %id, %error, attempt, "could not write a job's outcome"),
            }
            if self.shared.is_stopping() && attempt >= END_ATTEMPTS {
                return;
            }
            tokio::time::sleep(POLL_EVERY).await;
        }
    }

    /// Returns false if the lease was lost.
    async fn try_to_end(&self, mut outcome: JobOutcome, report: JobReport) -> Result<bool, StoreError> {
        let store = &self.shared.store;
        if let Some(ended_s) = &mut outcome.ended_s {
            *ended_s = store.now_s().await?;
        }
        store.end(self.report.lease(), outcome, report).await
    }
}
