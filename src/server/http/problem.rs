//! The HTTP status of an error, and the one shape that errors have: problem details (RFC 9457).

use std::error::Error;
use std::fmt::Display;

use axum::body::Body;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tracing::{error, warn};

use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::error_text::{with_causes, without_middle};
use foreframe_core::files::is_transient;

/// When the client may try again if nothing better is known, in seconds.
const RETRY_AFTER_S: u64 = 1;

const FILES_AWAY: &str =
    "the server cannot read or write its files now, for example because its disk is full; try again later";

/// An error as a client sees it: problem details, RFC 9457.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct Problem {
    /// The kind of problem, as a URN.
    #[serde(rename = "type")]
    pub kind: String,
    /// The kind of problem in words.
    pub title: &'static str,
    /// The HTTP status.
    pub status: u16,
    /// What was wrong, and what would be right.
    pub detail: String,
    /// The request's id, as in the header `x-request-id`.
    pub instance: String,
}

/// Why a request failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::server) enum ApiError {
    Malformed(String),
    Unauthorized(&'static str),
    Forbidden(String),
    NotFound(String),
    MethodNotAllowed,
    NotAcceptable(String),
    Timeout(String),
    Conflict(String),
    Gone(String),
    TooLarge(String),
    UnsupportedMedia(String),
    Unprocessable(String),
    UpgradeRequired,
    Internal(String),
    Unavailable { detail: String, retry_after_s: u64 },
    TooMany { detail: String, retry_after_s: u64 },
}

