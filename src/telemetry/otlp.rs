//! Sends traces to an OpenTelemetry collector: every log span becomes a trace span.

use opentelemetry::trace::TracerProvider as _;
use opentelemetry_otlp::{SpanExporter, WithExportConfig as _};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{SdkTracerProvider, Tracer};
use tracing::Subscriber;
use tracing_opentelemetry::OpenTelemetryLayer;
use tracing_subscriber::registry::LookupSpan;

use super::TelemetryError;

/// The exporter and its thread. Dropping it sends the spans that are still in memory.
pub(super) struct Traces {
    provider: SdkTracerProvider,
}

impl Traces {
    /// Sends over HTTP to `endpoint`/v1/traces. Errors: `Otlp`.
    pub(super) fn new(endpoint: &str) -> Result<Self, TelemetryError> {
        let exporter = SpanExporter::builder()
            .with_http()
            .with_endpoint(format!("{}/v1/traces", endpoint.trim_end_matches('/')))
            .build()
            .map_err(|error| TelemetryError::Otlp(error.to_string()))?;
        let resource = Resource::builder().with_service_name("foreframe").build();
        let provider = SdkTracerProvider::builder()
            .with_batch_exporter(exporter)
            .with_resource(resource)
            .build();
        Ok(Self { provider })
    }

    pub(super) fn layer<S: Subscriber + for<'a> LookupSpan<'a>>(&self) -> OpenTelemetryLayer<S, Tracer> {
        tracing_opentelemetry::layer().with_tracer(self.provider.tracer("foreframe"))
    }
}

impl Drop for Traces {
    fn drop(&mut self) {
        // Ignore errors: the program is ending and nobody can handle them.
        let _ = self.provider.shutdown();
    }
}
