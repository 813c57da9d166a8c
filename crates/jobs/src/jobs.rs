//! Collection, import, training and evaluation in the background. [`state`] defines the legal transitions, [`spec`] checks
//! submitted jobs, [`queue`] is the handle for callers, `runner` claims jobs one after another and writes their reports,
//! `progress` buffers the reports, [`pipeline`] does the work. The store holds the jobs, so that they survive the process
//! and several processes can share them.

mod checkpoints;
pub mod child;
pub mod datasets;
mod executor;
mod instance;
pub mod job;
pub mod memory;
pub mod pipeline;
pub mod priority;
mod progress;
pub mod queue;
mod report;
mod retry_policy;
mod runner;
mod shared;
pub mod spec;
pub mod state;
pub mod uploads;

use crate::store::{JobId, JobIdError, StoreError, unix_s};
use crate::versions::VersionError;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::types::DatasetName;
use foreframe_data::dataset::DatasetError;

pub use executor::{JobExecutor, JobFailure, JobResult};
pub use job::{Job, JobFilter, JobParts};
pub use progress::{JobProgress, Losses};
pub use queue::Jobs;
pub use report::JobReporter;
pub use shared::JobLimits;
pub use spec::{AdaptSpec, CollectSpec, EvaluateSpec, ImportSpec, JobSpec, TrainSpec};
pub use state::{JobState, JobTransition};

/// Why a job was refused.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// No job has that id.
    #[error("there is no job \"{0}\"; only the latest ended jobs are kept")]
    Unknown(String),
    /// The job's state does not allow the transition.
    #[error("job {id} is {state}; only a {} job can {event}", event.allowed_states())]
    IllegalTransition {
        /// The job.
        id: JobId,
        /// Its state.
        state: JobState,
        /// The requested transition.
        event: JobTransition,
    },
    /// Parts of a cancelled job still run.
    #[error("parts of job {0} have not stopped yet; resume it when they have")]
    PartsStopping(JobId),
    /// The queue is full. Holds the number of waiting jobs.
    #[error("the job queue is full ({0} jobs are waiting); cancel one or try again later")]
    QueueFull(usize),
    /// The key's share of the queue is full. Holds the number of its waiting jobs.
    #[error("{0} jobs of this API key are waiting, which is its share of the job queue; cancel one or try again later")]
    ShareFull(i64),
    /// A field of the job is not valid.
    #[error("{field}: {reason}")]
    Invalid {
        /// The field's name.
        field: &'static str,
        /// What is wrong with it, and what would be right.
        reason: String,
    },
    /// An input of the job does not exist.
    #[error("{field}: there is no {kind} \"{name}\"; there are: {}", list(.available))]
    NotFound {
        /// The field's name.
        field: &'static str,
        /// `data set`, …
        kind: &'static str,
        /// The requested name.
        name: String,
        /// The existing names.
        available: Vec<String>,
    },
    /// The job's output exists already, another job is making it, or the output directory holds files that this job cannot
    /// continue.
    #[error("name: data set \"{name}\" {why}")]
    Taken {
        /// The requested name.
        name: DatasetName,
        /// Why it is not free, and how to free it.
        why: String,
    },
    /// A queued or running job needs it.
    #[error("data set \"{name}\" is in use by {job}; wait until that job has ended, or cancel it")]
    InUse {
        /// Its name.
        name: DatasetName,
        /// The job's id.
        job: JobId,
    },
    /// The server is stopping.
    #[error("the server is stopping and accepts no more jobs")]
    Stopping,
    /// This program cannot read the job's row in the store.
    #[error("the store's record of job {id} cannot be read: {reason}")]
    Record {
        /// The job.
        id: JobId,
        /// What is wrong with it.
        reason: String,
    },
    /// The process could not get a runner's id in the data directory.
    #[error("could not register as a runner in the data directory: {0}")]
    Instance(#[source] std::io::Error),
    /// The threads for jobs could not be started.
    #[error("could not start the threads for jobs: {0}")]
    Threads(#[source] rayon::ThreadPoolBuildError),
    /// The data sets could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The models could not be read.
    #[error(transparent)]
    Versions(#[from] VersionError),
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl HasErrorKind for JobError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Unknown(_) => ErrorKind::NotFound,
            Self::Invalid { .. } | Self::NotFound { .. } => ErrorKind::Usage,
            Self::IllegalTransition { .. } | Self::PartsStopping(_) | Self::Taken { .. } | Self::InUse { .. } => {
                ErrorKind::Conflict
            }
            Self::QueueFull(_) | Self::ShareFull(_) | Self::Stopping => ErrorKind::Busy,
            Self::Dataset(error) => error.kind().of_own_data(),
            Self::Versions(error) => error.kind().of_own_data(),
            Self::Store(error) => error.kind().of_own_data(),
            Self::Record { .. } | Self::Instance(_) | Self::Threads(_) => ErrorKind::Internal,
        }
    }
}

impl JobError {
    fn invalid(field: &'static str, reason: impl Into<String>) -> Self {
        let reason = reason.into();
        Self::Invalid { field, reason }
    }

    fn taken(name: &DatasetName, why: impl Into<String>) -> Self {
        let (name, why) = (name.clone(), why.into());
        Self::Taken { name, why }
    }
}

/// No job has that id: it is not even an id.
impl From<JobIdError> for JobError {
    fn from(JobIdError(id): JobIdError) -> Self {
        Self::Unknown(id)
    }
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        return "none yet".to_owned();
    }
    names.join(", ")
}
