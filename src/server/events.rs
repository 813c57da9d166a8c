//! A job as it goes, as server-sent events. The store is asked, so that it does not matter which process works on it.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::time::Duration;

use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::{Stream, stream};
use tokio::sync::{OwnedSemaphorePermit, watch};

use super::App;
use super::error::{ApiError, Problem};
use super::extract::Path;
use super::jobs::LogLine;
use super::streams::told;
use crate::jobs::{Job, JobError};

/// How often the store is asked.
const POLL_EVERY: Duration = Duration::from_millis(500);
/// Lines of the log that are sent together at most.
const LINES: usize = 100;

/// The job whenever it changed (`event: job`) and each line of its log (`event: log`), until it has ended or the server
/// stops. With `Last-Event-ID`, the log goes on after that line.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/events", tag = "jobs",
    params(
        ("id" = String, Path, description = "The job's id"),
        ("Last-Event-ID" = Option<i64>, Header, description = "The last line of the log that was seen"),
    ),
    responses(
        (status = 200, description = "Events", content_type = "text/event-stream", body = String),
        (status = 404, description = "No such job", body = Problem),
        (status = 503, description = "Too many streams are open", body = Problem),
    )
)]
pub(super) async fn events(
    State(app): State<App>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<Event, Infallible>>>, ApiError> {
    app.jobs().get(&id).await?;
    let last_seen = headers
        .get("last-event-id")
        .and_then(|seen| seen.to_str().ok()?.parse().ok());
    let watch = JobEventStream {
        _place: app.streams().enter()?,
        stopping: app.streams().stopping(),
        app,
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

/// One client that watches a job.
struct JobEventStream {
    app: App,
    id: String,
    /// As last sent.
    job: Option<Job>,
    /// The last line sent.
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
            // A job that cannot be told of any more was forgotten, or the store is gone: the client may ask again.
            self.look().await.ok()?;
            if self.waiting.is_empty() {
                tokio::select! {
                    () = tokio::time::sleep(POLL_EVERY) => {}
                    () = told(&mut self.stopping) => return None,
                }
            }
        }
    }

    async fn look(&mut self) -> Result<(), JobError> {
        let job = self.app.jobs().get(&self.id).await?;
        let lines = self.app.jobs().log(&self.id, self.after, LINES).await?;
        self.is_over = job.state.is_final() && lines.len() < LINES;
        for line in lines.into_iter().map(LogLine::from) {
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
        // These are plain structs: they are always writable.
        let Ok(event) = Event::default().event(name).json_data(data) else {
            return;
        };
        self.waiting.push_back(match id {
            Some(id) => event.id(id.to_string()),
            None => event,
        });
    }
}
