//! Bodies with fields, in both directions: JSON, or `MessagePack`, in which images are binary.

use axum::body::Bytes;
use axum::extract::{FromRequest, Request};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::extract::{Json, MSGPACK, Object, ResponseFormat};
use super::problem::ApiError;
use crate::server::msgpack;

/// A body of JSON or `MessagePack`, by its Content-Type.
pub(in crate::server) struct JsonOrMsgpack<T>(pub(in crate::server) T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for JsonOrMsgpack<T> {
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self, ApiError> {
        if !is_msgpack(request.headers()) {
            let body = Json::from_request(request, state).await;
            return body.map(|Json(body)| Self(body)).map_err(with_msgpack);
        }
        let bytes = Bytes::from_request(request, state).await?;
        let Object(body) = msgpack::read(&bytes).map_err(|error| {
            if error.is_of_a_field() {
                ApiError::Unprocessable(error.to_string())
            } else {
                ApiError::Malformed(format!("the body is not MessagePack: {error}"))
            }
        })?;
        Ok(Self(body))
    }
}

/// Names this media type too, where the body is of another.
fn with_msgpack(error: ApiError) -> ApiError {
    match error {
        ApiError::UnsupportedMedia(_) => ApiError::UnsupportedMedia(format!(
            "the body must be JSON or MessagePack, and the header Content-Type must say application/json or {MSGPACK}"
        )),
        other => other,
    }
}

fn is_msgpack(headers: &HeaderMap) -> bool {
    let media_type = headers
        .get(header::CONTENT_TYPE)
        .and_then(|media_type| media_type.to_str().ok());
    let named = media_type.and_then(|media_type| media_type.split(';').next());
    named.is_some_and(|named| named.trim().eq_ignore_ascii_case(MSGPACK))
}

/// The answer with that body: `MessagePack` if the client wants it, otherwise JSON.
pub(in crate::server) fn structured(wanted: ResponseFormat, body: &impl Serialize) -> Response {
    match wanted {
        ResponseFormat::Msgpack => ([(header::CONTENT_TYPE, MSGPACK)], msgpack::write(body)).into_response(),
        ResponseFormat::Json | ResponseFormat::Png | ResponseFormat::Gif => axum::Json(body).into_response(),
    }
}
