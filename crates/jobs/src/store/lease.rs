//! The right to work on a job.

use serde::{Deserialize, Serialize};

use super::job_id::JobId;

/// The right to work on a job: its id and the fencing token of the claim.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lease {
    /// The job.
    pub job: JobId,
    /// The fencing token.
    pub token: i64,
}
