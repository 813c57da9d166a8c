//! Changes on the server as server-sent events, so that a page need not ask again and again.

use std::collections::hash_map::DefaultHasher;
use std::convert::Infallible;
use std::hash::{Hash as _, Hasher as _};
use std::sync::atomic::Ordering;
use std::time::Duration;

use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::{Stream, stream};
use tokio::sync::{OwnedSemaphorePermit, watch};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::server::http::keys::Caller;
use crate::server::http::problem::ApiError;
use crate::server::http::task_limit::stop_requested;
use crate::server::state::App;
use foreframe_jobs::jobs::JobFilter;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(events))
}

/// How often the lists are read and compared.
const COMPARE_EVERY: Duration = Duration::from_millis(500);
/// Jobs that are compared, the newest.
const COMPARED_JOBS: usize = 100;

/// A server-sent event.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "only described; axum writes the events")]
struct ServerEvent {
    /// `models`, `jobs` or `stopping`.
    event: String,
    /// Always `{}`.
    data: String,
}

/// Sends an event when the list of models, their versions, the active ones or their scores changed (`event: models`), when the state of a
/// job changed or a new one came, or a data set was deleted by this server (`event: jobs`), and when the server stops (`event:
/// stopping`). Both lists are announced once at the beginning. The events do not hold the change: read the list. The stream also ends if the API key is revoked.
#[utoipa::path(
    get, path = "/v1/events",
    responses(
        (status = 200, description = "Events", content_type = "text/event-stream", body = ServerEvent),
        (status = 503, description = "Too many event streams are open"),
    )
)]
async fn events(app: App, caller: Caller) -> Result<Sse<impl Stream<Item = Result<Event, Infallible>>>, ApiError> {
    let watch = Some(ServerEventStream {
        _place: app.event_streams.enter()?,
        stopping: app.event_streams.stopping(),
        app,
        caller,
        sent: [None; 2],
    });
    let events = stream::unfold(watch, async |watch| {
        let mut watch = watch?;
        let name = watch.next().await?;
        let rest = (name != STOPPING).then_some(watch);
        Some((Ok(Event::default().event(name).data("{}")), rest))
    });
    Ok(Sse::new(events).keep_alive(KeepAlive::default()))
}

/// The last event.
const STOPPING: &str = "stopping";

/// The events for one client.
struct ServerEventStream {
    app: App,
    caller: Caller,
    /// Hashes of the lists as last announced: models, jobs.
    sent: [Option<u64>; 2],
    stopping: watch::Receiver<bool>,
    _place: OwnedSemaphorePermit,
}

impl ServerEventStream {
    /// The name of the next event; none if the key was revoked or the store failed: the client may connect again.
    async fn next(&mut self) -> Option<&'static str> {
        loop {
            let lists = &self.app.compared_lists;
            let now = lists.not_older(COMPARE_EVERY, hashes(&self.app)).await?;
            for (place, name) in ["models", "jobs"].into_iter().enumerate() {
                if self.sent[place] != Some(now[place]) {
                    self.sent[place] = Some(now[place]);
                    return Some(name);
                }
            }
            tokio::select! {
                () = tokio::time::sleep(COMPARE_EVERY) => {}
                () = stop_requested(&mut self.stopping) => return Some(STOPPING),
                () = self.app.keys.revoked(self.caller) => return None,
            }
        }
    }
}

/// Hashes of the lists, models and jobs; none if the store fails.
async fn hashes(app: &App) -> Option<[u64; 2]> {
    Some([models(app).await?, jobs(app).await?])
}

/// A hash of the active versions, of the published ones and of what evaluations measured.
async fn models(app: &App) -> Option<u64> {
    let store = app.store();
    let mut hasher = DefaultHasher::new();
    for manifest in app.predictor().models() {
        (manifest.name.as_str(), manifest.version).hash(&mut hasher);
    }
    store.published_versions().await.ok()?.hash(&mut hasher);
    for measured in store.model_metrics().await.ok()? {
        (measured.model.as_str(), measured.version, measured.metrics).hash(&mut hasher);
    }
    Some(hasher.finish())
}

async fn jobs(app: &App) -> Option<u64> {
    let filter = JobFilter {
        limit: COMPARED_JOBS,
        ..JobFilter::default()
    };
    let mut hasher = DefaultHasher::new();
    app.deleted_datasets.load(Ordering::Relaxed).hash(&mut hasher);
    for job in app.jobs().list(filter).await.ok()? {
        (job.id.to_string(), job.state.name(), job.cancelling).hash(&mut hasher);
    }
    Some(hasher.finish())
}
