//! From errors to HTTP: the one place that knows status codes, and the one shape that errors have (RFC 9457).

use axum::Json;
use axum::body::Body;
use axum::extract::multipart::MultipartError;
use axum::extract::path::ErrorKind;
use axum::extract::rejection::{BytesRejection, JsonRejection, PathRejection, QueryRejection};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use tracing::error;

use super::environments::EnvironmentError;
use super::images::ImageError;
use super::predict::PredictError;
use super::sessions::table::TableError;
use crate::dataset::DatasetError;
use crate::frame::FrameError;
use crate::jobs::JobError;
use crate::serving::ServingError;
use crate::versions::VersionError;
use crate::wording::sentence;

/// When to try again where nothing more is known, in seconds.
const RETRY_AFTER_S: u64 = 1;
/// Bytes of a detail at most: it quotes what a client sent, however long that is.
const MAX_DETAIL_BYTES: usize = 1000;

/// An error as a client sees it: problem details, RFC 9457.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct Problem {
    /// What kind of problem, as a URN.
    #[serde(rename = "type")]
    pub kind: String,
    /// The same in words.
    pub title: &'static str,
    /// The HTTP status.
    pub status: u16,
    /// What was wrong here, and what would be right.
    pub detail: String,
    /// The request's id, as in the header `x-request-id`.
    pub instance: String,
}

/// What a handler refuses a request with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum ApiError {
    Malformed(String),
    Unauthorized(&'static str),
    Forbidden(String),
    NotFound(String),
    MethodNotAllowed,
    NotAcceptable(String),
    Timeout(String),
    Conflict(String),
    ClientGone(String),
    TooLarge(String),
    UnsupportedMedia(String),
    Unprocessable(String),
    UpgradeRequired,
    Internal(String),
    Unavailable { detail: String, retry_after_s: u64 },
}

impl ApiError {
    pub(super) fn unavailable(detail: impl Into<String>) -> Self {
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
            Self::ClientGone(_) => (StatusCode::GONE, "gone"),
            Self::TooLarge(_) => (StatusCode::PAYLOAD_TOO_LARGE, "too-large"),
            Self::UnsupportedMedia(_) => (StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported-media-type"),
            Self::Unprocessable(_) => (StatusCode::UNPROCESSABLE_ENTITY, "unprocessable"),
            Self::UpgradeRequired => (StatusCode::UPGRADE_REQUIRED, "upgrade-required"),
            Self::Internal(_) => (StatusCode::INTERNAL_SERVER_ERROR, "internal"),
            Self::Unavailable { .. } => (StatusCode::SERVICE_UNAVAILABLE, "unavailable"),
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
            | Self::ClientGone(detail)
            | Self::TooLarge(detail)
            | Self::UnsupportedMedia(detail)
            | Self::Unprocessable(detail)
            | Self::Unavailable { detail, .. } => detail,
            Self::Unauthorized(detail) => detail.to_owned(),
            Self::MethodNotAllowed => "this path does not take that method; see /openapi.json".to_owned(),
            Self::UpgradeRequired => "this path is a WebSocket; ask for an upgrade with its handshake".to_owned(),
            // The cause is in the log, under the request's id.
            Self::Internal(_) => "the server failed; its log says why under this request's id".to_owned(),
        }
    }
}

impl IntoResponse for ApiError {
    /// A response without body: [`finish`] writes it, who knows the request's id.
    fn into_response(self) -> Response {
        if let Self::Internal(cause) = &self {
            error!(cause, "request failed");
        }
        let (status, slug) = self.status();
        let mut response = status.into_response();
        let headers = response.headers_mut();
        match &self {
            Self::Unavailable { retry_after_s, .. } => {
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
            detail: bounded(self.detail()),
            instance: String::new(),
        });
        response
    }
}

/// Writes the body of an error's response.
pub(super) fn finish(mut response: Response, request_id: &str) -> Response {
    let Some(problem) = response.extensions_mut().remove::<Problem>() else {
        return response;
    };
    let problem = Problem {
        instance: request_id.to_owned(),
        ..problem
    };
    *response.body_mut() = serde_json::to_vec(&problem).map_or_else(|_| Body::empty(), Body::from);
    let headers = response.headers_mut();
    headers.remove(header::CONTENT_LENGTH);
    headers.insert(
        header::CONTENT_TYPE,
        HeaderValue::from_static("application/problem+json"),
    );
    response
}

