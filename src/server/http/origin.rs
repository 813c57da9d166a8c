//! Which web pages may call the server: its own pages, and those of the origins in `cors_origins`. Otherwise any page
//! could use a server on the visitor's network. A page could also give the server's address a domain name of its own
//! (DNS rebinding) to count as one of the server's pages, so without API keys the host is checked too.
//!
//! `tower-http`'s `CorsLayer` only adds headers. This also refuses the requests of other pages and of other hosts.

use std::net::Ipv4Addr;
use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::keys::Keys;
use super::problem::ApiError;
use crate::server::config::ServerConfig;

const METHODS: HeaderValue = HeaderValue::from_static("GET, POST, DELETE");
const HEADERS: HeaderValue =
    HeaderValue::from_static("authorization, content-type, idempotency-key, x-request-id, x-session-token");

/// The origins that may call, and whether hosts are checked.
#[derive(Clone)]
pub(in crate::server) struct OriginPolicy {
    allowed: Arc<[String]>,
    keys: Keys,
}

impl OriginPolicy {
    pub(in crate::server) fn new(config: &ServerConfig, keys: Keys) -> Self {
        Self {
            allowed: config.cors_origins.as_slice().into(),
            keys,
        }
    }
}

/// Refuses requests to a foreign host and requests of a foreign page, unless they are configured. Answers preflight
/// requests.
pub(in crate::server) async fn check(State(policy): State<OriginPolicy>, request: Request, next: Next) -> Response {
    if let Err(wrong) = check_host(&request) {
        return wrong.into_response();
    }
    let allowed = &policy.allowed;
    if !policy.keys.are_required()
        && let Some(host) = foreign_host(request.headers(), allowed)
    {
        return ApiError::Forbidden(format!(
            "authentication is off, so this server answers only to localhost, IP addresses and names without a dot, not to \
             {host}; create an API key (foreframe keys create NAME), or add http://{host} to the setting cors_origins"
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
            "pages of the origin {} may not call this server; allow it with the setting cors_origins",
            String::from_utf8_lossy(origin.as_bytes())
        ))
        .into_response();
    }
    let is_preflight = request.method() == Method::OPTIONS;
    let mut response = if is_preflight {
        StatusCode::NO_CONTENT.into_response()
    } else {
        next.run(request).await
    };
    let headers = response.headers_mut();
    headers.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, origin);
    headers.append(header::VARY, HeaderValue::from_static("origin"));
    if is_preflight {
        headers.insert(header::ACCESS_CONTROL_ALLOW_METHODS, METHODS);
        headers.insert(header::ACCESS_CONTROL_ALLOW_HEADERS, HEADERS);
    }
    response
}

/// Errors: `Malformed` unless the request has one valid Host header (HTTP/1.0: at most one), and its target names no other host.
fn check_host(request: &Request) -> Result<(), ApiError> {
    let wrong = |what: &str| {
        Err(ApiError::Malformed(format!(
            "{what}; a request names its host once, as in Host: 127.0.0.1:8642"
        )))
    };
    let mut hosts = request.headers().get_all(header::HOST).iter();
    let host = match (hosts.next(), hosts.next()) {
        (Some(host), None) => host,
        (Some(_), Some(_)) => return wrong("there is more than one Host header"),
        // Before HTTP/1.1, there was no such header.
        (None, _) if request.version() < Version::HTTP_11 => return Ok(()),
        (None, _) => return wrong("there is no Host header"),
    };
    let Some(authority) = Authority::try_from(host.as_bytes())
        .ok()
        .filter(|host| !host.host().is_empty() && !host.as_str().contains('@'))
    else {
        return wrong("the Host header is no host with an optional port");
    };
    match request.uri().authority() {
        Some(target) if *target != authority => wrong("the request's target and its Host header name different hosts"),
        _ => Ok(()),
    }
}

/// The requested host, if it is a domain name that anybody could point at this machine.
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

/// Whether the page came from this server: its origin ends in the requested host.
fn is_own(origin: &HeaderValue, headers: &HeaderMap) -> bool {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok());
    let of_page = origin.to_str().ok().and_then(|origin| origin.split_once("://"));
    matches!((host, of_page), (Some(host), Some((_, of_page))) if host == of_page)
}
