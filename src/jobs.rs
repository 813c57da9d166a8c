//! Collection, training and evaluation in the background. [`state`] says which transitions are legal, [`spec`] checks what
//! is asked for, [`queue`] is the handle that enqueues and tells, `runner` takes jobs up one after another and writes of
//! them what `notes` gathered, [`pipeline`] does the work. The jobs themselves lie in the store, so that they outlast the
//! process and several processes can share them.

mod checkpoints;
pub mod datasets;
mod instance;
pub mod job;
mod notes;
pub mod pipeline;
mod priority;
pub mod queue;
mod runner;
pub mod spec;
pub mod state;

use crate::dataset::DatasetError;
use crate::store::{StoreError, unix_s};
use crate::versions::VersionError;

pub use job::{Job, JobFilter};
pub use notes::{JobProgress, Losses};
pub use queue::{JobLimits, Jobs};
pub use runner::{JobExecutor, JobFailure, JobReporter, JobResult};
pub use spec::{CollectSpec, EvaluateSpec, JobSpec, TrainSpec};
pub use state::{JobState, JobTransition};

/// Why a job was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum JobError {
    /// No job has that id.
    #[error("there is no job \"{id}\"; of those that ended only the latest are remembered")]
    Unknown {
        /// The id asked for.
        id: String,
    },
    /// The job's state does not allow it.
    #[error("job {id} has {state}; only one that {} can {event}", event.whose())]
    IllegalTransition {
        /// The job.
        id: String,
        /// Its state.
        state: JobState,
        /// What was asked of it.
        event: JobTransition,
    },
    /// As many jobs wait as may.
    #[error("{limit} jobs wait already; cancel one or try again later")]
    QueueFull {
        /// How many may wait.
        limit: usize,
    },
    /// A field of the job does not say what can be done.
    #[error("{field}: {reason}")]
    Invalid {
        /// The field's name.
        field: &'static str,
        /// What is wrong with it, and what would be right.
        reason: String,
    },
    /// What the job starts from is not there.
    #[error("{field}: there is no {kind} \"{name}\"; there are: {}", list(.known))]
    NotFound {
        /// The field's name.
        field: &'static str,
        /// `data set`, …
        kind: &'static str,
        /// The name asked for.
        name: String,
        /// The names there are.
        known: Vec<String>,
    },
    /// What the job would make is there, or another job makes it.
    #[error("name: {kind} \"{name}\" {why}; choose another name")]
    Taken {
        /// `data set`, …
        kind: &'static str,
        /// The name asked for.
        name: String,
        /// Who has it.
        why: &'static str,
    },
    /// The directory holds what an earlier job left, which this one cannot go on with.
    #[error("name: data set \"{name}\" {why}, or choose another name")]
    Occupied {
        /// The name asked for.
        name: String,
        /// What is there, and what would help.
        why: String,
    },
    /// A job that has not ended needs it.
    #[error("{kind} \"{name}\" is in use by {job}; wait for its end or cancel it")]
    InUse {
        /// `data set`, …
        kind: &'static str,
        /// Its name.
        name: String,
        /// The job's id.
        job: String,
    },
    /// The server is stopping.
    #[error("the server is stopping and takes no more jobs")]
    Stopping,
    /// What the store holds of a job cannot be read by this program.
    #[error("the store's record of job {id} cannot be read: {reason}")]
    Record {
        /// The job.
        id: String,
        /// Where it went wrong.
        reason: String,
    },
    /// No identity could be had in the data directory.
    #[error("could not register in the data directory: {0}")]
    Instance(#[source] std::io::Error),
    /// The runner's threads could not be started.
    #[error("could not start the threads for jobs: {0}")]
    Threads(#[source] rayon::ThreadPoolBuildError),
    /// The data sets could not be looked at.
    #[error(transparent)]
    Dataset(Box<DatasetError>),
    /// The models could not be looked at.
    #[error(transparent)]
    Versions(Box<VersionError>),
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl From<DatasetError> for JobError {
    fn from(error: DatasetError) -> Self {
        Self::Dataset(Box::new(error))
    }
}

impl From<VersionError> for JobError {
    fn from(error: VersionError) -> Self {
        Self::Versions(Box::new(error))
    }
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        "none yet".to_owned()
    } else {
        names.join(", ")
    }
}
