//! The handle to the jobs: submits, reads, cancels and resumes them.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use metrics::counter;
use tokio::sync::{Notify, RwLock, RwLockWriteGuard, watch};
use tokio::task::JoinHandle;
use tracing::{info, warn};

use super::executor::JobExecutor;
use super::instance::Instance;
use super::progress::StoredProgress;
use super::runner;
use super::shared::{JobLimits, SharedJobs};
use super::{Job, JobError, JobFilter, JobSpec, JobState, JobTransition};
use crate::store::{Author, EnqueueResult, JobId, JobRow, LogRow, LossRow, NewJob, Store};
use foreframe_core::metric_names;

/// The maximum length of an idempotency key.
const MAX_KEY_LENGTH: usize = 128;

/// The handle to the jobs; clones share them.
#[derive(Clone)]
pub struct Jobs {
    shared: Arc<SharedJobs>,
    runner: Arc<Mutex<Option<JoinHandle<()>>>>,
}

impl Jobs {
    /// A handle to the store's jobs. With `runs`, this process also runs them, one at a time. Needs a tokio runtime.
    /// Errors: `Instance`, `Threads`.
    pub fn start(store: Store, limits: JobLimits, execute: Arc<dyn JobExecutor>, runs: bool) -> Result<Self, JobError> {
        let shared = Arc::new(SharedJobs {
            store,
            limits,
            execute,
            submissions: RwLock::new(()),
            wake: Notify::new(),
            ended: Notify::new(),
            stop: watch::Sender::new(false),
        });
        let mut runner = Arc::default();
        if runs {
            let instance = Instance::claim(shared.store.objects().data_dir())?;
            let run = runner::run(Arc::clone(&shared), instance, runner::pool(limits.threads)?);
            runner = Arc::new(Mutex::new(Some(tokio::spawn(run))));
        }
        Ok(Self { shared, runner })
    }

    /// Enqueues a job of the API key with the id `submitter`, which is empty without a key. If it enqueued a job with the same
    /// idempotency key before, returns that job. Errors: what [`JobExecutor::check`] refuses, `QueueFull`, `ShareFull`, `Taken`,
    /// `Stopping`, `Invalid`, `Store`.
    pub async fn submit(&self, submitter: &str, spec: JobSpec, key: Option<String>) -> Result<Job, JobError> {
        let shared = &self.shared;
        if shared.is_stopping() {
            return Err(JobError::Stopping);
        }
        if let Some(key) = &key {
            check_key(key)?;
        }
        // Two clients may choose the same key.
        let key = key.map(|key| {
            if submitter.is_empty() {
                key
            } else {
                format!("{submitter}:{key}")
            }
        });
        if let Some(key) = &key
            && let Some(row) = shared.store.job_of_key(key).await?
        {
            return same(&row, &spec);
        }
        // Fetches an uploaded file, which may take long, before a deletion has to wait. What is wrong with it, the next check says.
        shared.execute.check_again(&spec).await.ok();
        let _submitting = shared.submissions.read().await;
        let checked = shared.execute.check(&spec).await?;
        let new = NewJob {
            kind: checked.kind().to_owned(),
            exclusive_output: checked.made_dataset().map(|name| format!("data set {name}")),
            spec: json(&checked)?,
            progress: json(&StoredProgress::default())?,
            idempotency_key: key,
            submitter: submitter.to_owned(),
            after: checked.after(),
            parts: checked.parts().iter().map(json).collect::<Result<_, _>>()?,
        };
        let now_s = shared.store.now_s().await?;
        match shared.store.enqueue(new, shared.limits.queued as i64, now_s).await? {
            EnqueueResult::New(row) => {
                shared.wake.notify_one();
                let job = self.get(row.id).await?;
                info!(job.id = %job.id, job.kind = row.kind, "job queued");
                Ok(job)
            }
            EnqueueResult::Same(row) => same(&row, &spec),
            other => Err(self.refused(&other, &spec)),
        }
    }

    fn refused(&self, enqueued: &EnqueueResult, spec: &JobSpec) -> JobError {
        match (enqueued, spec.made_dataset()) {
            (EnqueueResult::ShareFull(limit), _) => JobError::ShareFull(*limit),
            (EnqueueResult::Taken, Some(name)) => JobError::taken(
                name,
                "is the output of another job that has not ended; choose another name",
            ),
            _ => JobError::QueueFull(self.shared.limits.queued),
        }
    }

