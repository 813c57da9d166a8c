//! The handle to the jobs: enqueues them, tells of them, asks them to stop or to go on.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::{Notify, watch};
use tokio::task::JoinHandle;
use tracing::{info, warn};

use super::instance::Instance;
use super::job::{id_of, number_of};
use super::notes::StoredProgress;
use super::runner::{self, JobExecutor};
use super::{Job, JobError, JobFilter, JobSpec, JobState, JobTransition, unix_s};
use crate::store::{EnqueueResult, JobRow, LogRow, LossRow, NewJob, Store};

/// An idempotency key's characters at most.
const MAX_KEY_LENGTH: usize = 128;

/// The bounds of jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct JobLimits {
    /// Jobs that may wait.
    pub queued: usize,
    /// Ended jobs that are remembered; the oldest is forgotten first.
    pub ended: usize,
    /// Lines of a job's log that are kept.
    pub log_lines: usize,
    /// Threads that the work of jobs may use.
    pub threads: usize,
    /// How long a runner may be silent before others take its job.
    pub lease: Duration,
}

pub(super) struct JobsInner {
    pub(super) store: Store,
    pub(super) limits: JobLimits,
    pub(super) execute: Arc<dyn JobExecutor>,
    /// A job may be there to be taken up.
    pub(super) wake: Notify,
    /// A job has ended here.
    pub(super) ended: Notify,
    pub(super) stop: watch::Sender<bool>,
}

/// The handle to the jobs; clones share them.
#[derive(Clone)]
pub struct Jobs {
    shared: Arc<JobsInner>,
    runner: Arc<Mutex<Option<JoinHandle<()>>>>,
}

impl Jobs {
    /// A handle to the store's jobs; with `runs`, also takes them up, one at a time. To be called within a tokio runtime.
    /// Errors: `Instance`, `Threads`.
    pub fn start(store: Store, limits: JobLimits, execute: Arc<dyn JobExecutor>, runs: bool) -> Result<Self, JobError> {
        let shared = Arc::new(JobsInner {
            store,
            limits,
            execute,
            wake: Notify::new(),
            ended: Notify::new(),
            stop: watch::Sender::new(false),
        });
        let runner = if runs {
            let instance = Instance::claim(shared.store.objects().data_dir())?;
            let pool = runner::pool(limits.threads)?;
            Some(tokio::spawn(runner::run(Arc::clone(&shared), instance, pool)))
        } else {
            None
        };
        Ok(Self {
            shared,
            runner: Arc::new(Mutex::new(runner)),
        })
    }

    /// Takes a job; asked again with the same key, tells of the one it took then.
    /// Errors: what [`JobExecutor::check`] refuses, `QueueFull`, `Taken`, `Stopping`, `Invalid`, `Store`.
    pub async fn submit(&self, spec: JobSpec, key: Option<String>) -> Result<Job, JobError> {
        let shared = &self.shared;
        if *shared.stop.borrow() {
            return Err(JobError::Stopping);
        }
        if let Some(key) = &key {
            check_key(key)?;
            if let Some(row) = shared.store.job_of_key(key).await? {
                return same(&row, &spec);
            }
        }
        shared.execute.check(&spec).await?;
        let new = NewJob {
            kind: spec.kind().to_owned(),
            makes: spec.makes().map(|(kind, name)| format!("{kind} {name}")),
            spec: json(&spec)?,
            progress: json(&StoredProgress::default())?,
            idempotency_key: key,
        };
        match shared.store.enqueue(new, shared.limits.queued as i64, unix_s()).await? {
            EnqueueResult::New(row) => {
                shared.wake.notify_one();
                let job = Job::of(&row)?;
                info!(job.id = %job.id, job.kind = row.kind, "job queued");
                Ok(job)
            }
            EnqueueResult::Same(row) => same(&row, &spec),
            other => Err(self.refused(&other, &spec)),
        }
    }

    fn refused(&self, enqueued: &EnqueueResult, spec: &JobSpec) -> JobError {
        match (enqueued, spec.makes()) {
            (EnqueueResult::Taken, Some((kind, name))) => JobError::Taken {
                kind,
                name: name.to_owned(),
                why: "is being made by another job",
            },
            _ => JobError::QueueFull {
                limit: self.shared.limits.queued,
            },
        }
    }

    /// Jobs, the newest first. Errors: `Invalid`, `Record`, `Store`.
    pub async fn list(&self, filter: JobFilter) -> Result<Vec<Job>, JobError> {
        let rows = self.shared.store.jobs(filter.page()?).await?;
        rows.iter().map(Job::of).collect()
    }

    /// Every job that has not ended. Errors: `Record`, `Store`.
    pub async fn open(&self) -> Result<Vec<Job>, JobError> {
        let mut open = Vec::new();
        for state in [JobState::Queued, JobState::Running] {
            let filter = JobFilter {
                state: Some(state),
                limit: self.shared.limits.queued + 1000,
                ..JobFilter::default()
            };
            open.extend(self.list(filter).await?);
        }
        Ok(open)
    }

    /// One job. Errors: `Unknown`, `Record`, `Store`.
    pub async fn get(&self, id: &str) -> Result<Job, JobError> {
        Job::of(&self.row(id).await?)
    }

