//! Extractors: the parts of a request as typed values. Errors are problem details.

use std::error::Error;
use std::marker::PhantomData;

use axum::extract::path::ErrorKind;
use axum::extract::rejection::{BytesRejection, JsonRejection, PathRejection};
use axum::extract::{FromRequest, FromRequestParts, Request};
use axum::http::request::Parts;
use axum::http::{HeaderValue, StatusCode, header};
use serde::de::value::MapAccessDeserializer;
use serde::de::{DeserializeOwned, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::body_budget;
use super::problem::ApiError;

/// The media type of `MessagePack`.
pub(super) const MSGPACK: &str = "application/msgpack";

/// A JSON body. It must be an object: serde would also accept a list of the fields' values.
pub(in crate::server) struct Json<T>(pub(in crate::server) T);

/// A value that is an object.
pub(in crate::server) struct Object<T>(pub(in crate::server) T);

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Object<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(ObjectVisitor(PhantomData))
    }
}

struct ObjectVisitor<T>(PhantomData<T>);

impl<'de, T: Deserialize<'de>> Visitor<'de> for ObjectVisitor<T> {
    type Value = Object<T>;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Object<T>, A::Error> {
        T::deserialize(MapAccessDeserializer::new(map)).map(Object)
    }
}

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for Json<T> {
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self, ApiError> {
        let axum::Json(Object(value)) = axum::Json::from_request(request, state).await?;
        Ok(Self(value))
    }
}

/// The path's parameters.
pub(in crate::server) struct Path<T>(pub(in crate::server) T);

impl<T: DeserializeOwned + Send, S: Send + Sync> FromRequestParts<S> for Path<T> {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let axum::extract::Path(value) = axum::extract::Path::from_request_parts(parts, state).await?;
        Ok(Self(value))
    }
}

/// The query's parameters.
pub(in crate::server) struct Query<T>(pub(in crate::server) T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequestParts<S> for Query<T> {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let axum::extract::Query(value) = axum::extract::Query::from_request_parts(parts, state)
            .await
            .map_err(|rejection| ApiError::Unprocessable(rejection.body_text()))?;
        Ok(Self(value))
    }
}

/// The media type of the response that the client wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::server) enum ResponseFormat {
    Json,
    /// As JSON, with binary images.
    Msgpack,
    Png,
    Gif,
}

impl ResponseFormat {
    /// The first supported media type in an `Accept` header; JSON if the header is absent.
    fn from_accept(accept: &str) -> Result<Self, ApiError> {
        let named = accept
            .split(',')
            .map(|part| part.split(';').next().unwrap_or("").trim());
        for media_type in named {
            match media_type {
                "application/json" | "application/*" | "*/*" | "" => return Ok(Self::Json),
                MSGPACK => return Ok(Self::Msgpack),
                "image/png" | "image/*" => return Ok(Self::Png),
                "image/gif" => return Ok(Self::Gif),
                _ => {}
            }
        }
        Err(ApiError::NotAcceptable(format!(
            "a prediction is not available as {accept}; this server has application/json, application/msgpack, image/png and image/gif"
        )))
    }
}

impl<S: Send + Sync> FromRequestParts<S> for ResponseFormat {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, ApiError> {
        let accept = parts.headers.get(header::ACCEPT).map_or(Ok("*/*"), HeaderValue::to_str);
        Self::from_accept(accept.map_err(|_| ApiError::Malformed("the header Accept is not ASCII".to_owned()))?)
    }
}

impl From<JsonRejection> for ApiError {
    fn from(rejection: JsonRejection) -> Self {
        match rejection {
            JsonRejection::MissingJsonContentType(_) => Self::UnsupportedMedia(
                "the body must be JSON, and the header Content-Type must say application/json".to_owned(),
            ),
            // Without axum's words before it: what is wrong, with its field.
            JsonRejection::JsonDataError(error) => {
                Self::Unprocessable(error.source().map_or_else(|| error.body_text(), ToString::to_string))
            }
            JsonRejection::BytesRejection(error) => error.into(),
            JsonRejection::JsonSyntaxError(error) => {
                match error.source().and_then(|error| too_long_list(&error.to_string())) {
                    Some(detail) => Self::Unprocessable(detail),
                    None => Self::Malformed(error.body_text()),
                }
            }
            other => Self::Malformed(other.body_text()),
        }
    }
}

/// What is wrong if a list of fixed length goes on after its last entry: serde calls that a mistake of syntax within the field.
fn too_long_list(error: &str) -> Option<String> {
    let (field, _) = error.split_once(": trailing characters")?;
    Some(format!(
        "{field} has too many entries, or a comma or bracket is missing"
    ))
}

impl From<BytesRejection> for ApiError {
    fn from(rejection: BytesRejection) -> Self {
        too_long(rejection.status(), &rejection).unwrap_or_else(|| Self::Malformed(rejection.body_text()))
    }
}

/// The answer to a request whose body was not read because it, or all bodies together, are too long; `None` if that is not why.
pub(super) fn too_long(status: StatusCode, error: &(dyn Error + 'static)) -> Option<ApiError> {
    if status == StatusCode::PAYLOAD_TOO_LARGE {
        let detail = "the body is longer than this server takes".to_owned();
        return Some(ApiError::TooLarge(detail));
    }
    body_budget::cause(error).map(|exceeded| ApiError::unavailable(exceeded.to_string()))
}

impl From<PathRejection> for ApiError {
    fn from(rejection: PathRejection) -> Self {
        if let PathRejection::FailedToDeserializePathParams(error) = &rejection
            && let ErrorKind::ParseErrorAtIndex { value, .. } | ErrorKind::ParseErrorAtKey { value, .. } = error.kind()
        {
            return Self::Malformed(format!("\"{value}\" in the path is not a whole number, or too large"));
        }
        Self::Malformed(rejection.body_text())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_supported_media_type_is_chosen() {
        assert_eq!(
            ResponseFormat::from_accept("text/html, image/gif;q=0.8, */*"),
            Ok(ResponseFormat::Gif)
        );
        assert_eq!(ResponseFormat::from_accept("*/*"), Ok(ResponseFormat::Json));
        assert!(ResponseFormat::from_accept("text/html").is_err());
    }
}
