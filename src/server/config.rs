//! The server's bounds. Every one is checked before the server starts and has a test that is refused by it.

use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::ServerError;
use crate::jobs::JobLimits;
use crate::jobs::child::JobProcess;
use crate::serving::PredictorConfig;
use crate::store::StoreConfig;

/// All settings of the server, with their defaults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default)]
pub struct ServerConfig {
    /// Where jobs write: `datasets`, `runs`, `reports` and `models` below it.
    #[schema(value_type = String)]
    pub data_dir: PathBuf,
    /// The directory of the models that are served without having been published by a job.
    #[schema(value_type = String)]
    pub models_dir: PathBuf,
    /// `sqlite:FILE` or `postgres://…`; a file in the data directory where it is not given.
    pub database_url: Option<String>,
    /// A directory or `s3://BUCKET/PREFIX` for the files that several machines share; the data directory where it is not
    /// given.
    pub objects_url: Option<String>,
    /// Whether this process only takes jobs, and leaves them to workers.
    pub no_jobs: bool,
    /// Bytes of a request's body, and of a message on a socket, at most.
    pub max_body_bytes: usize,
    /// Bytes of a request for a job at most.
    pub max_job_bytes: usize,
    /// Images in one request at most.
    pub max_frames: usize,
    /// Predictions that may wait; more are answered 503.
    pub max_queued_predictions: usize,
    /// Futures predicted together at most; of one request a quarter of that.
    pub max_batch: usize,
    /// Connections at a time; more are answered 503 and closed.
    pub max_connections: usize,
    /// Streams at a time; more are answered 503.
    pub max_streams: usize,
    /// Simulated environments at a time; more are answered 503.
    pub max_environments: usize,
    /// Sessions at a time; more are answered 503.
    pub max_sessions: usize,
    /// Frames of a stream that are read before those before them are answered; more are read later.
    pub max_pipelined_frames: usize,
    /// Bytes of answers that wait for a slow reader of a stream; beyond them the oldest predictions are dropped.
    pub max_stream_buffer_bytes: usize,
    /// Candidates in one request for rollouts at most.
    pub max_candidates: usize,
    /// Bytes of predicted images, unencoded, that one request for rollouts may ask for.
    pub max_rollout_bytes: usize,
    /// Jobs that may wait; more are answered 503.
    pub max_queued_jobs: usize,
    /// Ended jobs that are remembered.
    pub max_ended_jobs: usize,
    /// Lines of a job's log that are kept.
    pub max_job_log_lines: usize,
    /// Threads that the work of jobs may use.
    pub job_threads: usize,
    /// Threads that decode and encode images, simulate and read files for requests; more such work waits.
    pub request_threads: usize,
    /// Memory that one job can use, in MiB; 0 for no limit. Needs Linux.
    pub job_memory_mb: u64,
    /// After this many attempts in a row that ended abnormally without progress, a job fails.
    pub job_max_attempts: u32,
    /// How long one attempt of a job can run, in seconds; 0 for no limit.
    pub job_time_limit_s: u64,
    /// The program whose `run-job` runs each job in a process of its own; without one, jobs run in this process.
    #[serde(skip)]
    pub job_program: Option<PathBuf>,
    /// How long a process that works on a job may be silent before others take it, in milliseconds.
    pub job_lease_ms: u64,
    /// How long a prediction may take, queue and all, in milliseconds.
    pub prediction_deadline_ms: u64,
    /// How long a request may take to arrive and be answered, in milliseconds.
    pub request_deadline_ms: u64,
    /// How long an environment is kept that nobody steps, in milliseconds.
    pub environment_idle_ms: u64,
    /// How long a stream may be silent, in milliseconds.
    pub stream_idle_ms: u64,
    /// How long a client may take to read a message of its stream, in milliseconds.
    pub stream_send_ms: u64,
    /// Bytes of a request's head at most; more are answered 431.
    pub max_header_bytes: usize,
    /// How long a request's head may take to arrive, from the connection's opening or the answer before it: so also how
    /// long a connection may be idle, in milliseconds.
    pub header_read_ms: u64,
    /// How long a client may read nothing of what is written to it, in milliseconds.
    pub write_stall_ms: u64,
    /// How long the server, told to stop, goes on taking requests while `/readyz` says 503, in milliseconds.
    pub drain_ms: u64,
    /// How long a session is kept when no stream is open and nobody uses it, in milliseconds.
    pub session_grace_ms: u64,
    /// How long stopping may take, draining and all, in milliseconds.
    pub shutdown_deadline_ms: u64,
    /// How often keys are read: how long a revoked one may still be taken, in milliseconds.
    pub key_refresh_ms: u64,
    /// Origins of other pages whose scripts may call this server, for example `https://robots.example`. Where no key is
    /// asked for, the hosts in them are also the only names with a dot that the server answers to.
    pub cors_origins: Vec<String>,
}

