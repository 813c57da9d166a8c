//! What the service measures, for Prometheus.

use std::convert::Infallible;
use std::time::Duration;

use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use metrics::gauge;
use tracing::warn;

use super::App;
use crate::jobs::JobState;
use crate::telemetry::{self, names};

const TEXT_FORMAT: &str = "text/plain; version=0.0.4; charset=utf-8";
/// How often histograms are folded into their buckets.
const FOLD_INTERVAL: Duration = Duration::from_secs(5);

/// All metrics in Prometheus' text format.
#[utoipa::path(
    get, path = "/metrics", tag = "health",
    responses((status = 200, description = "Prometheus' text format", content_type = "text/plain"))
)]
pub(super) async fn metrics(State(app): State<App>) -> impl IntoResponse {
    gauge!(names::STREAMS).set(app.streams().count() as f64);
    gauge!(names::MODELS_LOADED).set(app.predictor().models().len() as f64);
    match app.store().jobs_by_state().await {
        Ok(counts) => {
            for state in JobState::ALL.map(JobState::name) {
                let count = counts
                    .iter()
                    .find(|(name, _)| name == state)
                    .map_or(0, |(_, count)| *count);
                gauge!(names::JOBS, "state" => state).set(count as f64);
            }
        }
        // The rest is worth reading all the same.
        Err(error) => warn!(%error, "could not count the jobs"),
    }
    ([(header::CONTENT_TYPE, TEXT_FORMAT)], telemetry::render())
}

/// Bounds the memory of histograms that nobody reads.
pub(super) async fn keep_folded() -> Infallible {
    let mut ticks = tokio::time::interval(FOLD_INTERVAL);
    loop {
        ticks.tick().await;
        telemetry::fold();
    }
}
