//! Takes jobs up one after another: works on them on threads of their own, renews the lease meanwhile, writes what they
//! say of themselves, and ends them.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures_util::future::BoxFuture;
use metrics::{counter, gauge};
use rayon::ThreadPool;
use tokio::sync::{oneshot, watch};
use tracing::{info, warn};

use super::instance::Instance;
use super::job::id_of;
use super::notes::{JobProgressLog, StoredProgress};
use super::queue::JobsInner;
use super::{Job, JobError, JobSpec, JobState, JobTransition, Losses, priority, unix_s};
use crate::store::{JobOutcome, JobRow, JobUpdate, Lease, LossRow};
use crate::telemetry::names;

/// How often a job's standing is written, unless the lease asks for more.
const WRITE_EVERY: Duration = Duration::from_millis(500);
/// How often the store is asked for jobs of other processes.
const POLL_EVERY: Duration = Duration::from_secs(1);
/// How often it is tried to write how a job ended.
const END_ATTEMPTS: u32 = 5;

/// How a job's work ended without what was asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum JobFailure {
    /// It was asked to stop and did, or its lease was lost.
    Cancelled,
    /// What went wrong, in a sentence.
    Failed(String),
}

/// What came of a job.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JobResult {
    /// What is told of it.
    pub result: serde_json::Value,
    /// A model's name and version, and whether that is to serve unless another does.
    pub published: Option<(String, u32, bool)>,
}

/// What does the work of a job.
pub trait JobExecutor: Send + Sync + 'static {
    /// Checks what is asked for before it is taken. Errors: `Invalid`, `NotFound`, `Taken`, `Occupied`, and what keeps it
    /// from looking.
    fn check<'a>(&'a self, spec: &'a JobSpec) -> BoxFuture<'a, Result<(), JobError>>;

    /// Does the work, or goes on with it; returns `Cancelled` soon after `cancelled` is raised.
    fn execute(&self, spec: &JobSpec, report: &JobReporter, cancelled: &AtomicBool) -> Result<JobResult, JobFailure>;
}

/// Where a job's work says how far it is.
#[derive(Clone)]
pub struct JobReporter {
    notes: Arc<Mutex<JobProgressLog>>,
    lease: Lease,
}

impl JobReporter {
    fn notes(&self) -> MutexGuard<'_, JobProgressLog> {
        self.notes.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The job's id.
    #[must_use]
    pub fn id(&self) -> String {
        id_of(self.lease.number)
    }

    /// The right to work on the job.
    #[must_use]
    pub fn lease(&self) -> Lease {
        self.lease
    }

    /// Notes units done of a total, and what is being done.
    pub fn progress(&self, done: u64, total: u64, message: &str) {
        self.notes().progress((done, total), message, unix_s());
    }

    /// Measures the rate anew, for a stage whose units take another time.
    pub fn stage(&self) {
        self.notes().stage();
    }

    /// Notes the latest losses.
    pub fn losses(&self, losses: Losses) {
        for (split, loss) in [("train", losses.train), ("validation", losses.validation)] {
            if let Some(loss) = loss {
                gauge!(names::TRAINING_LOSS, "split" => split).set(loss);
            }
        }
        self.notes().losses(losses);
    }

    /// Adds a line to the job's log.
    pub fn line(&self, line: String) {
        self.notes().line(line, unix_s());
    }

    /// Adds a point to the loss curves.
    pub fn point(&self, point: LossRow) {
        self.notes().point(point);
    }
}

/// The threads that jobs work on, and no others: what predicts has its own, and goes first. Errors: `Threads`.
pub(super) fn pool(threads: usize) -> Result<ThreadPool, JobError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|index| format!("jobs-{index}"))
        .start_handler(|_| priority::lower())
        .build()
        .map_err(JobError::Threads)
}

