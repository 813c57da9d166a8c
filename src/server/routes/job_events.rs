//! The progress of a job as server-sent events. They come from the store, so any process may work on the job.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::time::Duration;

use axum::http::HeaderMap;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::{Stream, stream};
use tokio::sync::{OwnedSemaphorePermit, watch};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::jobs::job_id;
use crate::server::http::extract::Path;
use crate::server::http::keys::Caller;
use crate::server::http::problem::ApiError;
use crate::server::http::task_limit::stop_requested;
use crate::server::state::App;
use foreframe_jobs::jobs::{Job, JobError};
use foreframe_jobs::store::JobId;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(events))
}

/// How often the store is queried.
const POLL_EVERY: Duration = Duration::from_millis(500);
/// The maximum number of log lines that are read at once.
const LINES: usize = 100;

/// A server-sent event.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "only described; axum writes the events")]
struct JobEvent {
    /// `job` or `log`.
    event: String,
    /// A line of a log: its number.
    id: Option<String>,
    /// JSON: the job, or the line.
    data: String,
}

/// Sends the job whenever it changes (`event: job`) and each line of its log (`event: log`), until it has ended, the
/// server stops, or the API key is revoked. With `Last-Event-ID`, the log continues after that line.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/events",
    params(
        ("id" = String, Path),
        ("Last-Event-ID" = Option<String>, Header, description = "The number of the last line of the log that was received"),
    ),
    responses(
        (status = 200, description = "Events", content_type = "text/event-stream", body = JobEvent),
        (status = 503, description = "Too many event streams are open"),
    )
)]
async fn events(
    app: App,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<Event, Infallible>>>, ApiError> {
    let id = job_id(&id)?;
    app.jobs().get(id).await?;
    let last_seen = headers
        .get("last-event-id")
        .and_then(|seen| seen.to_str().ok()?.parse().ok());
    let watch = JobEventStream {
        _place: app.event_streams.enter()?,
        stopping: app.event_streams.stopping(),
        app,
        caller,
        id,
        job: None,
        after: last_seen.unwrap_or(0),
        waiting: VecDeque::new(),
        is_over: false,
    };
    let events = stream::unfold(watch, async |mut watch| {
        let event = watch.next().await?;
        Some((Ok(event), watch))
    });
    Ok(Sse::new(events).keep_alive(KeepAlive::default()))
}

/// The events for one client.
struct JobEventStream {
    app: App,
    caller: Caller,
    id: JobId,
    /// The job as last sent.
    job: Option<Job>,
    /// The number of the last line sent.
    after: i64,
    waiting: VecDeque<Event>,
    is_over: bool,
    stopping: watch::Receiver<bool>,
    _place: OwnedSemaphorePermit,
}

impl JobEventStream {
    async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.waiting.pop_front() {
                return Some(event);
            }
            if self.is_over {
                return None;
            }
            // An error means that the job was removed or the store failed: the client may connect again.
            self.poll().await.ok()?;
            if self.waiting.is_empty() {
                tokio::select! {
                    () = tokio::time::sleep(POLL_EVERY) => {}
                    () = stop_requested(&mut self.stopping) => return None,
                    () = self.app.keys.revoked(self.caller) => return None,
                }
            }
        }
    }

    async fn poll(&mut self) -> Result<(), JobError> {
        let job = self.app.jobs().get(self.id).await?;
        let lines = self.app.jobs().log(self.id, self.after, LINES).await?;
        self.is_over = job.state.is_final() && lines.len() < LINES;
        for line in lines {
            self.after = line.seq;
            self.push("log", Some(line.seq), &line);
        }
        if self.job.as_ref() != Some(&job) {
            self.push("job", None, &job);
            self.job = Some(job);
        }
        Ok(())
    }

    fn push(&mut self, name: &str, id: Option<i64>, data: &impl serde::Serialize) {
        let event = Event::default().event(name).json_data(data);
        let event = event.expect("a job or a log line that is not JSON is a bug");
        self.waiting.push_back(match id {
            Some(id) => event.id(id.to_string()),
            None => event,
        });
    }
}