/// A field with its value and the range it must be in.
type Bound = (&'static str, u64, RangeInclusive<u64>);

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            data_dir: PathBuf::from("data"),
            models_dir: PathBuf::from("models"),
            database_url: None,
            objects_url: None,
            no_jobs: false,
            max_body_bytes: 8 << 20,
            max_job_bytes: 64 << 10,
            max_frames: 64,
            max_queued_predictions: 256,
            max_batch: 64,
            max_connections: 512,
            max_streams: 128,
            max_environments: 16,
            max_sessions: 1024,
            max_pipelined_frames: 16,
            max_stream_buffer_bytes: 4 << 20,
            max_candidates: 512,
            max_rollout_bytes: 64 << 20,
            max_queued_jobs: 16,
            max_ended_jobs: 100,
            max_job_log_lines: 1000,
            job_threads: spare_cores(),
            request_threads: 4,
            job_memory_mb: crate::jobs::memory::default_limit_mb(),
            job_max_attempts: 3,
            job_time_limit_s: 0,
            job_program: None,
            job_lease_ms: 30_000,
            prediction_deadline_ms: 10_000,
            request_deadline_ms: 30_000,
            environment_idle_ms: 600_000,
            stream_idle_ms: 60_000,
            stream_send_ms: 10_000,
            max_header_bytes: 32 << 10,
            header_read_ms: 30_000,
            write_stall_ms: 30_000,
            drain_ms: 0,
            session_grace_ms: 60_000,
            shutdown_deadline_ms: 10_000,
            key_refresh_ms: 5_000,
            cors_origins: Vec::new(),
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
        self.out_of_bounds().map_or(Ok(()), |(field, value, range)| {
            Err(ServerError::Config {
                field,
                value,
                least: *range.start(),
                most: *range.end(),
            })
        })
    }

    /// The first field that is out of its range.
    #[must_use]
    pub fn out_of_bounds(&self) -> Option<Bound> {
        let mut bounds = self.bounds().into_iter();
        bounds.find(|(_, value, range)| !range.contains(value))
    }

    /// Every number with the range it must be in.
    #[must_use]
    pub fn bounds(&self) -> Vec<Bound> {
        let deadline = 1..=MAX_DEADLINE_MS;
        let count = 1..=1_000_000;
        vec![
            ("max_body_bytes", self.max_body_bytes as u64, 1024..=1 << 30),
            ("max_job_bytes", self.max_job_bytes as u64, 1024..=16 << 20),
            ("max_frames", self.max_frames as u64, 1..=4096),
            (
                "max_queued_predictions",
                self.max_queued_predictions as u64,
                count.clone(),
            ),
            ("max_batch", self.max_batch as u64, 1..=4096),
            ("max_connections", self.max_connections as u64, count.clone()),
            ("max_streams", self.max_streams as u64, count.clone()),
            ("max_sessions", self.max_sessions as u64, count),
            ("max_environments", self.max_environments as u64, 1..=10_000),
            ("max_pipelined_frames", self.max_pipelined_frames as u64, 1..=4096),
            (
                "max_stream_buffer_bytes",
                self.max_stream_buffer_bytes as u64,
                1024..=1 << 30,
            ),
            ("max_candidates", self.max_candidates as u64, 1..=100_000),
            ("max_rollout_bytes", self.max_rollout_bytes as u64, 1024..=1 << 32),
            ("max_queued_jobs", self.max_queued_jobs as u64, 1..=10_000),
            ("max_ended_jobs", self.max_ended_jobs as u64, 1..=10_000),
            ("max_job_log_lines", self.max_job_log_lines as u64, 1..=100_000),
            ("job_threads", self.job_threads as u64, 1..=1024),
            ("request_threads", self.request_threads as u64, 1..=1024),
            ("job_memory_mb", self.job_memory_mb, 0..=1 << 30),
            ("job_max_attempts", u64::from(self.job_max_attempts), 1..=1_000_000),
            ("job_time_limit_s", self.job_time_limit_s, 0..=100_000_000),
            ("job_lease_ms", self.job_lease_ms, 1000..=MAX_DEADLINE_MS),
            ("max_header_bytes", self.max_header_bytes as u64, 8192..=1 << 20),
            ("prediction_deadline_ms", self.prediction_deadline_ms, deadline.clone()),
            ("request_deadline_ms", self.request_deadline_ms, deadline.clone()),
            ("environment_idle_ms", self.environment_idle_ms, deadline.clone()),
            ("stream_idle_ms", self.stream_idle_ms, deadline.clone()),
            ("stream_send_ms", self.stream_send_ms, deadline.clone()),
            ("session_grace_ms", self.session_grace_ms, deadline.clone()),
            ("header_read_ms", self.header_read_ms, deadline.clone()),
            ("write_stall_ms", self.write_stall_ms, deadline.clone()),
            ("shutdown_deadline_ms", self.shutdown_deadline_ms, deadline),
            ("drain_ms", self.drain_ms, 0..=self.shutdown_deadline_ms),
            ("key_refresh_ms", self.key_refresh_ms, 100..=MAX_DEADLINE_MS),
        ]
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
            max_attempts: self.job_max_attempts,
            time_limit: (self.job_time_limit_s > 0).then(|| Duration::from_secs(self.job_time_limit_s)),
            lease: Duration::from_millis(self.job_lease_ms),
        }
    }

    /// How to run jobs in child processes, if `job_program` is set.
    #[must_use]
    pub fn job_process(&self) -> Option<JobProcess> {
        Some(JobProcess {
            program: self.job_program.clone()?,
            store: self.store(),
            models_dir: self.models_dir.clone(),
            threads: self.job_threads,
            memory_mb: self.job_memory_mb,
        })
    }

    /// Where state is kept.
    #[must_use]
    pub fn store(&self) -> StoreConfig {
        StoreConfig {
            data_dir: self.data_dir.clone(),
            database: self.database_url.clone(),
            objects: self.objects_url.clone(),
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
    fn no_bound_of_a_session_may_be_zero() {
        type Field = fn(&mut ServerConfig);
        let fields: [(&str, Field); 6] = [
            ("max_sessions", |config| config.max_sessions = 0),
            ("max_pipelined_frames", |config| config.max_pipelined_frames = 0),
            ("max_stream_buffer_bytes", |config| config.max_stream_buffer_bytes = 0),
            ("max_candidates", |config| config.max_candidates = 0),
            ("max_rollout_bytes", |config| config.max_rollout_bytes = 0),
            ("session_grace_ms", |config| config.session_grace_ms = 0),
        ];
        for (name, clear) in fields {
            let mut config = ServerConfig::default();
            clear(&mut config);
            let error = config.validate().unwrap_err().to_string();
            assert!(error.starts_with(&format!("{name} is 0; it must be")), "{error}");
        }
    }

    #[test]
    fn requests_or_jobs_without_threads_or_room_or_with_a_lease_that_runs_out_at_once_are_refused() {
        let roomless = ServerConfig {
            max_job_bytes: 0,
            ..ServerConfig::default()
        };
        let error = roomless.validate().unwrap_err().to_string();
        assert_eq!(error, "max_job_bytes is 0; it must be 1024 to 16777216");
        let threadless = ServerConfig {
            job_threads: 0,
            ..ServerConfig::default()
        };
        let error = threadless.validate().unwrap_err().to_string();
        assert_eq!(error, "job_threads is 0; it must be 1 to 1024");
        let handless = ServerConfig {
            request_threads: 0,
            ..ServerConfig::default()
        };
        let error = handless.validate().unwrap_err().to_string();
        assert_eq!(error, "request_threads is 0; it must be 1 to 1024");
        let hasty = ServerConfig {
            job_lease_ms: 10,
            ..ServerConfig::default()
        };
        let error = hasty.validate().unwrap_err().to_string();
        assert_eq!(error, "job_lease_ms is 10; it must be 1000 to 86400000");
    }
}
