//! `foreframe run-job`: the child process of a server or worker that runs one job.

use super::error::CliError;
use crate::telemetry::{self, LogFormat};
use foreframe_jobs::jobs::child;

pub(super) fn run() -> Result<(), CliError> {
    let _telemetry = telemetry::init(LogFormat::Text, None)?;
    child::run().map_err(CliError::Failed)
}
