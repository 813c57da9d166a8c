//! `foreframe run-job`: the child process of a server or worker that runs one job.

use super::CliError;
use crate::jobs::child;

pub(super) fn run() -> Result<(), CliError> {
    child::run().map_err(CliError::Failed)
}
