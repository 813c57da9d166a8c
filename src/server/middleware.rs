//! What every request goes through: an id, a span in the log, and a deadline.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime};

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tracing::{Instrument, debug, info_span};

use super::App;
use super::error::{self, ApiError};

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
/// Characters of a client's own id at most; longer ones are replaced.
const MAX_ID_LEN: usize = 64;

/// Gives ids to requests that bring none: when the server started, and a count.
pub(super) struct RequestIds {
    started: u64,
    next: AtomicU64,
}

impl RequestIds {
    pub(super) fn new() -> Self {
        let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        Self {
            started: since_1970.unwrap_or_default().as_secs(),
            next: AtomicU64::new(1),
        }
    }

    /// The client's own id where it is a decent one, else a new one.
    fn of(&self, headers: &HeaderMap) -> String {
        let allowed = |c: u8| c.is_ascii_alphanumeric() || matches!(c, b'-' | b'_' | b'.' | b':');
        let given = headers.get(REQUEST_ID).and_then(|id| id.to_str().ok());
        match given.filter(|id| (1..=MAX_ID_LEN).contains(&id.len()) && id.bytes().all(allowed)) {
            Some(id) => id.to_owned(),
            None => format!("{:x}-{}", self.started, self.next.fetch_add(1, Ordering::Relaxed)),
        }
    }
}

/// Runs the request in a span with its id, within the deadline, and finishes the body of an error.
pub(super) async fn trace(State(app): State<App>, request: Request, next: Next) -> Response {
    let id = app.request_ids().of(request.headers());
    let span = info_span!("request", id = %id, method = %request.method(), path = request.uri().path());
    let limit_ms = app.config().request_deadline_ms;
    let work = async move {
        let started = Instant::now();
        let response = tokio::time::timeout(Duration::from_millis(limit_ms), next.run(request)).await;
        let response = response.unwrap_or_else(|_| {
            ApiError::Timeout(format!("the request took over {limit_ms} ms to arrive and be answered")).into_response()
        });
        let elapsed_us = started.elapsed().as_micros() as u64;
        debug!(status = response.status().as_u16(), elapsed_us, "answered");
        response
    };
    let mut response = error::finish(work.instrument(span).await, &id);
    if let Ok(id) = HeaderValue::from_str(&id) {
        response.headers_mut().insert(REQUEST_ID, id);
    }
    response
}
