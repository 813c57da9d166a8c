//! `foreframe run-job`: the child process of a server or worker that runs one job.

use super::error::CliError;
use crate::jobs::child;
use crate::telemetry::{self, LogFormat};

pub(super) fn run() -> Result<(), CliError> {
    let _telemetry = telemetry::init(LogFormat::Text, None)?;
    child::run().map_err(CliError::Failed)
}
