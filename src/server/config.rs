//! The server's bounds. Every one is checked before the server starts and has a test that is refused by it.

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::ServerError;
use crate::jobs::JobLimits;
use crate::serving::PredictorConfig;
use crate::store::StoreConfig;

/// All settings of the server, with their defaults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServerConfig {
    /// Where jobs write: `datasets`, `runs`, `reports` and `models` below it.
    pub data_dir: PathBuf,
    /// The directory of the models that are served without having been published by a job.
    pub models_dir: PathBuf,
    /// `sqlite:FILE` or `postgres://…`; a file in the data directory where it is not given.
    pub database: Option<String>,
    /// A directory or `s3://BUCKET/PREFIX` for the files that several machines share; the data directory where it is not
    /// given.
    pub objects: Option<String>,
    /// Whether this process also works on jobs, and not only takes them.
    pub run_jobs: bool,
    /// Bytes of a request's body, and of a message on a socket, at most.
    pub max_body_bytes: usize,
    /// Images in one request at most.
    pub max_frames: usize,
    /// Predictions that may wait; more are answered 503.
    pub max_queued_predictions: usize,
    /// Predictions computed together at most.
    pub max_batch: usize,
    /// Connections at a time; more are answered 503 and closed.
    pub max_connections: usize,
    /// Streams at a time; more are answered 503.
    pub max_streams: usize,
    /// Jobs that may wait; more are answered 503.
    pub max_queued_jobs: usize,
    /// Ended jobs that are remembered.
    pub max_ended_jobs: usize,
    /// Lines of a job's log that are kept.
    pub max_job_log_lines: usize,
    /// Threads that the work of jobs may use.
    pub job_threads: usize,
    /// How long a process that works on a job may be silent before others take it, in milliseconds.
    pub job_lease_ms: u64,
    /// How long a prediction may take, queue and all, in milliseconds.
    pub prediction_deadline_ms: u64,
    /// How long a request may take to arrive and be answered, in milliseconds.
    pub request_deadline_ms: u64,
    /// How long a stream may be silent, in milliseconds.
    pub stream_idle_ms: u64,
    /// How long a client may take to read a message of its stream, in milliseconds.
    pub stream_send_ms: u64,
    /// How long stopping may take, in milliseconds.
    pub shutdown_deadline_ms: u64,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            data_dir: PathBuf::from("data"),
            models_dir: PathBuf::from("models"),
            database: None,
            objects: None,
            run_jobs: true,
            max_body_bytes: 8 << 20,
            max_frames: 64,
            max_queued_predictions: 64,
            max_batch: 16,
            max_connections: 512,
            max_streams: 128,
            max_queued_jobs: 16,
            max_ended_jobs: 100,
            max_job_log_lines: 1000,
            job_threads: spare_cores(),
            job_lease_ms: 30_000,
            prediction_deadline_ms: 10_000,
            request_deadline_ms: 30_000,
            stream_idle_ms: 60_000,
            stream_send_ms: 10_000,
            shutdown_deadline_ms: 10_000,
        }
    }
}

/// One core less than there are, which is left to predictions, but one at least.
fn spare_cores() -> usize {
    std::thread::available_parallelism().map_or(1, |cores| (cores.get() - 1).max(1))
}

/// A day: no deadline is longer.
const MAX_DEADLINE_MS: u64 = 86_400_000;

impl ServerConfig {
    /// Errors: `Config`, which names the field and its range.
    pub fn validate(&self) -> Result<(), ServerError> {
        let deadlines = 1..=MAX_DEADLINE_MS;
        for (field, value, range) in [
            ("max_body_bytes", self.max_body_bytes as u64, 1024..=1 << 30),
            ("max_frames", self.max_frames as u64, 1..=4096),
            (
                "max_queued_predictions",
                self.max_queued_predictions as u64,
                1..=1_000_000,
            ),
            ("max_batch", self.max_batch as u64, 1..=4096),
            ("max_connections", self.max_connections as u64, 1..=1_000_000),
            ("max_streams", self.max_streams as u64, 1..=1_000_000),
            ("max_queued_jobs", self.max_queued_jobs as u64, 1..=10_000),
            ("max_ended_jobs", self.max_ended_jobs as u64, 1..=10_000),
            ("max_job_log_lines", self.max_job_log_lines as u64, 1..=100_000),
            ("job_threads", self.job_threads as u64, 1..=1024),
            ("job_lease_ms", self.job_lease_ms, 1000..=MAX_DEADLINE_MS),
            ("prediction_deadline_ms", self.prediction_deadline_ms, deadlines.clone()),
            ("request_deadline_ms", self.request_deadline_ms, deadlines.clone()),
            ("stream_idle_ms", self.stream_idle_ms, deadlines.clone()),
            ("stream_send_ms", self.stream_send_ms, deadlines.clone()),
            ("shutdown_deadline_ms", self.shutdown_deadline_ms, deadlines),
        ] {
            if !range.contains(&value) {
                return Err(ServerError::Config {
                    field,
                    value,
                    least: *range.start(),
                    most: *range.end(),
                });
            }
        }
        Ok(())
    }

    pub(super) fn predictor(&self) -> PredictorConfig {
        PredictorConfig {
            queue_capacity: self.max_queued_predictions,
            batch_limit: self.max_batch,
            deadline: Duration::from_millis(self.prediction_deadline_ms),
        }
    }

    /// The bounds of jobs.
    #[must_use]
    pub fn jobs(&self) -> JobLimits {
        JobLimits {
            queued: self.max_queued_jobs,
            ended: self.max_ended_jobs,
            log_lines: self.max_job_log_lines,
            threads: self.job_threads,
            lease: Duration::from_millis(self.job_lease_ms),
        }
    }

    /// Where state is kept.
    #[must_use]
    pub fn store(&self) -> StoreConfig {
        StoreConfig {
            data_dir: self.data_dir.clone(),
            database: self.database.clone(),
            objects: self.objects.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_valid() {
        ServerConfig::default().validate().unwrap();
    }

    #[test]
    fn a_bound_of_zero_is_refused_with_its_name_and_range() {
        let config = ServerConfig {
            max_streams: 0,
            ..ServerConfig::default()
        };
        let error = config.validate().unwrap_err().to_string();
        assert_eq!(error, "max_streams is 0; it must be 1 to 1000000");
    }

    #[test]
    fn jobs_without_threads_or_with_a_lease_that_runs_out_at_once_are_refused() {
        let threadless = ServerConfig {
            job_threads: 0,
            ..ServerConfig::default()
        };
        let error = threadless.validate().unwrap_err().to_string();
        assert_eq!(error, "job_threads is 0; it must be 1 to 1024");
        let hasty = ServerConfig {
            job_lease_ms: 10,
            ..ServerConfig::default()
        };
        let error = hasty.validate().unwrap_err().to_string();
        assert_eq!(error, "job_lease_ms is 10; it must be 1000 to 86400000");
    }
}