impl From<ServingError> for ApiError {
    fn from(error: ServingError) -> Self {
        match error {
            ServingError::UnknownModel { .. } => Self::NotFound(error.to_string()),
            ServingError::Input(_) => Self::Unprocessable(error.to_string()),
            ServingError::QueueFull { retry_after_s, .. } => Self::Unavailable {
                detail: error.to_string(),
                retry_after_s,
            },
            ServingError::Deadline { .. } | ServingError::Stopped => Self::unavailable(error.to_string()),
            ServingError::Panicked
            | ServingError::Model { .. }
            | ServingError::Frame { .. }
            | ServingError::Tensor(_)
            | ServingError::Thread(_) => Self::Internal(sentence(&error)),
        }
    }
}

impl From<PredictError> for ApiError {
    fn from(error: PredictError) -> Self {
        match error {
            PredictError::TooMany { .. } | PredictError::TooLarge { .. } => Self::TooLarge(error.to_string()),
            PredictError::Image(image) => image.into(),
            PredictError::Serving(serving) => serving.into(),
            PredictError::Buffering { .. } => Self::Conflict(error.to_string()),
            PredictError::Value { .. }
            | PredictError::BothStates
            | PredictError::StateCount { .. }
            | PredictError::NoCandidates
            | PredictError::Input(_) => Self::Unprocessable(error.to_string()),
            PredictError::Picture(FrameError::Size { .. }) => {
                Self::NotAcceptable("the picture would be too large; ask for application/json".to_owned())
            }
            PredictError::Picture(_) => Self::Internal(sentence(&error)),
        }
    }
}

impl From<ImageError> for ApiError {
    fn from(error: ImageError) -> Self {
        match error {
            ImageError::Encode(_) => Self::Internal(sentence(&error)),
            _ => Self::Unprocessable(error.to_string()),
        }
    }
}

impl From<EnvironmentError> for ApiError {
    fn from(error: EnvironmentError) -> Self {
        match error {
            EnvironmentError::Ended => Self::Conflict(error.to_string()),
            EnvironmentError::Image(image) => image.into(),
            _ => Self::Unprocessable(error.to_string()),
        }
    }
}

impl From<TableError> for ApiError {
    fn from(error: TableError) -> Self {
        match error {
            TableError::Unknown(_) => Self::NotFound(error.to_string()),
            TableError::Expired { .. } => Self::ClientGone(error.to_string()),
            TableError::Token => Self::Forbidden(error.to_string()),
            TableError::Full(_) => Self::unavailable(error.to_string()),
        }
    }
}

impl From<JobError> for ApiError {
    fn from(error: JobError) -> Self {
        match error {
            JobError::Unknown { .. } => Self::NotFound(error.to_string()),
            JobError::Invalid { .. } | JobError::NotFound { .. } => Self::Unprocessable(error.to_string()),
            JobError::IllegalTransition { .. }
            | JobError::Taken { .. }
            | JobError::Occupied { .. }
            | JobError::InUse { .. } => Self::Conflict(error.to_string()),
            JobError::QueueFull { .. } | JobError::Stopping => Self::unavailable(error.to_string()),
            JobError::Store(ref store) if store.is_unavailable() => Self::unavailable(sentence(&error)),
            JobError::Record { .. }
            | JobError::Instance(_)
            | JobError::Threads(_)
            | JobError::Dataset(_)
            | JobError::Versions(_)
            | JobError::Store(_) => Self::Internal(sentence(&error)),
        }
    }
}

impl From<VersionError> for ApiError {
    fn from(error: VersionError) -> Self {
        match error {
            VersionError::Unknown { .. } => Self::NotFound(error.to_string()),
            VersionError::Active { .. } | VersionError::Shipped { .. } => Self::Conflict(error.to_string()),
            VersionError::Refused { .. } => Self::Unprocessable(error.to_string()),
            VersionError::Serving(serving) => serving.into(),
            VersionError::Store(ref store) if store.is_unavailable() => Self::unavailable(sentence(&error)),
            VersionError::Registry(_) | VersionError::Io { .. } | VersionError::Store(_) => {
                Self::Internal(sentence(&error))
            }
        }
    }
}

