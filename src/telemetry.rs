//! What the program says of itself: logs to standard error, `info` and above unless `RUST_LOG` says otherwise; metrics by
//! [`names`], recorded from [`record`] on and given to Prometheus by [`render`]; with the feature `otlp`, traces.

pub mod names;

#[cfg(feature = "otlp")]
mod otlp;
#[cfg(feature = "server")]
mod prometheus;

use serde::{Deserialize, Serialize};
#[cfg(feature = "server")]
pub use prometheus::{fold, record, render};

/// How log lines look.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

/// Why traces cannot be sent.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TelemetryError {
    /// The program cannot send traces.
    #[error("otlp_endpoint is set, and this program was built without the feature otlp; build it with --features otlp")]
    NoOtlp,
    /// The exporter could not be made.
    #[error("otlp_endpoint: {0}")]
    Otlp(String),
}

/// Sends the traces that wait when it is dropped.
#[must_use]
pub struct Telemetry {
    #[cfg(feature = "otlp")]
    _traces: Option<otlp::Traces>,
}

/// Installs the subscriber for the process; a second call changes nothing. Spans go to `otlp_endpoint`, for example
/// `http://127.0.0.1:4318`, if one is given. Errors: `NoOtlp`, `Otlp`.
#[cfg(feature = "server")]
pub fn init(format: LogFormat, otlp_endpoint: Option<&str>) -> Result<Telemetry, TelemetryError> {
    use std::io::IsTerminal as _;

    use tracing_subscriber::layer::SubscriberExt as _;
    use tracing_subscriber::util::SubscriberInitExt as _;
    use tracing_subscriber::{EnvFilter, Layer as _, fmt};

    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    // Colours are for people, not for files.
    let lines = fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal());
    let lines = match format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().flatten_event(true).boxed(),
    };
    let registry = tracing_subscriber::registry().with(lines).with(filter);
    #[cfg(feature = "otlp")]
    {
        let traces = otlp_endpoint.map(otlp::Traces::to).transpose()?;
        // Only fails if one is installed already, as in tests.
        let _ = registry.with(traces.as_ref().map(otlp::Traces::layer)).try_init();
        Ok(Telemetry { _traces: traces })
    }
    #[cfg(not(feature = "otlp"))]
    {
        if otlp_endpoint.is_some() {
            return Err(TelemetryError::NoOtlp);
        }
        let _ = registry.try_init();
        Ok(Telemetry {})
    }
}
