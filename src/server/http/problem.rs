//! The HTTP status of an error, and the one shape that errors have: problem details (RFC 9457).

use std::error::Error;
use std::fmt::Display;

use axum::body::Body;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tracing::{error, warn};

use crate::server::token::RandomError;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::error_text::{with_causes, without_middle};
use foreframe_core::files::is_transient;

/// When the client may try again if nothing better is known, in seconds.
pub(in crate::server) const RETRY_AFTER_S: u64 = 1;

const MEDIA_TYPE: &str = "application/problem+json";

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

impl Problem {
    fn new(status: StatusCode, slug: &str, detail: &str) -> Self {
        Self {
            kind: format!("urn:foreframe:problem:{slug}"),
            title: status.canonical_reason().unwrap_or_default(),
            status: status.as_u16(),
            detail: without_middle(&detail),
            instance: String::new(),
        }
    }

    #[expect(clippy::expect_used, reason = "a struct of texts and a number is always valid JSON")]
    fn json(&self) -> Vec<u8> {
        serde_json::to_vec(self).expect("a problem that is not JSON is a bug")
    }
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

    /// What was wrong, for protocols whose errors are not problem details.
    pub(in crate::server) fn into_detail(self) -> String {
        self.into_parts().2
    }

    /// The status, the end of the problem's URN, and what was wrong.
    fn into_parts(self) -> (StatusCode, &'static str, String) {
        match self {
            Self::Malformed(detail) => (StatusCode::BAD_REQUEST, "malformed", detail),
            Self::Unauthorized(detail) => (StatusCode::UNAUTHORIZED, "unauthorized", detail.to_owned()),
            Self::Forbidden(detail) => (StatusCode::FORBIDDEN, "forbidden", detail),
            Self::NotFound(detail) => (StatusCode::NOT_FOUND, "not-found", detail),
            Self::MethodNotAllowed => {
                let detail = "this path does not support that method; see /openapi.json".to_owned();
                (StatusCode::METHOD_NOT_ALLOWED, "method-not-allowed", detail)
            }
            Self::NotAcceptable(detail) => (StatusCode::NOT_ACCEPTABLE, "not-acceptable", detail),
            Self::Timeout(detail) => (StatusCode::REQUEST_TIMEOUT, "timeout", detail),
            Self::Conflict(detail) => (StatusCode::CONFLICT, "conflict", detail),
            Self::Gone(detail) => (StatusCode::GONE, "gone", detail),
            Self::TooLarge(detail) => (StatusCode::PAYLOAD_TOO_LARGE, "too-large", detail),
            Self::UnsupportedMedia(detail) => (StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported-media-type", detail),
            Self::Unprocessable(detail) => (StatusCode::UNPROCESSABLE_ENTITY, "unprocessable", detail),
            Self::UpgradeRequired => {
                let detail = "this path is a WebSocket; connect with a WebSocket handshake".to_owned();
                (StatusCode::UPGRADE_REQUIRED, "upgrade-required", detail)
            }
            Self::Internal(cause) => {
                error!(cause, "request failed");
                let detail = "the server failed; the reason is in its log, under the id of this request".to_owned();
                (StatusCode::INTERNAL_SERVER_ERROR, "internal", detail)
            }
            Self::Unavailable { detail, .. } => (StatusCode::SERVICE_UNAVAILABLE, "unavailable", detail),
            Self::TooMany { detail, .. } => (StatusCode::TOO_MANY_REQUESTS, "too-many", detail),
        }
    }
}

impl From<RandomError> for ApiError {
    fn from(error: RandomError) -> Self {
        Self::Internal(error.to_string())
    }
}

impl IntoResponse for ApiError {
    /// A response without body: [`finish`] writes the body, because it knows the request's id.
    fn into_response(self) -> Response {
        let retry_after = match &self {
            Self::Unavailable { retry_after_s, .. } | Self::TooMany { retry_after_s, .. } => Some(*retry_after_s),
            _ => None,
        };
        let (status, slug, detail) = self.into_parts();
        let mut response = status.into_response();
        let headers = response.headers_mut();
        headers.extend(retry_after.map(|seconds| (header::RETRY_AFTER, seconds.into())));
        if status == StatusCode::UNAUTHORIZED {
            let scheme = HeaderValue::from_static("Bearer realm=\"foreframe\"");
            headers.insert(header::WWW_AUTHENTICATE, scheme);
        }
        response.extensions_mut().insert(Problem::new(status, slug, &detail));
        response
    }
}

/// The answer to a request in which a field cannot be used.
pub(in crate::server) fn unfit<E: Display>(field: &str) -> impl Fn(E) -> ApiError {
    move |error| ApiError::Unprocessable(format!("{field}: {error}"))
}

/// How the body of an error is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::server) enum ErrorForm {
    /// Problem details.
    Problem,
    /// `{"error": …}`, as the Open Inference Protocol has it.
    Inference,
}

