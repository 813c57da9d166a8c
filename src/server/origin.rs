//! Which pages' scripts may call: those of this server, and those of `cors_origins`. A page elsewhere could otherwise use
//! the service of whoever looks at it.

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::App;
use super::error::ApiError;

const METHODS: HeaderValue = HeaderValue::from_static("GET, POST, DELETE");
const HEADERS: HeaderValue = HeaderValue::from_static("authorization, content-type, idempotency-key, x-request-id");

/// Refuses what a foreign page asks, unless its origin is configured; answers a browser's question whether it is.
pub(super) async fn check(State(app): State<App>, request: Request, next: Next) -> Response {
    let Some(origin) = request.headers().get(header::ORIGIN).cloned() else {
        return next.run(request).await;
    };
    if is_own(&origin, request.headers()) {
        return next.run(request).await;
    }
    let allowed = &app.config().cors_origins;
    if !allowed.iter().any(|allowed| allowed.as_bytes() == origin.as_bytes()) {
        return ApiError::Forbidden(format!(
            "pages of the origin {} may not call this server; its setting cors_origins names those that may",
            String::from_utf8_lossy(origin.as_bytes())
        ))
        .into_response();
    }
    let is_question = request.method() == Method::OPTIONS;
    let mut response = if is_question {
        StatusCode::NO_CONTENT.into_response()
    } else {
        next.run(request).await
    };
    let headers = response.headers_mut();
    headers.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, origin);
    headers.append(header::VARY, HeaderValue::from_static("origin"));
    if is_question {
        headers.insert(header::ACCESS_CONTROL_ALLOW_METHODS, METHODS);
        headers.insert(header::ACCESS_CONTROL_ALLOW_HEADERS, HEADERS);
    }
    response
}

/// Whether the page is of this server: its origin ends in the host that is asked.
fn is_own(origin: &HeaderValue, headers: &HeaderMap) -> bool {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok());
    let of_page = origin.to_str().ok().and_then(|origin| origin.split_once("://"));
    matches!((host, of_page), (Some(host), Some((_, of_page))) if host == of_page)
}