    /// Until the guard is dropped, this process queues no job: what no open job uses can be deleted.
    pub async fn hold_submissions(&self) -> RwLockWriteGuard<'_, ()> {
        self.shared.submissions.write().await
    }

    /// Jobs, the newest first. Errors: `Invalid`, `Record`, `Store`.
    pub async fn list(&self, filter: JobFilter) -> Result<Vec<Job>, JobError> {
        let rows = self.shared.store.jobs(filter.page()?).await?;
        rows.iter().map(Job::of).collect()
    }

    /// All queued and running jobs, with their parts. Errors: `Record`, `Store`.
    pub async fn open(&self) -> Result<Vec<Job>, JobError> {
        self.shared.store.open_jobs().await?.iter().map(Job::of).collect()
    }

    /// One job. Errors: `Unknown`, `Record`, `Store`.
    pub async fn get(&self, id: JobId) -> Result<Job, JobError> {
        Job::of(&self.row(id).await?)
    }

    /// The lines of a job's log after a line number, the oldest first. Errors: `Unknown`, `Store`.
    pub async fn log(&self, id: JobId, after: i64, limit: usize) -> Result<Vec<LogRow>, JobError> {
        let row = self.row(id).await?;
        Ok(self.shared.store.job_log(row.id, after, limit as i64).await?)
    }

    /// The loss curves of a job. Errors: `Unknown`, `Store`.
    pub async fn losses(&self, id: JobId) -> Result<Vec<LossRow>, JobError> {
        let row = self.row(id).await?;
        Ok(self.shared.store.job_losses(row.id).await?)
    }

    /// Cancels a job with its parts: a queued job ends at once, a running one as soon as its work has stopped.
    /// Errors: `Unknown`, `IllegalTransition` if it has ended, `Store`.
    pub async fn cancel(&self, id: JobId, by: &Author) -> Result<Job, JobError> {
        let store = &self.shared.store;
        // Repeats if the state changes between the read and the write; that can happen only a few times.
        loop {
            let row = self.row(id).await?;
            let state = Job::of(&row)?.state;
            let asked = match state.after(JobTransition::Cancel) {
                None => return Err(illegal(id, state, JobTransition::Cancel)),
                Some(_) if state == JobState::Running => store.ask_to_cancel(row.id, by).await?,
                Some(_) => store.cancel_queued(row.id, store.now_s().await?, by).await?,
            };
            if asked {
                if state != JobState::Running {
                    let outcome = JobState::Cancelled.name();
                    counter!(metric_names::JOBS_ENDED, "kind" => row.kind, "outcome" => outcome).increment(1);
                }
                let job = self.get(id).await;
                self.shared.forget_oldest().await;
                return job;
            }
        }
    }

    /// Enqueues a failed or cancelled job again, with its parts that failed or were cancelled; they continue from their last
    /// checkpoints. Errors: `Unknown`, `IllegalTransition`, what [`JobExecutor::check_again`] refuses, `QueueFull`, `Taken`,
    /// `Stopping`, `Store`.
    pub async fn resume(&self, id: JobId, by: &Author) -> Result<Job, JobError> {
        if self.shared.is_stopping() {
            return Err(JobError::Stopping);
        }
        let _submitting = self.shared.submissions.read().await;
        let row = self.row(id).await?;
        let job = Job::of(&row)?;
        if job.state.after(JobTransition::Resume).is_none() {
            return Err(illegal(id, job.state, JobTransition::Resume));
        }
        self.shared.execute.check_again(&job.spec).await?;
        let limit = self.shared.limits.queued as i64;
        match self.shared.store.requeue(row.id, limit, by).await? {
            Some(EnqueueResult::New(row)) => {
                self.shared.wake.notify_one();
                self.get(row.id).await
            }
            Some(EnqueueResult::PartsStopping) => Err(JobError::PartsStopping(id)),
            Some(other) => Err(self.refused(&other, &job.spec)),
            None => Err(illegal(id, JobState::Queued, JobTransition::Resume)),
        }
    }

    /// Completes when a job has ended in this process after the last call.
    pub async fn job_ended(&self) {
        self.shared.ended.notified().await;
    }

    /// Claims no more jobs. The running job writes its checkpoint and goes back to the queue.
    pub fn begin_stop(&self) {
        self.shared.stop.send_replace(true);
    }

    /// Waits until the runner has stopped, at most until `deadline`. Returns whether it has stopped.
    pub async fn finish_stop(&self, deadline: Instant) -> bool {
        let runner = self.runner.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(runner) = runner else { return true };
        let ended = tokio::time::timeout_at(deadline.into(), runner).await.is_ok();
        if !ended {
            warn!("a job did not stop before the deadline; its next attempt resumes from its last checkpoint");
        }
        ended
    }

    async fn row(&self, id: JobId) -> Result<JobRow, JobError> {
        let found = self.shared.store.job(id).await?;
        found.ok_or_else(|| JobError::Unknown(id.to_string()))
    }
}

fn illegal(id: JobId, state: JobState, event: JobTransition) -> JobError {
    JobError::IllegalTransition { id, state, event }
}

fn check_key(key: &str) -> Result<(), JobError> {
    if (1..=MAX_KEY_LENGTH).contains(&key.len()) && key.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Ok(());
    }
    let reason = format!("a key is 1 to {MAX_KEY_LENGTH} visible ASCII characters");
    Err(JobError::invalid("Idempotency-Key", reason))
}

/// The job of an idempotency key. Errors: `Invalid` if its spec is a different one.
fn same(row: &JobRow, spec: &JobSpec) -> Result<Job, JobError> {
    let job = Job::of(row)?;
    if job.spec.matches_submitted(spec) {
        return Ok(job);
    }
    let reason = format!(
        "it was used for a different job, {}; use a new key for a new job",
        job.id
    );
    Err(JobError::invalid("Idempotency-Key", reason))
}

fn json(value: &impl serde::Serialize) -> Result<String, JobError> {
    serde_json::to_string(value).map_err(|error| JobError::invalid("settings", error.to_string()))
}
