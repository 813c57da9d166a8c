//! The metrics recorder and its text output for Prometheus. There is one per process, because the `metrics` crate has one.

use std::fs;
use std::sync::OnceLock;
use std::time::SystemTime;

use metrics::gauge;
use metrics_exporter_prometheus::{BuildError, Matcher, PrometheusBuilder, PrometheusHandle};
use tracing::error;

use crate::program::GIT_COMMIT;
use foreframe_core::metric_names;

/// Histogram buckets in seconds: from half a millisecond (a small model) to the longest sensible deadline.
const SECONDS: [f64; 16] = [
    0.0005, 0.001, 0.0025, 0.005, 0.01, 0.02, 0.033, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0,
];
const BATCH_SIZES: [f64; 10] = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 1024.0];

static HANDLE: OnceLock<Option<PrometheusHandle>> = OnceLock::new();

/// Starts recording. Values recorded earlier are lost. A second call changes nothing.
pub fn install_recorder() {
    HANDLE.get_or_init(|| {
        let failed =
            |error: &BuildError| error!(%error, "could not install the metrics recorder; no metrics are recorded");
        install().inspect_err(failed).ok()
    });
}

fn install() -> Result<PrometheusHandle, BuildError> {
    let handle = PrometheusBuilder::new()
        .set_buckets_for_metric(Matcher::Suffix("_seconds".to_owned()), &SECONDS)?
        .set_buckets_for_metric(
            Matcher::Full(metric_names::PREDICTION_BATCH_SIZE.to_owned()),
            &BATCH_SIZES,
        )?
        .install_recorder()?;
    metric_names::describe();
    metric_names::initialize_counters();
    let commit = GIT_COMMIT;
    gauge!(metric_names::BUILD_INFO, "version" => env!("CARGO_PKG_VERSION"), "commit" => commit).set(1.0);
    let started = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    gauge!(metric_names::PROCESS_START_SECONDS).set(started.unwrap_or_default().as_secs_f64());
    Ok(handle)
}

/// All metrics in the Prometheus text format; empty before [`install_recorder`].
#[must_use]
pub fn render() -> String {
    let Some(Some(handle)) = HANDLE.get() else {
        return String::new();
    };
    measure_process();
    handle.run_upkeep();
    handle.render()
}

/// Moves the samples of histograms into their buckets. Call it regularly, so that their memory stays bounded even if
/// nobody reads the metrics.
pub fn run_upkeep() {
    if let Some(Some(handle)) = HANDLE.get() {
        handle.run_upkeep();
    }
}

/// Measures memory, threads and open files of this process. Without `/proc` it measures nothing.
fn measure_process() {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let field = |name: &str| -> Option<f64> {
        let line = status.lines().find_map(|line| line.strip_prefix(name))?;
        line.split_whitespace().next()?.parse().ok()
    };
    if let Some(kib) = field("VmRSS:") {
        gauge!(metric_names::PROCESS_RESIDENT_BYTES).set(kib * 1024.0);
    }
    if let Some(threads) = field("Threads:") {
        gauge!(metric_names::PROCESS_THREADS).set(threads);
    }
    if let Ok(open) = fs::read_dir("/proc/self/fd") {
        // Listing the directory opens one file.
        gauge!(metric_names::PROCESS_OPEN_FDS).set(open.count().saturating_sub(1) as f64);
    }
}
