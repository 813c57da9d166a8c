//! What every request goes through: an id, a span in the log, a deadline, and being counted.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime};

use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use metrics::{counter, histogram};
use tracing::{Instrument, debug, info_span};

use super::App;
use super::error::{self, ApiError};
use crate::telemetry::names;

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

/// Runs the request in a span with its id, within the deadline, finishes the body of an error, and counts the answer.
pub(super) async fn trace(State(app): State<App>, request: Request, next: Next) -> Response {
    let id = app.request_ids().of(request.headers());
    let span = info_span!("request", id = %id, method = %request.method(), path = request.uri().path());
    let (method, route) = (method(request.method()), route(&request));
    let limit_ms = app.config().request_deadline_ms;
    let work = async move {
        let started = Instant::now();
        let response = match refuse_encoded(request.headers()) {
            Ok(()) => tokio::time::timeout(Duration::from_millis(limit_ms), next.run(request)).await,
            Err(refused) => Ok(refused.into_response()),
        };
        let response = response.unwrap_or_else(|_| {
            ApiError::Timeout(format!("the request took over {limit_ms} ms to arrive and be answered")).into_response()
        });
        let (elapsed, status) = (started.elapsed(), response.status());
        debug!(
            status = status.as_u16(),
            elapsed_us = elapsed.as_micros() as u64,
            "answered"
        );
        let status = status.as_str().to_owned();
        counter!(names::HTTP_REQUESTS, "method" => method, "route" => route.clone(), "status" => status).increment(1);
        histogram!(names::HTTP_REQUEST_SECONDS, "route" => route).record(elapsed);
        response
    };
    let mut response = error::finish(work.instrument(span).await, &id);
    let headers = response.headers_mut();
    if let Ok(id) = HeaderValue::from_str(&id) {
        headers.insert(REQUEST_ID, id);
    }
    if app.is_draining() && !headers.contains_key(header::CONNECTION) {
        headers.insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    response
}

/// A small encoded body can be a huge one: none is decoded here.
fn refuse_encoded(headers: &HeaderMap) -> Result<(), ApiError> {
    match headers.get(header::CONTENT_ENCODING) {
        Some(encoding) if encoding != "identity" => Err(ApiError::UnsupportedMedia(
            "the body has a Content-Encoding; send it as it is".to_owned(),
        )),
        _ => Ok(()),
    }
}

/// Methods are few in a metric, whatever clients send.
fn method(method: &Method) -> &'static str {
    match *method {
        Method::GET => "GET",
        Method::HEAD => "HEAD",
        Method::POST => "POST",
        Method::DELETE => "DELETE",
        Method::OPTIONS => "OPTIONS",
        _ => "other",
    }
}

/// The route's template, so that routes are few in a metric.
fn route(request: &Request) -> String {
    let matched = request.extensions().get::<MatchedPath>();
    matched.map_or_else(|| "none".to_owned(), |path| path.as_str().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_body_as_it_is_is_taken() {
        let with = |encoding| HeaderMap::from_iter([(header::CONTENT_ENCODING, HeaderValue::from_static(encoding))]);
        assert!(refuse_encoded(&HeaderMap::new()).is_ok() && refuse_encoded(&with("identity")).is_ok());
        assert!(refuse_encoded(&with("gzip")).is_err() && refuse_encoded(&with("identity, br")).is_err());
    }
}