impl ErrorForm {
    /// The form of errors at a path.
    pub(in crate::server) fn of(path: &str) -> Self {
        let is_inference = path
            .strip_prefix("/v2")
            .is_some_and(|rest| rest.is_empty() || rest.starts_with('/'));
        if is_inference { Self::Inference } else { Self::Problem }
    }
}

/// Writes the body of an error response.
pub(in crate::server) fn finish(mut response: Response, form: ErrorForm, request_id: &str) -> Response {
    let Some(mut problem) = response.extensions_mut().remove::<Problem>() else {
        return response;
    };
    request_id.clone_into(&mut problem.instance);
    let (body, media_type) = match form {
        ErrorForm::Problem => (problem.json(), MEDIA_TYPE),
        ErrorForm::Inference => {
            let body = serde_json::json!({"error": problem.detail}).to_string().into_bytes();
            (body, "application/json")
        }
    };
    *response.body_mut() = Body::from(body);
    let headers = response.headers_mut();
    headers.remove(header::CONTENT_LENGTH);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    response
}

/// The response to a connection from which no request was read, as bytes on the wire. The connection ends after it.
pub(in crate::server) fn last_response(status: StatusCode, slug: &str, detail: &str) -> Vec<u8> {
    let body = Problem::new(status, slug, detail).json();
    let retry_after = match status {
        StatusCode::SERVICE_UNAVAILABLE => format!("Retry-After: {RETRY_AFTER_S}\r\n"),
        _ => String::new(),
    };
    let head = format!(
        "HTTP/1.1 {status}\r\n{retry_after}Connection: close\r\nContent-Type: {MEDIA_TYPE}\r\n\
         X-Content-Type-Options: nosniff\r\nContent-Length: {}\r\n\r\n",
        body.len()
    );
    [head.as_bytes(), &body].concat()
}

/// The response to a request that is not HTTP, in place of the one without a body that hyper writes. `head`: what hyper would
/// write. `None` if it is another response: all of ours have a request id.
pub(in crate::server) fn unreadable_request(head: &[u8]) -> Option<Vec<u8>> {
    let head = str::from_utf8(head.starts_with(b"HTTP/1.1 4").then_some(head)?).ok()?;
    if head.find("\r\n\r\n") != Some(head.len() - 4) || head.contains("x-request-id:") {
        return None;
    }
    let status = StatusCode::from_bytes(head.as_bytes().get(9..12)?).ok()?;
    let (slug, detail) = match status {
        StatusCode::BAD_REQUEST => ("malformed", "the request is not valid HTTP/1.1"),
        StatusCode::URI_TOO_LONG => ("too-large", "the path of the request is too long"),
        StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE => {
            let detail = "the head of the request is longer than this server takes (setting max_header_bytes), or has more \
                          than 100 headers";
            ("too-large", detail)
        }
        _ => return None,
    };
    Some(last_response(status, slug, detail))
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
        let status = |kind| ApiError::of(&ClassifiedError(kind)).into_parts().0.as_u16();
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
