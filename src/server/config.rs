//! The settings of the server. Every bound is checked before the server starts, and has a test that exceeds it.

mod bounds;

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

pub use self::bounds::SettingError;
use foreframe_core::serving::PredictorConfig;
use foreframe_data::dataset::import::DEFAULT_DISK_MIB;
use foreframe_jobs::jobs::JobLimits;
use foreframe_jobs::jobs::child::JobProcess;
use foreframe_jobs::jobs::memory::{self, JobMemory};
use foreframe_jobs::jobs::pipeline::JobResources;
use foreframe_jobs::store::StoreConfig;

/// All settings of the server, with their defaults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default)]
pub struct ServerConfig {
    /// Where jobs write: in its folders `datasets`, `runs`, `reports` and `models`.
    #[schema(value_type = String)]
    pub data_dir: PathBuf,
    /// The directory of the models that were not published by a job of this server.
    #[schema(value_type = String)]
    pub models_dir: PathBuf,
    /// `sqlite:FILE` or `postgres://…`. Default: a file in the data directory.
    pub database_url: Option<String>,
    /// How long a starting server or worker waits for its PostgreSQL, in seconds.
    pub database_wait_s: u64,
    /// A directory or `s3://BUCKET/PREFIX` for the files that several machines share. Default: the data directory.
    pub objects_url: Option<String>,
    /// The directory with the recordings that import jobs may read. Default: none, so imports are off.
    #[schema(value_type = Option<String>)]
    pub import_dir: Option<PathBuf>,
    /// The certificate chain of the public address as a PEM file, for HTTPS; needs the Cargo feature `tls`. The file is read
    /// again when it changes.
    #[schema(value_type = Option<String>)]
    pub tls_certificate: Option<PathBuf>,
    /// The private key of that certificate as a PEM file.
    #[schema(value_type = Option<String>)]
    pub tls_key: Option<PathBuf>,
    /// Whether this server runs jobs. If false, it accepts jobs and leaves the work to workers.
    pub run_jobs: bool,
    /// Maximum size of a request body and of a message of a stream, in bytes.
    pub max_body_bytes: usize,
    /// Maximum size of the request body of a job, in bytes.
    pub max_job_bytes: usize,
    /// Maximum number of images in one request.
    pub max_frames: usize,
    /// Maximum number of predictions that wait; more are refused with 503.
    pub max_queued_predictions: usize,
    /// Maximum number of rollouts in a batch; one request gets at most a quarter of a batch.
    pub max_batch: usize,
    /// Maximum size of all request bodies and messages of streams that the server reads or works with at the same time, in
    /// bytes; more requests are refused with 503, more streams closed with 1013. At least `max_body_bytes`.
    pub max_total_body_bytes: usize,
    /// Maximum number of connections. If all are open, a new one replaces the one that was idle the longest; see
    /// `connection_evict_ms`. If none is idle, it is refused with 503 and closed.
    pub max_connections: usize,
    /// Maximum number of connections from one IPv4 address or one /64 network of IPv6. Behind a reverse proxy, all come from
    /// the same address: set it to `max_connections`.
    pub max_connections_per_address: usize,
    /// How long a connection must have been idle, without a request that is being answered, to be replaced by a new one, in
    /// milliseconds.
    pub connection_evict_ms: u64,
    /// Maximum number of connections to `admin_bind`.
    pub max_admin_connections: usize,
    /// Maximum number of requests that are processed at the same time; more are refused with 503. Streams and event streams
    /// are not counted.
    pub max_requests: usize,
    /// Maximum number of streams; more are refused with 503.
    pub max_streams: usize,
    /// Maximum number of event streams of jobs; more are refused with 503.
    pub max_event_streams: usize,
    /// Maximum number of simulated environments; see `environment_evict_ms`.
    pub max_environments: usize,
    /// Maximum number of sessions; more are refused with 503.
    pub max_sessions: usize,
    /// Maximum number of frames of a stream that are read before the earlier ones are answered; more are read later.
    pub max_pipelined_frames: usize,
    /// Maximum size of the messages that wait for a slow reader of a stream, in bytes. Beyond it, the oldest predictions
    /// are dropped.
    pub max_stream_buffer_bytes: usize,
    /// Maximum number of plans in one rollout request.
    pub max_plans: usize,
    /// Maximum size of the predicted images of one rollout request, in bytes before encoding.
    pub max_rollout_bytes: usize,
    /// Maximum number of frames that a request can ask to predict, if that is more than the model's horizon.
    pub max_steps: usize,
    /// Maximum number of jobs that wait; more are refused with 503.
    pub max_queued_jobs: usize,
    /// Maximum number of ended jobs in the list; older ones are removed.
    pub max_ended_jobs: usize,
    /// Maximum number of lines of a job's log; older ones are removed.
    pub max_job_log_lines: usize,
    /// Number of threads for jobs.
    pub job_threads: usize,
    /// Number of threads that decode and encode the images of predictions; more such work waits. A second pool of the
    /// same size simulates and reads files.
    pub request_threads: usize,
    /// Number of threads that make pictures of data sets, models and predictions, and read reports; more such work waits. On
    /// Linux, they run at lower priority.
    pub picture_threads: usize,
    /// Maximum size of the pictures and reports that are kept to answer the same request again, in bytes; 0 keeps none.
    pub max_cached_bytes: usize,
    /// Memory that one job can use, in MiB; 0 for no limit. Needs Linux.
    pub job_memory_mib: u64,
    /// Memory for the frames of one data set, in MiB, in commands and jobs; in a job, at most a third of `job_memory_mib`. The
    /// frames of a larger data set are decoded once into a file in its directory (`.cache`) and read from there.
    pub dataset_memory_mib: u64,
    /// After this many attempts in a row that ended abnormally without progress, a job fails.
    pub job_max_attempts: u32,
    /// How long one attempt of a job can run, in seconds; 0 for no limit.
    pub job_time_limit_s: u64,
    /// How long a running job may report no progress, in seconds; 0 for no limit. After this time its process is killed, and the
    /// next attempt resumes from the last checkpoint. An import reports no progress while it reads the recording: raise this limit
    /// for recordings that take longer.
    pub job_stall_limit_s: u64,
    /// Disk space for the frames of a compressed `.npz` file while they are imported, in MiB. An import that needs more is refused;
    /// 0 refuses all compressed frames.
    pub import_disk_mib: u64,
    /// The program whose `run-job` runs each job in a process of its own; without one, jobs run in this process.
    #[serde(skip)]
    pub job_program: Option<PathBuf>,
    /// How long a lease of a job lasts without renewal, in milliseconds. After that, another process can claim the job.
    pub job_lease_ms: u64,
    /// How long a prediction may take, including its time in the queue, in milliseconds.
    pub prediction_deadline_ms: u64,
    /// How long a request may take to arrive and be answered, in milliseconds.
    pub request_deadline_ms: u64,
    /// How long an environment is kept that nobody steps, in milliseconds.
    pub environment_idle_ms: u64,
    /// At the limit of environments, a new one replaces the one that was idle the longest, if that was idle for at least
    /// this time, in milliseconds.
    pub environment_evict_ms: u64,
    /// How long a stream may be idle, in milliseconds.
    pub stream_idle_ms: u64,
    /// How long a client may take to read a message of its stream, in milliseconds.
    pub stream_send_ms: u64,
    /// Maximum size of a request's head, in bytes; a longer one is refused with 431.
    pub max_header_bytes: usize,
    /// How long a request's head may take to arrive, counted from the start of the connection or from the previous
    /// response, in milliseconds. So this is also how long a connection may be idle. A TLS handshake may take as long.
    pub header_read_ms: u64,
    /// How long a client may read nothing while a response is written to it, in milliseconds.
    pub write_stall_ms: u64,
    /// How long the server drains: it accepts requests while `/readyz` answers 503, in milliseconds.
    pub drain_ms: u64,
    /// How long a session is kept without an open stream and without use, in milliseconds.
    pub session_grace_ms: u64,
    /// How long stopping may take, including draining, in milliseconds.
    pub shutdown_deadline_ms: u64,
    /// How often the API keys are read, in milliseconds. A revoked key may be valid for that long.
    pub key_refresh_ms: u64,
    /// Origins of other web pages that may call this server, for example `https://robots.example`. If authentication is
    /// off, their hosts are also the only names with a dot that the server answers to.
    pub cors_origins: Vec<String>,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            data_dir: PathBuf::from("data"),
            models_dir: PathBuf::from("models"),
            database_url: None,
            database_wait_s: 60,
            objects_url: None,
            import_dir: None,
            tls_certificate: None,
            tls_key: None,
            run_jobs: true,
            max_body_bytes: 8 << 20,
            max_job_bytes: 64 << 10,
            max_frames: 64,
            max_queued_predictions: 256,
            max_batch: 64,
            max_total_body_bytes: 256 << 20,
            max_connections: 512,
            max_connections_per_address: 256,
            connection_evict_ms: 1_000,
            max_admin_connections: 32,
            max_requests: 384,
            max_streams: 128,
            max_event_streams: 128,
            max_environments: 16,
            max_sessions: 1024,
            max_pipelined_frames: 16,
            max_stream_buffer_bytes: 4 << 20,
            max_plans: 512,
            max_rollout_bytes: 64 << 20,
            max_steps: 50,
            max_queued_jobs: 16,
            max_ended_jobs: 100,
            max_job_log_lines: 1000,
            job_threads: spare_cores(),
            request_threads: 4,
            picture_threads: 1,
            max_cached_bytes: 64 << 20,
            job_memory_mib: memory::default_limit_mib(),
            dataset_memory_mib: memory::default_dataset_mib(),
            job_max_attempts: 3,
            job_time_limit_s: 0,
            job_stall_limit_s: 7_200,
            import_disk_mib: DEFAULT_DISK_MIB,
            job_program: None,
            job_lease_ms: 30_000,
            prediction_deadline_ms: 10_000,
            request_deadline_ms: 30_000,
            environment_idle_ms: 600_000,
            environment_evict_ms: 5_000,
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

/// All cores but one, which is left for predictions; at least one.
fn spare_cores() -> usize {
    std::thread::available_parallelism().map_or(1, |cores| (cores.get() - 1).max(1))
}

impl ServerConfig {
    pub(in crate::server) fn predictor(&self) -> PredictorConfig {
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
            stall_limit: (self.job_stall_limit_s > 0).then(|| Duration::from_secs(self.job_stall_limit_s)),
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
            resources: self.job_resources(),
        })
    }

    /// What one job can use.
    #[must_use]
    pub fn job_resources(&self) -> JobResources {
        JobResources {
            threads: self.job_threads,
            memory: JobMemory {
                limit_mib: self.job_memory_mib,
                dataset_mib: self.dataset_memory_mib,
            },
            import_dir: self.import_dir.clone(),
            import_disk_mib: self.import_disk_mib,
        }
    }

    /// Where metadata and files are kept.
    #[must_use]
    pub fn store(&self) -> StoreConfig {
        StoreConfig {
            data_dir: self.data_dir.clone(),
            database: self.database_url.clone(),
            objects: self.objects_url.clone(),
        }
    }
}