    /// Lines of a job's log after that number, the oldest first. Errors: `Unknown`, `Store`.
    pub async fn log(&self, id: &str, after: i64, limit: usize) -> Result<Vec<LogRow>, JobError> {
        let row = self.row(id).await?;
        Ok(self.shared.store.job_log(row.number, after, limit as i64).await?)
    }

    /// The loss curves of a job. Errors: `Unknown`, `Store`.
    pub async fn losses(&self, id: &str) -> Result<Vec<LossRow>, JobError> {
        let row = self.row(id).await?;
        Ok(self.shared.store.job_losses(row.number).await?)
    }

    /// Asks a job to stop: one that waits ends now, one that runs at its next checkpoint.
    /// Errors: `Unknown`, `IllegalTransition` if it has ended, `Store`.
    pub async fn cancel(&self, id: &str) -> Result<Job, JobError> {
        let store = &self.shared.store;
        // Its state may change between looking and asking; it changes only so often.
        loop {
            let row = self.row(id).await?;
            let state = Job::of(&row)?.state;
            let asked = match state.after(JobTransition::Cancel) {
                None => return Err(illegal(id, state, JobTransition::Cancel)),
                Some(_) if state == JobState::Running => store.ask_to_cancel(row.number).await?,
                Some(_) => store.cancel_queued(row.number, unix_s()).await?,
            };
            if asked {
                let job = self.get(id).await;
                self.shared.forget_oldest().await;
                return job;
            }
        }
    }

    /// Puts a job that failed or was cancelled back among those that wait; it goes on from where it was.
    /// Errors: `Unknown`, `IllegalTransition`, `QueueFull`, `Taken`, `Stopping`, `Store`.
    pub async fn resume(&self, id: &str) -> Result<Job, JobError> {
        if *self.shared.stop.borrow() {
            return Err(JobError::Stopping);
        }
        let row = self.row(id).await?;
        let job = Job::of(&row)?;
        if job.state.after(JobTransition::Resume).is_none() {
            return Err(illegal(id, job.state, JobTransition::Resume));
        }
        let limit = self.shared.limits.queued as i64;
        match self.shared.store.requeue(row.number, limit).await? {
            Some(EnqueueResult::New(row)) => {
                self.shared.wake.notify_one();
                Job::of(&row)
            }
            Some(other) => Err(self.refused(&other, &job.spec)),
            None => Err(illegal(id, JobState::Queued, JobTransition::Resume)),
        }
    }

    /// Completes when a job has ended in this process since the last call.
    pub async fn ended(&self) {
        self.shared.ended.notified().await;
    }

    /// Takes no more jobs and asks the one that runs to write its checkpoint and go back among those that wait.
    pub fn begin_stop(&self) {
        self.shared.stop.send_replace(true);
    }

    /// Waits until the runner has ended, at most until `deadline`; says whether it has.
    pub async fn finish_stop(&self, deadline: Instant) -> bool {
        let runner = self.runner.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(runner) = runner else { return true };
        let ended = tokio::time::timeout_at(deadline.into(), runner).await.is_ok();
        if !ended {
            warn!("a job did not reach its checkpoint within the deadline; it goes on from the last one");
        }
        ended
    }

    async fn row(&self, id: &str) -> Result<JobRow, JobError> {
        let found = match number_of(id) {
            Some(number) => self.shared.store.job(number).await?,
            None => None,
        };
        found.ok_or_else(|| JobError::Unknown { id: id.to_owned() })
    }
}

impl JobsInner {
    /// What ended jobs leave is deleted with the last memory of them.
    pub(super) async fn forget_oldest(&self) {
        let forgotten = match self.store.forget_ended(self.limits.ended as i64).await {
            Ok(forgotten) => forgotten,
            Err(error) => return warn!(%error, "could not forget old jobs"),
        };
        for id in forgotten.into_iter().map(id_of) {
            for dir in ["runs", "reports"] {
                if let Err(error) = self.store.objects().delete(&format!("{dir}/{id}")).await {
                    warn!(job.id = %id, %error, "could not delete what a job left");
                }
            }
        }
    }
}

fn illegal(id: &str, state: JobState, event: JobTransition) -> JobError {
    JobError::IllegalTransition {
        id: id.to_owned(),
        state,
        event,
    }
}

fn check_key(key: &str) -> Result<(), JobError> {
    if (1..=MAX_KEY_LENGTH).contains(&key.len()) && key.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Ok(());
    }
    Err(JobError::Invalid {
        field: "Idempotency-Key",
        reason: format!("a key is 1 to {MAX_KEY_LENGTH} visible ASCII characters"),
    })
}

/// The job of an idempotency key, if it is the one asked for.
fn same(row: &JobRow, spec: &JobSpec) -> Result<Job, JobError> {
    let job = Job::of(row)?;
    if job.spec == *spec {
        return Ok(job);
    }
    Err(JobError::Invalid {
        field: "Idempotency-Key",
        reason: format!("it was used for another job, {}; use a new key for a new job", job.id),
    })
}

fn json(value: &impl serde::Serialize) -> Result<String, JobError> {
    serde_json::to_string(value).map_err(|error| JobError::Invalid {
        field: "settings",
        reason: error.to_string(),
    })
}
