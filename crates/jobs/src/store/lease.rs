//! The right to work on a job.

use serde::{Deserialize, Serialize};

/// The right to work on a job: its number and the fencing token of the claim.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lease {
    /// The job.
    pub number: i64,
    /// The fencing token.
    pub token: i64,
}
