//! Which web pages may call the server: its own pages, and those of the origins in `cors_origins`. Otherwise any page
//! could use a server on the visitor's network. A page could also give the server's address a domain name of its own
//! (DNS rebinding) to count as one of the server's pages, so without API keys the host is checked too.
//!
//! `tower-http`'s `CorsLayer` only adds headers. This also refuses the requests of other pages and of other hosts.

use std::net::{Ipv4Addr, Ipv6Addr};
use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderValue, Method, StatusCode, Uri, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::keys::Keys;
use super::problem::ApiError;
use crate::server::config::ServerConfig;

const METHODS: HeaderValue = HeaderValue::from_static("GET, POST, DELETE");
/// The headers that a page may send.
const HEADERS: HeaderValue = HeaderValue::from_static(
    "authorization, content-type, idempotency-key, inference-header-content-length, last-event-id, x-request-id, \
     x-session-token",
);
/// The headers of answers that a page may read, besides those that any page may.
const EXPOSED: HeaderValue =
    HeaderValue::from_static("inference-header-content-length, location, retry-after, x-request-id");

/// Whether a text is the origin of a web page: it has no user and no path.
pub(crate) fn is_origin(text: &str) -> bool {
    text.parse::<Uri>().is_ok_and(|uri| {
        let is_web = matches!(uri.scheme_str(), Some("http" | "https"));
        is_web && uri.authority().is_some_and(is_host_and_port) && uri.path_and_query().is_none_or(|rest| rest == "/")
    })
}

/// The origins that may call, and whether hosts are checked.
#[derive(Clone)]
pub(in crate::server) struct OriginPolicy {
    allowed: Arc<[String]>,
    keys: Keys,
}

impl OriginPolicy {
    pub(in crate::server) fn new(config: &ServerConfig, keys: Keys) -> Self {
        Self {
            allowed: config
                .cors_origins
                .iter()
                .map(|origin| as_browsers_write(origin))
                .collect(),
            keys,
        }
    }
}

/// The origin without capital letters, a slash at the end and the port that its scheme implies.
fn as_browsers_write(origin: &str) -> String {
    let origin = origin.trim_end_matches(['/', ':']).to_ascii_lowercase();
    let implied = if origin.starts_with("https://") { ":443" } else { ":80" };
    origin.strip_suffix(implied).unwrap_or(&origin).to_owned()
}

/// Refuses requests to a foreign host and requests of a foreign page, unless they are configured. Answers preflight
/// requests.
pub(in crate::server) async fn check(
    State(policy): State<OriginPolicy>,
    request: Request,
    next: Next,
) -> Result<Response, ApiError> {
    let host = requested_host(&request)?;
    let allowed = &policy.allowed;
    if !policy.keys.are_required()
        && let Some(host) = host.as_ref().filter(|host| is_foreign(host, allowed))
    {
        return Err(ApiError::Forbidden(format!(
            "authentication is off, so this server answers only to localhost, IP addresses and names without a dot, not to \
             {host}; create an API key (foreframe keys create NAME), or add http://{host} to the setting cors_origins"
        )));
    }
    let mut origins = request.headers().get_all(header::ORIGIN).iter().cloned();
    let Some(origin) = origins.next() else {
        return Ok(next.run(request).await);
    };
    if origins.next().is_some() {
        let detail = "there is more than one Origin header".to_owned();
        return Err(ApiError::Malformed(detail));
    }
    if host.is_some_and(|host| is_own(&origin, &host)) {
        return Ok(next.run(request).await);
    }
    if !allowed.iter().any(|allowed| allowed.as_bytes() == origin.as_bytes()) {
        return Err(ApiError::Forbidden(format!(
            "pages of the origin {} may not call this server; allow it with the setting cors_origins",
            String::from_utf8_lossy(origin.as_bytes())
        )));
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
    } else {
        headers.insert(header::ACCESS_CONTROL_EXPOSE_HEADERS, EXPOSED);
    }
    Ok(response)
}

/// The host that is asked; `None` in HTTP/1.0, which need not name one. Errors: `Malformed` unless the request has one valid Host
/// header (HTTP/1.0: at most one), and its target names no other host.
fn requested_host(request: &Request) -> Result<Option<Authority>, ApiError> {
    let wrong = |what: &str| {
        Err(ApiError::Malformed(format!(
            "{what}; a request names its host once, as in Host: 127.0.0.1:8642"
        )))
    };
    let target = request.uri().authority();
    let mut hosts = request.headers().get_all(header::HOST).iter();
    let host = match (hosts.next(), hosts.next()) {
        (Some(host), None) => Authority::try_from(host.as_bytes()).ok(),
        (Some(_), Some(_)) => return wrong("there is more than one Host header"),
        // Before HTTP/1.1, there was no such header.
        (None, _) if request.version() < Version::HTTP_11 => match target {
            Some(target) => Some(target.clone()),
            None => return Ok(None),
        },
        (None, _) => return wrong("there is no Host header"),
    };
    let Some(host) = host.filter(is_host_and_port) else {
        return wrong("the Host header is no host with an optional port");
    };
    let scheme = request.uri().scheme_str().unwrap_or_default();
    if target.is_some_and(|target| !are_same(&host, target, scheme)) {
        return wrong("the request's target and its Host header name different hosts");
    }
    Ok(Some(host))
}

/// A name or an address and at most a port, without a user.
fn is_host_and_port(authority: &Authority) -> bool {
    let host = authority.host();
    let is_host = match host.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
        Some(address) => address.parse::<Ipv6Addr>().is_ok(),
        None => !host.is_empty() && !host.contains(['[', ']']),
    };
    let port = authority.as_str().strip_prefix(host);
    let is_port = |port: &str| port.is_empty() || port == ":" || authority.port_u16().is_some();
    is_host && port.is_some_and(is_port)
}

/// Whether two hosts are the same, in a URL of this scheme.
fn are_same(one: &Authority, other: &Authority, scheme: &str) -> bool {
    let port = |of: &Authority| of.port_u16().unwrap_or(if scheme == "https" { 443 } else { 80 });
    one.host().eq_ignore_ascii_case(other.host()) && port(one) == port(other)
}

/// Whether the host is a domain name that anybody could point at this machine.
fn is_foreign(host: &Authority, allowed: &[String]) -> bool {
    let name = host.host();
    let is_address = name.starts_with('[') || name.parse::<Ipv4Addr>().is_ok();
    let is_local = !name.contains('.') || name.ends_with(".localhost");
    let is_of = |origin: &String| {
        let of_page = origin.split_once("://");
        of_page.is_some_and(|(scheme, of)| of.parse().is_ok_and(|of| are_same(host, &of, scheme)))
    };
    let is_allowed = allowed.iter().any(is_of);
    !is_address && !is_local && !is_allowed
}

/// Whether the page came from this server: its origin names the requested host.
fn is_own(origin: &HeaderValue, host: &Authority) -> bool {
    let of_page = origin.to_str().ok().and_then(|origin| origin.split_once("://"));
    let Some((scheme @ ("http" | "https"), of_page)) = of_page else {
        return false;
    };
    of_page.parse().is_ok_and(|of_page| are_same(host, &of_page, scheme))
}
