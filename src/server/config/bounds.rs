//! The range of every setting that is a number.

use std::ops::RangeInclusive;

use super::ServerConfig;
use foreframe_core::nn::spec::MAX_STEPS;

/// A setting out of range.
#[derive(Debug, thiserror::Error)]
#[error("{field} is {value}; it must be {least} to {most}")]
pub struct SettingError {
    /// The setting.
    pub field: &'static str,
    /// Its value.
    pub value: u64,
    /// The least it may be.
    pub least: u64,
    /// The most it may be.
    pub most: u64,
}

/// A field with its value and the range it must be in.
type Bound = (&'static str, u64, RangeInclusive<u64>);

/// A day: no deadline is longer.
const MAX_DEADLINE_MS: u64 = 86_400_000;

impl ServerConfig {
    /// Errors: a setting is out of its range.
    pub fn validate(&self) -> Result<(), SettingError> {
        self.out_of_bounds().map_or(Ok(()), |(field, value, range)| {
            Err(SettingError {
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
        let queued = self.max_queued_predictions as u64;
        vec![
            ("database_wait_s", self.database_wait_s, 0..=86_400),
            ("max_body_bytes", self.max_body_bytes as u64, 1024..=1 << 30),
            ("max_job_bytes", self.max_job_bytes as u64, 1024..=16 << 20),
            ("max_frames", self.max_frames as u64, 1..=4096),
            ("max_queued_predictions", queued, count.clone()),
            ("max_batch", self.max_batch as u64, 1..=4096),
            (
                "max_total_body_bytes",
                self.max_total_body_bytes as u64,
                self.max_body_bytes as u64..=1 << 40,
            ),
            ("max_connections", self.max_connections as u64, count.clone()),
            (
                "max_connections_per_address",
                self.max_connections_per_address as u64,
                count.clone(),
            ),
            ("connection_evict_ms", self.connection_evict_ms, 0..=MAX_DEADLINE_MS),
            (
                "max_admin_connections",
                self.max_admin_connections as u64,
                count.clone(),
            ),
            ("max_requests", self.max_requests as u64, count.clone()),
            ("max_streams", self.max_streams as u64, count.clone()),
            ("max_event_streams", self.max_event_streams as u64, count.clone()),
            ("max_sessions", self.max_sessions as u64, count),
            ("max_environments", self.max_environments as u64, 1..=10_000),
            ("max_pipelined_frames", self.max_pipelined_frames as u64, 1..=4096),
            (
                "max_stream_buffer_bytes",
                self.max_stream_buffer_bytes as u64,
                1024..=1 << 30,
            ),
            ("max_plans", self.max_plans as u64, 1..=100_000),
            ("max_steps", self.max_steps as u64, 1..=MAX_STEPS as u64),
            ("max_rollout_bytes", self.max_rollout_bytes as u64, 1024..=1 << 32),
            ("max_queued_jobs", self.max_queued_jobs as u64, 1..=10_000),
            ("max_ended_jobs", self.max_ended_jobs as u64, 1..=10_000),
            ("max_job_log_lines", self.max_job_log_lines as u64, 1..=100_000),
            ("job_threads", self.job_threads as u64, 1..=1024),
            ("request_threads", self.request_threads as u64, 1..=1024),
            ("picture_threads", self.picture_threads as u64, 1..=1024),
            ("max_cached_bytes", self.max_cached_bytes as u64, 0..=1 << 36),
            ("job_memory_mib", self.job_memory_mib, 0..=1 << 30),
            ("dataset_memory_mib", self.dataset_memory_mib, 0..=1 << 30),
            ("job_max_attempts", u64::from(self.job_max_attempts), 1..=1_000_000),
            ("job_time_limit_s", self.job_time_limit_s, 0..=100_000_000),
            ("job_stall_limit_s", self.job_stall_limit_s, 0..=100_000_000),
            ("import_disk_mib", self.import_disk_mib, 0..=1 << 30),
            ("job_lease_ms", self.job_lease_ms, 1000..=MAX_DEADLINE_MS),
            ("max_header_bytes", self.max_header_bytes as u64, 8192..=1 << 20),
            ("prediction_deadline_ms", self.prediction_deadline_ms, deadline.clone()),
            ("request_deadline_ms", self.request_deadline_ms, deadline.clone()),
            ("environment_idle_ms", self.environment_idle_ms, deadline.clone()),
            ("environment_evict_ms", self.environment_evict_ms, 0..=MAX_DEADLINE_MS),
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