pub(super) async fn run(shared: Arc<JobsInner>, instance: Instance, pool: ThreadPool) {
    let pool = Arc::new(pool);
    let mut stop = shared.stop.subscribe();
    // Nobody else holds this identity, so what runs under it is what this process's predecessor left.
    if let Err(error) = shared.store.release_leases(&instance.id).await {
        warn!(%error, "jobs of an earlier run are taken up when their leases have run out");
    }
    while !*stop.borrow() {
        let now_s = unix_s();
        let until_s = now_s + shared.limits.lease.as_secs_f64();
        match shared.store.claim(&instance.id, now_s, until_s).await {
            Ok(Some((row, lease))) => JobRun::new(&shared, &row, lease).run(&row, &pool, stop.clone()).await,
            Ok(None) => pause(&shared, &mut stop).await,
            Err(error) => {
                warn!(%error, "could not ask for jobs");
                pause(&shared, &mut stop).await;
            }
        }
    }
}

async fn pause(shared: &JobsInner, stop: &mut watch::Receiver<bool>) {
    tokio::select! {
        () = shared.wake.notified() => {}
        () = tokio::time::sleep(POLL_EVERY) => {}
        () = told(stop) => {}
    }
}

async fn told(stop: &mut watch::Receiver<bool>) {
    // The sender lives as long as the jobs' handle does.
    let _ = stop.wait_for(|stop| *stop).await;
}

/// One taking up of a job.
struct JobRun<'a> {
    shared: &'a JobsInner,
    report: JobReporter,
    cancelled: Arc<AtomicBool>,
    /// Whether the row says that someone asked it to stop.
    asked: bool,
    lost: bool,
}

/// Stops the work when the one who watches it goes, whatever the reason.
impl Drop for JobRun<'_> {
    fn drop(&mut self) {
        self.cancelled.store(true, Ordering::Release);
    }
}

impl<'a> JobRun<'a> {
    fn new(shared: &'a JobsInner, row: &JobRow, lease: Lease) -> Self {
        let standing: StoredProgress = serde_json::from_str(&row.progress).unwrap_or_default();
        Self {
            shared,
            report: JobReporter {
                notes: Arc::new(Mutex::new(JobProgressLog::new(standing))),
                lease,
            },
            cancelled: Arc::new(AtomicBool::new(false)),
            asked: row.cancelling,
            lost: false,
        }
    }

    async fn run(mut self, row: &JobRow, pool: &Arc<ThreadPool>, stop: watch::Receiver<bool>) {
        let id = self.report.id();
        info!(job.id = %id, job.attempt = row.token, "job started");
        self.report.line(match row.token {
            1 => "started".to_owned(),
            attempt => format!("taken up again, for the {attempt}. time"),
        });
        let result = match Job::of(row) {
            Ok(_) if self.asked => Err(JobFailure::Cancelled),
            Ok(job) => self.watch(job.spec, pool, stop).await,
            Err(error) => Err(JobFailure::Failed(error.to_string())),
        };
        if result == Err(JobFailure::Cancelled) && !self.asked {
            // Someone may have asked since the last renewal, and must not be forgotten.
            self.renew().await;
        }
        if self.lost {
            warn!(job.id = %id, "the job's lease was lost; another goes on with it");
            return;
        }
        self.end(&row.kind, result).await;
    }

    /// Works on threads of its own and writes how far it is, until the work returns.
    async fn watch(
        &mut self,
        spec: JobSpec,
        pool: &Arc<ThreadPool>,
        mut stop: watch::Receiver<bool>,
    ) -> Result<JobResult, JobFailure> {
        let (sender, mut result) = oneshot::channel();
        let (execute, pool) = (Arc::clone(&self.shared.execute), Arc::clone(pool));
        let (report, cancelled) = (self.report.clone(), Arc::clone(&self.cancelled));
        let thread = std::thread::Builder::new().name("jobs".to_owned()).spawn(move || {
            priority::lower();
            let result = pool.install(|| execute.execute(&spec, &report, &cancelled));
            // Nobody waits for it if the runner is gone.
            let _ = sender.send(result);
        });
        if let Err(error) = thread {
            return Err(JobFailure::Failed(format!("could not start a thread: {error}")));
        }
        let mut ticks = tokio::time::interval(WRITE_EVERY.min(self.shared.limits.lease / 3));
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut is_told = false;
        loop {
            tokio::select! {
                result = &mut result => {
                    let panicked = || JobFailure::Failed("the work broke off; the server's log says why".to_owned());
                    return result.unwrap_or_else(|_| Err(panicked()));
                }
                () = told(&mut stop), if !is_told => {
                    is_told = true;
                    self.cancelled.store(true, Ordering::Release);
                }
                _ = ticks.tick() => self.renew().await,
            }
        }
    }

