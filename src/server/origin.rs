//! Which pages' scripts may call: those of this server, and those of `cors_origins`. A page elsewhere could otherwise use
//! the service of whoever looks at it; nor may it give this server a name of its own to count as one of its pages.

use std::net::Ipv4Addr;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::App;
use super::error::ApiError;

const METHODS: HeaderValue = HeaderValue::from_static("GET, POST, DELETE");
const HEADERS: HeaderValue =
    HeaderValue::from_static("authorization, content-type, idempotency-key, x-request-id, x-session-token");

/// Refuses what is asked of a foreign host, and what a foreign page asks, unless its origin is configured; answers a browser's question whether it is.
pub(super) async fn check(State(app): State<App>, request: Request, next: Next) -> Response {
    let allowed = &app.config().cors_origins;
    if !app.keys().are_asked_for()
        && let Some(host) = foreign_host(request.headers(), allowed)
    {
        return ApiError::Forbidden(format!(
            "this server asks for no key, so it answers to localhost, addresses and names without a dot, not to {host}; make \
             a key (foreframe keys create NAME), or name http://{host} in the setting cors_origins"
        ))
        .into_response();
    }
    let Some(origin) = request.headers().get(header::ORIGIN).cloned() else {
        return next.run(request).await;
    };
    if is_own(&origin, request.headers()) {
        return next.run(request).await;
    }
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

/// The host that was asked, if that is a name which anybody could have given to this machine: a page of theirs would be one
/// of this server.
fn foreign_host<'a>(headers: &'a HeaderMap, allowed: &[String]) -> Option<&'a str> {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok())?;
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    let is_address = name.starts_with('[') || name.parse::<Ipv4Addr>().is_ok();
    let is_local = !name.contains('.') || name.ends_with(".localhost");
    let is_allowed = allowed
        .iter()
        .any(|origin| origin.split_once("://").is_some_and(|(_, of)| of == host));
    (!is_address && !is_local && !is_allowed).then_some(host)
}

/// Whether the page is of this server: its origin ends in the host that is asked.
fn is_own(origin: &HeaderValue, headers: &HeaderMap) -> bool {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok());
    let of_page = origin.to_str().ok().and_then(|origin| origin.split_once("://"));
    matches!((host, of_page), (Some(host), Some((_, of_page))) if host == of_page)
}