impl From<DatasetError> for ApiError {
    fn from(error: DatasetError) -> Self {
        match error {
            DatasetError::NoEpisode { .. } => Self::NotFound(error.to_string()),
            _ => Self::Internal(sentence(&error)),
        }
    }
}

impl From<JsonRejection> for ApiError {
    fn from(rejection: JsonRejection) -> Self {
        match rejection {
            JsonRejection::MissingJsonContentType(_) => Self::UnsupportedMedia(
                "the body must be JSON, and the header Content-Type must say application/json".to_owned(),
            ),
            JsonRejection::JsonDataError(error) => Self::Unprocessable(error.body_text()),
            JsonRejection::BytesRejection(error) => error.into(),
            other => Self::Malformed(other.body_text()),
        }
    }
}

impl From<BytesRejection> for ApiError {
    fn from(rejection: BytesRejection) -> Self {
        if rejection.status() == StatusCode::PAYLOAD_TOO_LARGE {
            Self::TooLarge("the body is longer than this server takes".to_owned())
        } else {
            Self::Malformed(rejection.body_text())
        }
    }
}

impl From<QueryRejection> for ApiError {
    fn from(rejection: QueryRejection) -> Self {
        Self::Malformed(rejection.body_text())
    }
}

impl From<MultipartError> for ApiError {
    fn from(error: MultipartError) -> Self {
        if error.status() == StatusCode::PAYLOAD_TOO_LARGE {
            Self::TooLarge("the body is longer than this server takes".to_owned())
        } else {
            Self::Malformed(format!("the body is no multipart form: {}", error.body_text()))
        }
    }
}

impl From<PathRejection> for ApiError {
    fn from(rejection: PathRejection) -> Self {
        let detail = match &rejection {
            PathRejection::FailedToDeserializePathParams(error) => match error.kind() {
                ErrorKind::ParseErrorAtIndex { value, .. } | ErrorKind::ParseErrorAtKey { value, .. } => Some(format!(
                    "\"{value}\" in the path is no whole number, or too great a one"
                )),
                _ => None,
            },
            _ => None,
        };
        Self::Malformed(detail.unwrap_or_else(|| rejection.body_text()))
    }
}

/// The detail, without its middle where it is too long.
pub(super) fn bounded(detail: String) -> String {
    if detail.len() <= MAX_DETAIL_BYTES {
        return detail;
    }
    let head = detail.floor_char_boundary(MAX_DETAIL_BYTES / 2);
    let tail = detail.ceil_char_boundary(detail.len() - MAX_DETAIL_BYTES / 2);
    format!("{} … {}", &detail[..head], &detail[tail..])
}

/// The answer that a job was taken: accepted, where it can be watched, and what it is.
pub(super) fn accepted<T: Serialize>(location: &str, body: T) -> Response {
    let mut response = (StatusCode::ACCEPTED, Json(body)).into_response();
    if let Ok(location) = HeaderValue::from_str(location) {
        response.headers_mut().insert(header::LOCATION, location);
    }
    response
}

/// What a connection over the limit is told before it is closed, as it goes over the wire: no request is read for it.
pub(super) const CONNECTIONS_FULL_RESPONSE: &str = "HTTP/1.1 503 Service Unavailable\r\n\
    Retry-After: 1\r\nConnection: close\r\nContent-Type: application/problem+json\r\n\r\n\
    {\"type\":\"urn:foreframe:problem:unavailable\",\"title\":\"Service Unavailable\",\"status\":503,\
    \"detail\":\"too many connections; try again later\",\"instance\":\"\"}";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_detail_keeps_its_beginning_and_its_end() {
        let long = format!("unknown field `{}` at line 1", "ä".repeat(1000));
        let bounded = bounded(long.clone());
        assert!(
            bounded.len() < MAX_DETAIL_BYTES + 10 && bounded.starts_with("unknown field `ä"),
            "{bounded}"
        );
        assert!(bounded.ends_with("ä` at line 1"), "{bounded}");
        assert_eq!(super::bounded("short".to_owned()), "short");
    }
}
