//! Traces to an OpenTelemetry collector: every span of the log becomes one of a trace.

use opentelemetry::trace::TracerProvider as _;
use opentelemetry_otlp::{SpanExporter, WithExportConfig as _};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{SdkTracerProvider, Tracer};
use tracing::Subscriber;
use tracing_opentelemetry::OpenTelemetryLayer;
use tracing_subscriber::registry::LookupSpan;

use super::TelemetryError;

/// The exporter and its thread; dropping it sends what waits.
pub(super) struct Traces {
    provider: SdkTracerProvider,
}

impl Traces {
    /// Sends to `endpoint`/v1/traces by HTTP. Errors: `Otlp`.
    pub(super) fn to(endpoint: &str) -> Result<Self, TelemetryError> {
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
        // What cannot be sent at the end is lost; nobody is left to be told.
        let _ = self.provider.shutdown();
    }
}
