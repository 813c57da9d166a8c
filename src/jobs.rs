//! Collection and training in the background: [`state`] says which transitions are legal, [`table`] holds the jobs,
//! [`spec`] checks what is asked for, [`runner`] runs one job at a time on a thread of its own, [`pipeline`] does the
//! work and publishes what came of it.

pub mod pipeline;
pub mod runner;
pub mod spec;
pub mod state;
pub mod table;

pub use runner::{Execute, Failure, Jobs, Report};
pub use spec::{CollectSpec, JobSpec, TrainSpec};
pub use state::{Event, JobState};
pub use table::{Job, JobTable, Losses, Progress, TableLimits};

/// Why a job was refused.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// No job has that id.
    #[error("there is no job \"{id}\"")]
    Unknown {
        /// The id asked for.
        id: String,
    },
    /// The job's state does not allow it.
    #[error("job {id} has {state}; it cannot {event} any more")]
    IllegalTransition {
        /// The job.
        id: String,
        /// Its state.
        state: JobState,
        /// What was asked of it.
        event: Event,
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
        /// `data set`, `model`, …
        kind: &'static str,
        /// The name asked for.
        name: String,
        /// Who has it.
        why: &'static str,
    },
    /// The directory holds what an earlier job left, which this one cannot go on with.
    #[error("name: {reason}")]
    Occupied {
        /// What is there.
        reason: String,
    },
    /// The server is stopping.
    #[error("the server is stopping and takes no more jobs")]
    Stopping,
    /// The runner's thread could not be started.
    #[error("could not start the job runner's thread")]
    Thread(#[source] std::io::Error),
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        "none yet".to_owned()
    } else {
        names.join(", ")
    }
}
