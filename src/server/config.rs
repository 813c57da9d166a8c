//! The settings of the server. Every bound is checked before the server starts, and has a test that exceeds it.

use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::telemetry::LogFormat;
use foreframe_core::nn::device::DeviceName;
use foreframe_core::nn::precision::Precision;
use foreframe_core::nn::spec::MAX_STEPS;
use foreframe_core::serving::PredictorConfig;
use foreframe_data::dataset::import::{DEFAULT_DISK_MIB, DEFAULT_MAX_FILES};
use foreframe_jobs::jobs::JobLimits;
use foreframe_jobs::jobs::child::JobProcess;
use foreframe_jobs::jobs::memory::{self, JobMemory};
use foreframe_jobs::jobs::pipeline::JobResources;
use foreframe_jobs::store::StoreConfig;

/// A setting out of range.
#[derive(Debug, thiserror::Error)]
#[error("{field} is {value}; it must be {} to {}", range.start(), range.end())]
pub struct SettingError {
    /// The setting.
    pub field: &'static str,
    /// Its value.
    pub value: u64,
    /// What it may be.
    pub range: RangeInclusive<u64>,
}

/// A field with its value and the range it must be in.
type Bound = (&'static str, u64, RangeInclusive<u64>);

/// A day: no deadline is longer.
const MAX_DEADLINE_MS: u64 = 86_400_000;
/// The most rollouts of a batch: a step of a stream waits for all of them, with `moving` about a fifth of a second on two cores.
const MAX_BATCH: u64 = 512;
/// The most of what the server counts.
const MAX_COUNT: u64 = 1_000_000;

/// Declares the settings: for each its documentation, its type, its default and, for a number, the range that it must be in. A
/// range can depend on other settings of `$config`.
macro_rules! settings {
    (of $config:ident; $($(#[$attribute:meta])* $name:ident: $type:ty = $default:expr $(, $range:expr)?;)*) => {
        /// All settings of the server, with their defaults.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
        #[serde(default)]
        pub struct ServerConfig {
            $($(#[$attribute])* pub $name: $type,)*
        }

        impl Default for ServerConfig {
            fn default() -> Self {
                Self { $($name: $default,)* }
            }
        }

        impl ServerConfig {
            /// Every number with the range it must be in.
            #[must_use]
            #[expect(clippy::cast_lossless, reason = "the types of the numbers differ")]
            pub fn bounds(&self) -> Vec<Bound> {
                let $config = self;
                vec![$($((stringify!($name), $config.$name as u64, $range),)?)*]
            }
        }
    };
}

settings! {
    of config;
    /// Where jobs write: in its folders `datasets`, `runs`, `reports` and `models`.
    #[schema(value_type = String)]
    data_dir: PathBuf = PathBuf::from("data");
    /// The directory of the models that were not published by a job of this server.
    #[schema(value_type = String)]
    models_dir: PathBuf = PathBuf::from("models");
    /// Where networks compute, in predictions and trainings: `cpu`, or `cuda` or `cuda:N` for an NVIDIA graphics card, which needs
    /// the Cargo feature `cuda`.
    #[schema(value_type = String)]
    device: DeviceName = DeviceName::Cpu;
    /// In which numbers the processor predicts: `f32`, or for faster and slightly less exact predictions `bf16` (needs a processor
    /// with AVX-512 BF16) or `int8` (AVX-512 VNNI, or 64-bit ARM with dot products; AVX2 for dense networks only).
    #[schema(value_type = String)]
    precision: Precision = Precision::F32;
    /// `sqlite:FILE` or `postgres://…`. Default: a file in the data directory.
    database_url: Option<String> = None;
    /// How long a starting server or worker waits for its PostgreSQL, in seconds.
    database_wait_s: u64 = 60, 0..=86_400;
    /// A directory or `s3://BUCKET/PREFIX` for the files that several machines share. Default: the data directory.
    objects_url: Option<String> = None;
    /// The directory with the recordings that import jobs may read. Default: none, so imports are off.
    #[schema(value_type = Option<String>)]
    import_dir: Option<PathBuf> = None;
    /// The certificate chain of the public address as a PEM file, for HTTPS; needs the Cargo feature `tls`. The file is read
    /// again when it changes.
    #[schema(value_type = Option<String>)]
    tls_certificate: Option<PathBuf> = None;
    /// The private key of that certificate as a PEM file.
    #[schema(value_type = Option<String>)]
    tls_key: Option<PathBuf> = None;
    /// Whether this server runs jobs. If false, it accepts jobs and leaves the work to workers.
    run_jobs: bool = true;
    /// Maximum size of a request body and of a message of a stream, in bytes.
    max_body_bytes: usize = 8 << 20, 1024..=1 << 30;
    /// Maximum size of the request body of a job, in bytes.
    max_job_bytes: usize = 64 << 10, 1024..=16 << 20;
    /// Maximum number of images in one request.
    max_frames: usize = 64, 1..=4096;
    /// Maximum number of predictions that wait; more are refused with 503.
    max_queued_predictions: usize = 256, 1..=MAX_COUNT;
    /// Maximum number of rollouts in a batch; one request gets at most a quarter of a batch, and
    /// less where its rollouts are longer than the horizon. On the CPU, flow and sprite
    /// networks gain nothing from batches: at most one rollout for each core, or one larger request, is computed at a time. Frames of
    /// streams wait for the batch before them.
    max_batch: usize = 64, 1..=MAX_BATCH;
    /// Maximum size of all request bodies and messages of streams that the server reads or works with at the same time, in
    /// bytes; more requests are refused with 503, more streams closed with 1013. At least `max_body_bytes`.
    max_total_body_bytes: usize = 256 << 20, config.max_body_bytes as u64..=1 << 40;
    /// Maximum number of connections. If all are open, a new one replaces the one that was idle the longest; see
    /// `connection_evict_ms`. If none is idle, it is refused with 503 and closed.
    max_connections: usize = 512, 1..=MAX_COUNT;
    /// Maximum number of connections from one IPv4 address or one /64 network of IPv6. Behind a reverse proxy, all come from
    /// the same address: set it to `max_connections`.
    max_connections_per_address: usize = 256, 1..=MAX_COUNT;
    /// How long a connection must have been idle, without a request that is being answered, to be replaced by a new one, in
    /// milliseconds.
    connection_evict_ms: u64 = 1_000, 0..=MAX_DEADLINE_MS;
    /// Maximum number of connections to `admin_bind`.
    max_admin_connections: usize = 32, 1..=MAX_COUNT;
    /// Maximum number of requests that are processed at the same time; more are refused with 503. Streams and event streams
    /// are not counted.
    max_requests: usize = 384, 1..=MAX_COUNT;
    /// Maximum number of streams; more are refused with 503.
    max_streams: usize = 128, 1..=MAX_COUNT;
    /// Maximum number of event streams, of jobs and of the server; more are refused with 503.
    max_event_streams: usize = 128, 1..=MAX_COUNT;
    /// Maximum number of simulated environments, and of world models as environments; see `environment_evict_ms`.
    max_environments: usize = 16, 1..=10_000;
    /// Maximum number of sessions; more are refused with 503.
    max_sessions: usize = 1024, 1..=MAX_COUNT;
    /// Maximum number of frames of a stream that are read before the earlier ones are answered; more are read later.
    max_pipelined_frames: usize = 16, 1..=4096;
    /// Maximum size of the messages that wait for a slow reader of a stream, in bytes. Beyond it, the oldest predictions
    /// are dropped.
    max_stream_buffer_bytes: usize = 4 << 20, 1024..=1 << 30;
    /// Maximum number of plans in one rollout request.
    max_plans: usize = 512, 1..=100_000;
    /// Maximum size of the predicted images of one rollout request, in bytes before encoding.
    max_rollout_bytes: usize = 64 << 20, 1024..=1 << 32;
    /// Maximum number of frames that a request can ask to predict, if that is more than the model's horizon.
    max_steps: usize = 50, 1..=MAX_STEPS as u64;
    /// Maximum number of jobs that wait; more are refused with 503.
    max_queued_jobs: usize = 16, 1..=10_000;
    /// Maximum number of ended jobs in the list; older ones are removed.
    max_ended_jobs: usize = 100, 1..=10_000;
    /// Maximum number of lines of a job's log; older ones are removed.
    max_job_log_lines: usize = 1000, 1..=100_000;
    /// Number of threads for jobs.
    job_threads: usize = spare_cores(), 1..=1024;
    /// Number of threads that decode and encode the images of predictions; more such work waits. A second pool of the
    /// same size simulates and reads files.
    request_threads: usize = 4, 1..=1024;
    /// Number of threads that make pictures of data sets, models and predictions, and read reports; more such work waits. On
    /// Linux, they run at lower priority.
    picture_threads: usize = 1, 1..=1024;
    /// Maximum size of the pictures and reports that are kept to answer the same request again, in bytes; 0 keeps none.
    max_cached_bytes: usize = 64 << 20, 0..=1 << 36;
    /// Memory that one job can use, in MiB; 0 for no limit. Needs Linux.
    job_memory_mib: u64 = memory::default_limit_mib(), 0..=1 << 30;
    /// Memory for the frames of one data set, in MiB, in commands and jobs; in a job, at most a third of `job_memory_mib`. The
    /// frames of a larger data set are decoded once into a file in its directory (`.cache`) and read from there.
    dataset_memory_mib: u64 = memory::default_dataset_mib(), 0..=1 << 30;
    /// After this many attempts in a row that ended abnormally without progress, a job fails.
    job_max_attempts: u32 = 3, 1..=1_000_000;
    /// How long one attempt of a job can run, in seconds; 0 for no limit.
    job_time_limit_s: u64 = 0, 0..=100_000_000;
    /// How long a running job may report no progress, in seconds; 0 for no limit. After this time its process is killed, and the
    /// next attempt resumes from the last checkpoint. An import reports no progress while it reads the recording: raise this limit
    /// for recordings that take longer.
    job_stall_limit_s: u64 = 7_200, 0..=100_000_000;
    /// Disk space for what is decompressed while it is imported, in MiB: the files of an archive, or the frames of a `.npz` file. An
    /// import that needs more is refused; 0 refuses all of them.
    import_disk_mib: u64 = DEFAULT_DISK_MIB, 0..=1 << 30;
    /// Maximum number of files in an archive that is imported.
    max_import_files: u64 = DEFAULT_MAX_FILES, 1..=1 << 40;
    /// The program whose `run-job` runs each job in a process of its own; without one, jobs run in this process.
    #[serde(skip)]
    job_program: Option<PathBuf> = None;
    /// The format of the log lines of that program: that of this process.
    #[serde(skip)]
    job_log_format: LogFormat = LogFormat::Text;
    /// How long a lease of a job lasts without renewal, in milliseconds. After that, another process can claim the job.
    job_lease_ms: u64 = 30_000, 1000..=MAX_DEADLINE_MS;
    /// How long a prediction may take, including its time in the queue, in milliseconds.
    prediction_deadline_ms: u64 = 10_000, 1..=MAX_DEADLINE_MS;
    /// How long a request may take to arrive and be answered, in milliseconds.
    request_deadline_ms: u64 = 30_000, 1..=MAX_DEADLINE_MS;
    /// Maximum size of a file that is uploaded for an import, in MiB; 0 refuses all uploads.
    max_upload_mib: u64 = 2048, 0..=1 << 24;
    /// Maximum number of uploads that are received or wait for the end of their import; more are refused with 503.
    max_uploads: usize = 16, 1..=10_000;
    /// Maximum number of these uploads from one API key; more are refused with 429. Uploads from before the last start do not count.
    max_uploads_per_key: usize = 8, 1..=10_000;
    /// How long an upload may take, in milliseconds.
    upload_deadline_ms: u64 = 3_600_000, 1..=MAX_DEADLINE_MS;
    /// How long an uploaded file is kept that no import uses, in milliseconds.
    upload_idle_ms: u64 = 3_600_000, 1..=MAX_DEADLINE_MS;
    /// How long an environment is kept that nobody steps, in milliseconds.
    environment_idle_ms: u64 = 600_000, 1..=MAX_DEADLINE_MS;
    /// At the limit of environments, a new one replaces the one that was idle the longest, if that was idle for at least
    /// this time, in milliseconds.
    environment_evict_ms: u64 = 5_000, 0..=MAX_DEADLINE_MS;
    /// How long a stream may be idle, in milliseconds.
    stream_idle_ms: u64 = 60_000, 1..=MAX_DEADLINE_MS;
    /// How long a client may take to read a message of its stream, in milliseconds.
    stream_send_ms: u64 = 10_000, 1..=MAX_DEADLINE_MS;
    /// Maximum size of a request's head, in bytes; a longer one is refused with 431.
    max_header_bytes: usize = 32 << 10, 8192..=1 << 20;
    /// How long a request's head may take to arrive, counted from the start of the connection or from the previous
    /// response, in milliseconds. So this is also how long a connection may be idle. A TLS handshake may take as long.
    header_read_ms: u64 = 30_000, 1..=MAX_DEADLINE_MS;
    /// How long a client may read nothing while a response is written to it, in milliseconds.
    write_stall_ms: u64 = 30_000, 1..=MAX_DEADLINE_MS;
    /// How long the server drains: it accepts requests while `/readyz` answers 503, in milliseconds.
    drain_ms: u64 = 0, 0..=config.shutdown_deadline_ms;
    /// How long a session is kept without an open stream and without use, in milliseconds.
    session_grace_ms: u64 = 60_000, 1..=MAX_DEADLINE_MS;
    /// How long stopping may take, including draining, in milliseconds.
    shutdown_deadline_ms: u64 = 10_000, 1..=MAX_DEADLINE_MS;
    /// How often the API keys are read, in milliseconds. A revoked key may be valid for that long.
    key_refresh_ms: u64 = 5_000, 100..=MAX_DEADLINE_MS;
    /// Origins of other web pages that may call this server, for example `https://robots.example`. If authentication is
    /// off, their hosts are also the only names with a dot that the server answers to.
    cors_origins: Vec<String> = Vec::new();
}

/// All cores but one, which is left for predictions; at least one.
fn spare_cores() -> usize {
    std::thread::available_parallelism().map_or(1, |cores| (cores.get() - 1).max(1))
}

impl ServerConfig {
    /// Errors: a setting is out of its range.
    pub fn validate(&self) -> Result<(), SettingError> {
        let mut bounds = self.bounds().into_iter();
        match bounds.find(|(_, value, range)| !range.contains(value)) {
            None => Ok(()),
            Some((field, value, range)) => Err(SettingError { field, value, range }),
        }
    }

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
            log_format: self.job_log_format.name().to_owned(),
        })
    }

    /// What one job can use.
    #[must_use]
    pub fn job_resources(&self) -> JobResources {
        JobResources {
            device: self.device,
            precision: self.precision,
            threads: self.job_threads,
            memory: JobMemory {
                limit_mib: self.job_memory_mib,
                dataset_mib: self.dataset_memory_mib,
            },
            import_dir: self.import_dir.clone(),
            import_disk_mib: self.import_disk_mib,
            max_import_files: self.max_import_files,
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
        let fields: [(&str, Field); 7] = [
            ("max_sessions", |config| config.max_sessions = 0),
            ("max_pipelined_frames", |config| config.max_pipelined_frames = 0),
            ("max_stream_buffer_bytes", |config| config.max_stream_buffer_bytes = 0),
            ("max_plans", |config| config.max_plans = 0),
            ("max_steps", |config| config.max_steps = 0),
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
    fn bounds_of_jobs_and_threads_are_checked() {
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
