//! What every request gets: an id, a span in the log, a deadline, and metrics.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, LazyLock};
use std::task::Poll;
use std::time::{Duration, Instant, SystemTime};

use axum::body::{Body, Bytes, HttpBody as _};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::{StreamExt as _, stream};
use metrics::{counter, histogram};
use tracing::{Instrument, debug, info_span};

use super::access::{is_upload, route};
use super::problem::{self, ApiError, ErrorForm};
use crate::server::config::ServerConfig;
use foreframe_core::metric_names;

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
/// The maximum length of a client's own id; a longer one is replaced.
const MAX_ID_LEN: usize = 64;

/// When the first request came, in seconds since 1970, and how many ids were given: routers of the same process give different ids.
static FIRST_S: LazyLock<u64> = LazyLock::new(|| {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    // A clock before 1970 gives 0: ids then are still unique within this process.
    since_1970.map_or(0, |time| time.as_secs())
});
static NEXT_ID: AtomicU64 = AtomicU64::new(1);

/// What [`trace`] needs; clones share it.
#[derive(Clone)]
pub(in crate::server) struct RequestTrace {
    limit: Duration,
    upload_limit: Duration,
    draining: Arc<AtomicBool>,
}

impl RequestTrace {
    /// `draining` is true while the server stops.
    pub(in crate::server) fn new(config: &ServerConfig, draining: Arc<AtomicBool>) -> Self {
        Self {
            limit: Duration::from_millis(config.request_deadline_ms),
            upload_limit: Duration::from_millis(config.upload_deadline_ms),
            draining,
        }
    }
}

/// The client's own id if it is short and of plain characters, else a new one. (`tower-http`'s request ids would keep any id
/// of a client.)
fn request_id(headers: &HeaderMap) -> String {
    let allowed = |c: u8| c.is_ascii_alphanumeric() || matches!(c, b'-' | b'_' | b'.' | b':');
    let given = headers.get(REQUEST_ID).and_then(|id| id.to_str().ok());
    match given.filter(|id| (1..=MAX_ID_LEN).contains(&id.len()) && id.bytes().all(allowed)) {
        Some(id) => id.to_owned(),
        None => format!("{:x}-{}", *FIRST_S, NEXT_ID.fetch_add(1, Ordering::Relaxed)),
    }
}

/// The same request, and whether all of it has arrived.
fn with_arrival(request: Request) -> (Request, Arc<AtomicBool>) {
    let has_arrived = Arc::new(AtomicBool::new(request.body().is_end_stream()));
    if has_arrived.load(Ordering::Acquire) {
        return (request, has_arrived);
    }
    let at_end = Arc::clone(&has_arrived);
    let end = stream::poll_fn(move |_| {
        at_end.store(true, Ordering::Release);
        Poll::Ready(None::<Result<Bytes, axum::Error>>)
    });
    let request = request.map(|body| Body::from_stream(body.into_data_stream().chain(end)));
    (request, has_arrived)
}

/// Runs the request in a span with its id, within the deadline; writes the body of an error; counts the response.
pub(in crate::server) async fn trace(State(trace): State<RequestTrace>, request: Request, next: Next) -> Response {
    let id = request_id(request.headers());
    let span = info_span!("request", id = %id, method = %request.method(), path = request.uri().path());
    // Labels with few values, whatever clients send.
    let (method, route) = (method(request.method()), route(&request));
    let route = if route.is_empty() { "none" } else { route }.to_owned();
    let limit = if is_upload(&route) {
        trace.upload_limit
    } else {
        trace.limit
    };
    let form = ErrorForm::of(request.uri().path());
    let work = async move {
        let started = Instant::now();
        let answered = async {
            refuse_encoded(request.headers())?;
            let (request, has_arrived) = with_arrival(request);
            let may_be_done = if request.method().is_safe() {
                ""
            } else {
                "; what was asked for may still be done, so look before you repeat it"
            };
            let late = |_| {
                let limit_ms = limit.as_millis();
                if has_arrived.load(Ordering::Acquire) {
                    // It is not the client that was slow.
                    return ApiError::unavailable(format!("no answer was ready within {limit_ms} ms{may_be_done}"));
                }
                ApiError::Timeout(format!(
                    "the request took longer than {limit_ms} ms to arrive and be answered"
                ))
            };
            tokio::time::timeout(limit, next.run(request)).await.map_err(late)
        };
        let response = answered.await.into_response();
        let (elapsed, status) = (started.elapsed(), response.status());
        debug!(
            status = status.as_u16(),
            elapsed_us = elapsed.as_micros() as u64,
            "answered"
        );
        let status = status.as_str().to_owned();
        counter!(metric_names::HTTP_REQUESTS, "method" => method, "route" => route.clone(), "status" => status)
            .increment(1);
        histogram!(metric_names::HTTP_REQUEST_SECONDS, "route" => route).record(elapsed);
        response
    };
    let mut response = problem::finish(work.instrument(span).await, form, &id);
    let headers = response.headers_mut();
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    if let Ok(id) = HeaderValue::from_str(&id) {
        headers.insert(REQUEST_ID, id);
    }
    if trace.draining.load(Ordering::Acquire) && !headers.contains_key(header::CONNECTION) {
        headers.insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    response
}

/// A small compressed body can become a huge one, so the server decodes none.
fn refuse_encoded(headers: &HeaderMap) -> Result<(), ApiError> {
    match headers.get(header::CONTENT_ENCODING) {
        Some(encoding) if !encoding.as_bytes().eq_ignore_ascii_case(b"identity") => Err(ApiError::UnsupportedMedia(
            "the body has a Content-Encoding; send it without".to_owned(),
        )),
        _ => Ok(()),
    }
}

/// The method, or `other` for one that no route has.
fn method(method: &Method) -> &'static str {
    let known = ["GET", "HEAD", "POST", "DELETE", "OPTIONS"];
    known.into_iter().find(|known| *known == method).unwrap_or("other")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_encoded_body_is_refused() {
        let with = |encoding| HeaderMap::from_iter([(header::CONTENT_ENCODING, HeaderValue::from_static(encoding))]);
        assert!(refuse_encoded(&HeaderMap::new()).is_ok());
        assert!(refuse_encoded(&with("identity")).is_ok() && refuse_encoded(&with("IDENTITY")).is_ok());
        assert!(refuse_encoded(&with("gzip")).is_err() && refuse_encoded(&with("identity, br")).is_err());
    }
}