    /// Renews the lease and writes what the work said since the last time.
    async fn renew(&mut self) {
        let account = self.account();
        let (lines, losses) = (account.lines.clone(), account.losses.clone());
        let until_s = unix_s() + self.shared.limits.lease.as_secs_f64();
        match self.shared.store.renew(self.report.lease, until_s, account).await {
            Ok(Some(cancelling)) => self.asked |= cancelling,
            Ok(None) => self.lost = true,
            Err(error) => {
                warn!(job.id = %self.report.id(), %error, "could not renew a job's lease");
                self.report.notes().restore_unwritten(lines, losses);
            }
        }
        if self.asked || self.lost {
            self.cancelled.store(true, Ordering::Release);
        }
    }

    fn account(&self) -> JobUpdate {
        let mut notes = self.report.notes();
        let (lines, losses) = notes.take();
        JobUpdate {
            // A standing is two structs of numbers and texts: it is always writable.
            progress: serde_json::to_string(notes.standing()).unwrap_or_default(),
            lines,
            losses,
            max_lines: self.shared.limits.log_lines as i64,
        }
    }

    async fn end(&self, kind: &str, result: Result<JobResult, JobFailure>) {
        let id = self.report.id();
        let (event, error, outcome) = match result {
            Ok(outcome) => (JobTransition::Succeed, None, Some(outcome)),
            Err(JobFailure::Cancelled) if self.asked => (JobTransition::Cancel, None, None),
            Err(JobFailure::Cancelled) => (JobTransition::Leave, None, None),
            Err(JobFailure::Failed(reason)) => (JobTransition::Fail, Some(reason), None),
        };
        // A running job can do all of these.
        let state = JobState::Running.after(event).unwrap_or(JobState::Failed);
        let outcome_name = if state.is_final() { state.name() } else { "left" };
        counter!(names::JOBS_ENDED, "kind" => kind.to_owned(), "outcome" => outcome_name).increment(1);
        match &error {
            None => info!(job.id = %id, job.outcome = ?event, "job ended"),
            Some(reason) => warn!(job.id = %id, reason, "job failed"),
        }
        self.report.line(match &error {
            None if state == JobState::Queued => "left, to be gone on with".to_owned(),
            None => state.name().to_owned(),
            Some(reason) => format!("failed: {reason}"),
        });
        let ending = JobOutcome {
            state: state.name(),
            error,
            outcome: outcome.as_ref().map(|outcome| outcome.result.to_string()),
            ended_s: state.is_final().then(unix_s),
            published: outcome.and_then(|outcome| outcome.published),
        };
        self.write_end(&id, ending).await;
        self.shared.ended.notify_one();
    }

    async fn write_end(&self, id: &str, ending: JobOutcome) {
        let account = self.account();
        for attempt in 1..=END_ATTEMPTS {
            let written = self
                .shared
                .store
                .end(self.report.lease, ending.clone(), account.clone());
            match written.await {
                Ok(true) => return self.shared.forget_oldest().await,
                Ok(false) => return warn!(job.id = %id, "the job's lease was lost before its end was written"),
                Err(error) => warn!(job.id = %id, %error, attempt, "could not write how a job ended"),
            }
            tokio::time::sleep(POLL_EVERY).await;
        }
    }
}