impl ApiError {
    /// The answer for an error of that kind.
    pub(in crate::server) fn of(error: &(impl HasErrorKind + 'static)) -> Self {
        Self::of_kind(error.kind(), error)
    }

    /// The answer for an error of our own data, which the client did not name: its text may name paths of this machine.
    pub(in crate::server) fn of_own_data(error: &(impl HasErrorKind + 'static)) -> Self {
        Self::of_kind(error.kind().of_own_data(), error)
    }

    fn of_kind(kind: ErrorKind, error: &(dyn Error + 'static)) -> Self {
        match kind {
            ErrorKind::NotFound => Self::NotFound(error.to_string()),
            ErrorKind::Usage | ErrorKind::Unusable => Self::Unprocessable(error.to_string()),
            ErrorKind::Conflict => Self::Conflict(error.to_string()),
            ErrorKind::Busy => Self::unavailable(error.to_string()),
            // The error names a file of this machine.
            ErrorKind::Away if is_transient(error) => {
                warn!(cause = with_causes(error), "a file cannot be read or written now");
                Self::unavailable(FILES_AWAY)
            }
            ErrorKind::Away => Self::unavailable(with_causes(error)),
            ErrorKind::Cancelled | ErrorKind::Internal => Self::Internal(with_causes(error)),
        }
    }

    pub(in crate::server) fn unavailable(detail: impl Into<String>) -> Self {
        Self::Unavailable {
            detail: detail.into(),
            retry_after_s: RETRY_AFTER_S,
        }
    }

    fn status(&self) -> (StatusCode, &'static str) {
        match self {
            Self::Malformed(_) => (StatusCode::BAD_REQUEST, "malformed"),
            Self::Unauthorized(_) => (StatusCode::UNAUTHORIZED, "unauthorized"),
            Self::Forbidden(_) => (StatusCode::FORBIDDEN, "forbidden"),
            Self::NotFound(_) => (StatusCode::NOT_FOUND, "not-found"),
            Self::MethodNotAllowed => (StatusCode::METHOD_NOT_ALLOWED, "method-not-allowed"),
            Self::NotAcceptable(_) => (StatusCode::NOT_ACCEPTABLE, "not-acceptable"),
            Self::Timeout(_) => (StatusCode::REQUEST_TIMEOUT, "timeout"),
            Self::Conflict(_) => (StatusCode::CONFLICT, "conflict"),
            Self::Gone(_) => (StatusCode::GONE, "gone"),
            Self::TooLarge(_) => (StatusCode::PAYLOAD_TOO_LARGE, "too-large"),
            Self::UnsupportedMedia(_) => (StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported-media-type"),
            Self::Unprocessable(_) => (StatusCode::UNPROCESSABLE_ENTITY, "unprocessable"),
            Self::UpgradeRequired => (StatusCode::UPGRADE_REQUIRED, "upgrade-required"),
            Self::Internal(_) => (StatusCode::INTERNAL_SERVER_ERROR, "internal"),
            Self::Unavailable { .. } => (StatusCode::SERVICE_UNAVAILABLE, "unavailable"),
            Self::TooMany { .. } => (StatusCode::TOO_MANY_REQUESTS, "too-many"),
        }
    }

    fn detail(self) -> String {
        match self {
            Self::Malformed(detail)
            | Self::Forbidden(detail)
            | Self::NotFound(detail)
            | Self::NotAcceptable(detail)
            | Self::Timeout(detail)
            | Self::Conflict(detail)
            | Self::Gone(detail)
            | Self::TooLarge(detail)
            | Self::UnsupportedMedia(detail)
            | Self::Unprocessable(detail)
            | Self::Unavailable { detail, .. }
            | Self::TooMany { detail, .. } => detail,
            Self::Unauthorized(detail) => detail.to_owned(),
            Self::MethodNotAllowed => "this path does not support that method; see /openapi.json".to_owned(),
            Self::UpgradeRequired => "this path is a WebSocket; connect with a WebSocket handshake".to_owned(),
            // The cause is in the log, under the request's id.
            Self::Internal(_) => "the server failed; the reason is in its log, under the id of this request".to_owned(),
        }
    }
}

impl IntoResponse for ApiError {
    /// A response without body: [`finish`] writes the body, because it knows the request's id.
    fn into_response(self) -> Response {
        if let Self::Internal(cause) = &self {
            error!(cause, "request failed");
        }
        let (status, slug) = self.status();
        let mut response = status.into_response();
        let headers = response.headers_mut();
        match &self {
            Self::Unavailable { retry_after_s, .. } | Self::TooMany { retry_after_s, .. } => {
                headers.insert(header::RETRY_AFTER, HeaderValue::from(*retry_after_s));
            }
            Self::Unauthorized(_) => {
                headers.insert(
                    header::WWW_AUTHENTICATE,
                    HeaderValue::from_static("Bearer realm=\"foreframe\""),
                );
            }
            _ => {}
        }
        response.extensions_mut().insert(Problem {
            kind: format!("urn:foreframe:problem:{slug}"),
            title: status.canonical_reason().unwrap_or(slug),
            status: status.as_u16(),
            detail: without_middle(&self.detail()),
            instance: String::new(),
        });
        response
    }
}

/// The answer to a request in which a field cannot be used.
pub(in crate::server) fn unfit<E: Display>(field: &str) -> impl Fn(E) -> ApiError {
    move |error| ApiError::Unprocessable(format!("{field}: {error}"))
}

/// Writes the body of an error response.
pub(in crate::server) fn finish(mut response: Response, request_id: &str) -> Response {
    let Some(problem) = response.extensions_mut().remove::<Problem>() else {
        return response;
    };
    let problem = Problem {
        instance: request_id.to_owned(),
        ..problem
    };
    *response.body_mut() = Body::from(json(&problem));
    let headers = response.headers_mut();
    headers.remove(header::CONTENT_LENGTH);
    headers.insert(
        header::CONTENT_TYPE,
        HeaderValue::from_static("application/problem+json"),
    );
    response
}

#[expect(clippy::expect_used, reason = "a struct of texts and a number is always valid JSON")]
fn json(problem: &Problem) -> Vec<u8> {
    serde_json::to_vec(problem).expect("a problem that is not JSON is a bug")
}

/// The response to a connection over the limit, as bytes on the wire: no request is read from it.
pub(in crate::server) const CONNECTIONS_FULL_RESPONSE: &str = "HTTP/1.1 503 Service Unavailable\r\n\
    Retry-After: 1\r\nConnection: close\r\nContent-Type: application/problem+json\r\n\
    X-Content-Type-Options: nosniff\r\n\r\n\
    {\"type\":\"urn:foreframe:problem:unavailable\",\"title\":\"Service Unavailable\",\"status\":503,\
    \"detail\":\"too many connections; try again later\",\"instance\":\"\"}";

/// The response to a request in plain HTTP where TLS is expected.
#[cfg(feature = "tls")]
pub(in crate::server) const PLAIN_HTTP_RESPONSE: &str = "HTTP/1.1 400 Bad Request\r\n\
    Connection: close\r\nContent-Type: application/problem+json\r\nX-Content-Type-Options: nosniff\r\n\r\n\
    {\"type\":\"urn:foreframe:problem:malformed\",\"title\":\"Bad Request\",\"status\":400,\
    \"detail\":\"this address takes HTTPS only; use https:// or wss://\",\"instance\":\"\"}";

/// The response to a request that is not HTTP, in place of the one without a body that hyper writes. `head`: what hyper would
/// write. `None` if it is another response: all of ours have a request id.
pub(in crate::server) fn unreadable_request(head: &[u8]) -> Option<Vec<u8>> {
    let head = head.starts_with(b"HTTP/1.1 4").then_some(head)?;
    let head = std::str::from_utf8(head).ok()?;
    let (line, headers) = head.split_once("\r\n")?;
    let is_alone = headers.ends_with("\r\n\r\n") && headers.matches("\r\n\r\n").count() == 1;
    if !is_alone || headers.contains("x-request-id:") {
        return None;
    }
    let (kind, title, status, detail) = match line.split(' ').nth(1)? {
        "400" => ("malformed", "Bad Request", 400, "the request is not valid HTTP/1.1"),
        "414" => ("too-large", "URI Too Long", 414, "the path of the request is too long"),
        "431" => (
            "too-large",
            "Request Header Fields Too Large",
            431,
            "the head of the request is longer than this server takes",
        ),
        _ => return None,
    };
    let body = json(&Problem {
        kind: format!("urn:foreframe:problem:{kind}"),
        title,
        status,
        detail: detail.to_owned(),
        instance: String::new(),
    });
    let head = format!(
        "HTTP/1.1 {status} {title}\r\nConnection: close\r\nContent-Type: application/problem+json\r\n\
         X-Content-Type-Options: nosniff\r\nContent-Length: {}\r\n\r\n",
        body.len()
    );
    Some([head.as_bytes(), &body].concat())
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_jobs::store::StoreError;

    #[derive(Debug, thiserror::Error)]
    #[error("of a test")]
    struct ClassifiedError(ErrorKind);

    impl HasErrorKind for ClassifiedError {
        fn kind(&self) -> ErrorKind {
            self.0
        }
    }

    #[test]
    fn the_status_follows_from_the_kind() {
        let status = |kind| ApiError::of(&ClassifiedError(kind)).status().0.as_u16();
        assert_eq!(status(ErrorKind::NotFound), 404);
        assert_eq!(status(ErrorKind::Conflict), 409);
        assert_eq!([ErrorKind::Usage, ErrorKind::Unusable].map(status), [422; 2]);
        assert_eq!([ErrorKind::Busy, ErrorKind::Away].map(status), [503; 2]);
        assert_eq!([ErrorKind::Cancelled, ErrorKind::Internal].map(status), [500; 2]);
    }

    #[test]
    fn an_error_of_our_own_data_is_not_described_to_the_client() {
        let answer = |kind| ApiError::of_own_data(&ClassifiedError(kind));
        assert_eq!(answer(ErrorKind::NotFound), ApiError::Internal("of a test".to_owned()));
        assert_eq!(answer(ErrorKind::Away), ApiError::unavailable("of a test"));
    }

    #[test]
    fn an_answer_names_no_file_of_a_full_disk() {
        let error = StoreError::Io {
            action: "write",
            path: "/private/file".into(),
            source: std::io::ErrorKind::StorageFull.into(),
        };
        assert_eq!(ApiError::of(&error), ApiError::unavailable(FILES_AWAY));
        assert_eq!(ApiError::of_own_data(&error), ApiError::unavailable(FILES_AWAY));
    }
}
