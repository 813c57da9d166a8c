//! Logs, metrics and traces. Logs go to standard error, at level `info` and above unless `RUST_LOG` sets another level.
//! Metrics have the names of [`metric_names`](foreframe_core::metric_names); [`install_recorder`] starts to record them and [`render`] writes them for
//! Prometheus. With the feature `otlp`, spans are sent as traces.

#[cfg(feature = "otlp")]
mod otlp;
mod prometheus;

use serde::{Deserialize, Serialize};

use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::named_enum;

pub use prometheus::{install_recorder, render, run_upkeep};

named_enum! {
    /// Format of log lines.
    #[derive(Default, Serialize, Deserialize)]
    #[serde(rename_all = "lowercase")]
    pub enum LogFormat {
        /// Text for people.
        #[default]
        Text = "text",
        /// One JSON object per line.
        Json = "json",
    }
}

/// Why traces cannot be sent.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TelemetryError {
    /// The program was built without the feature `otlp`.
    #[error("otlp_endpoint is set, but this program was built without the feature otlp; build it with --features otlp")]
    NoOtlp,
    /// The exporter could not be created.
    #[error("could not create the exporter for otlp_endpoint: {0}")]
    Otlp(String),
}

impl HasErrorKind for TelemetryError {
    fn kind(&self) -> ErrorKind {
        ErrorKind::Usage
    }
}

/// When it is dropped, it sends the traces that are still in memory.
#[must_use]
pub struct Telemetry {
    #[cfg(feature = "otlp")]
    _traces: Option<otlp::Traces>,
}

/// Installs the log subscriber of the process; a second call changes nothing. If `otlp_endpoint` is given, for example
/// `http://127.0.0.1:4318`, spans are sent there. Errors: `NoOtlp`, `Otlp`.
pub fn init(format: LogFormat, otlp_endpoint: Option<&str>) -> Result<Telemetry, TelemetryError> {
    use std::io::IsTerminal as _;

    use tracing_subscriber::layer::SubscriberExt as _;
    use tracing_subscriber::util::SubscriberInitExt as _;
    use tracing_subscriber::{EnvFilter, Layer as _, fmt};

    // Without what PostgreSQL says of tables that are there already.
    let filter =
        EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info,sqlx::postgres::notice=warn"));
    // Use colours only in a terminal, not in files.
    let lines = fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal());
    let lines = match format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().flatten_event(true).boxed(),
    };
    let registry = tracing_subscriber::registry().with(lines).with(filter);
    #[cfg(feature = "otlp")]
    let traces = otlp_endpoint.map(otlp::Traces::new).transpose()?;
    #[cfg(feature = "otlp")]
    let registry = registry.with(traces.as_ref().map(otlp::Traces::layer));
    #[cfg(not(feature = "otlp"))]
    if otlp_endpoint.is_some() {
        return Err(TelemetryError::NoOtlp);
    }
    // This fails only if a subscriber is already installed, as in tests.
    let _ = registry.try_init();
    Ok(Telemetry {
        #[cfg(feature = "otlp")]
        _traces: traces,
    })
}
