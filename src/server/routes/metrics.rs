//! The metrics of the service, for Prometheus.

use std::convert::Infallible;
use std::time::{Duration, Instant};

use axum::http::header;
use axum::response::IntoResponse;
use metrics::gauge;
use tokio::time::timeout;
use tracing::warn;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::server::state::App;
use foreframe_core::metric_names;
use foreframe_jobs::jobs::{JobSpec, JobState};
use foreframe_jobs::store::{JobCount, Store};

use crate::telemetry;

pub(in crate::server) const TEXT_FORMAT: &str = "text/plain; version=0.0.4; charset=utf-8";
/// How often the samples of histograms are sorted into their buckets.
const FOLD_INTERVAL: Duration = Duration::from_secs(5);
/// How long the store may take to count the jobs: who reads metrics waits only for some seconds.
const COUNT_LIMIT: Duration = Duration::from_secs(1);
/// How long the check may take whether it can be written: longer than it takes itself, so that it is not broken off.
const WRITE_LIMIT: Duration = Duration::from_secs(3);

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(metrics))
}

/// All metrics in Prometheus' text format.
#[utoipa::path(
    get, path = "/metrics", tag = "health",
    responses((status = 200, description = "Prometheus' text format", content_type = "text/plain"))
)]
async fn metrics(app: App) -> impl IntoResponse {
    gauge!(metric_names::STREAMS).set(app.streams.count() as f64);
    gauge!(metric_names::SESSIONS).set(app.sessions.count(Instant::now()) as f64);
    gauge!(metric_names::MODELS_LOADED).set(app.predictor().models().len() as f64);
    ([(header::CONTENT_TYPE, TEXT_FORMAT)], text(app.store()).await)
}

/// All metrics as text, with the jobs of this store, and whether it can be written; if it does not answer soon, with the jobs that were
/// counted last. The other metrics are still useful then.
pub(in crate::server) async fn text(store: &Store) -> String {
    let (counted, checked) = tokio::join!(
        timeout(COUNT_LIMIT, store.count_jobs()),
        timeout(WRITE_LIMIT, store.check_writable())
    );
    match counted {
        Ok(Ok(counts)) => measure_jobs(&counts),
        Ok(Err(error)) => warn!(%error, "could not count the jobs"),
        Err(_) => warn!("could not count the jobs: the store does not answer"),
    }
    let is_writable = matches!(checked, Ok(Ok(())));
    if !is_writable {
        let reason = match checked {
            Ok(checked) => checked.err().map(|error| error.to_string()),
            Err(_) => Some("it does not answer".to_owned()),
        };
        warn!(reason, "the store cannot be written");
    }
    gauge!(metric_names::STORE_WRITABLE).set(f64::from(u8::from(is_writable)));
    telemetry::render()
}

/// A state without jobs gets 0, so that a job that has left it is no longer counted there.
fn measure_jobs(counts: &[JobCount]) {
    for kind in JobSpec::KINDS {
        for state in JobState::ALL.map(JobState::name) {
            let found = counts.iter().find(|count| count.kind == kind && count.state == state);
            gauge!(metric_names::JOBS, "kind" => kind, "state" => state)
                .set(found.map_or(0, |count| count.jobs) as f64);
        }
    }
}

/// Bounds the memory of histograms if nobody reads the metrics.
pub(in crate::server) async fn keep_folded() -> Infallible {
    let mut ticks = tokio::time::interval(FOLD_INTERVAL);
    loop {
        ticks.tick().await;
        telemetry::run_upkeep();
    }
}
