//! What handlers take from a request, refused in the one shape that errors have.

use std::marker::PhantomData;

use axum::extract::{FromRequest, FromRequestParts, Request};
use axum::http::header;
use axum::http::request::Parts;
use serde::de::value::MapAccessDeserializer;
use serde::de::{DeserializeOwned, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::error::ApiError;

/// A JSON body: an object. A list of its values in the order of its fields, which serde would take as well, is none.
pub(super) struct Json<T>(pub(super) T);

struct Object<T>(T);

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
pub(super) struct Path<T>(pub(super) T);

impl<T: DeserializeOwned + Send, S: Send + Sync> FromRequestParts<S> for Path<T> {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let axum::extract::Path(value) = axum::extract::Path::from_request_parts(parts, state).await?;
        Ok(Self(value))
    }
}

/// The query's parameters.
pub(super) struct Query<T>(pub(super) T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequestParts<S> for Query<T> {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let axum::extract::Query(value) = axum::extract::Query::from_request_parts(parts, state)
            .await
            .map_err(|rejection| ApiError::Unprocessable(rejection.body_text()))?;
        Ok(Self(value))
    }
}

/// In which form the client wants a prediction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ResponseFormat {
    Json,
    Png,
    Gif,
}

impl ResponseFormat {
    /// The first form named in an `Accept` header that can be had; JSON where there is none.
    fn from_accept(accept: &str) -> Result<Self, ApiError> {
        let named = accept
            .split(',')
            .map(|part| part.split(';').next().unwrap_or("").trim());
        for media_type in named {
            match media_type {
                "application/json" | "application/*" | "*/*" | "" => return Ok(Self::Json),
                "image/png" | "image/*" => return Ok(Self::Png),
                "image/gif" => return Ok(Self::Gif),
                _ => {}
            }
        }
        Err(ApiError::NotAcceptable(format!(
            "no prediction can be had as {accept}; there are application/json, image/png and image/gif"
        )))
    }
}

impl<S: Send + Sync> FromRequestParts<S> for ResponseFormat {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, ApiError> {
        let accept = parts.headers.get(header::ACCEPT).map_or(Ok("*/*"), |accept| {
            accept
                .to_str()
                .map_err(|_| ApiError::Malformed("the header Accept is not ASCII".to_owned()))
        })?;
        Self::from_accept(accept)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_form_named_that_there_is_is_taken() {
        assert_eq!(
            ResponseFormat::from_accept("text/html, image/gif;q=0.8, */*"),
            Ok(ResponseFormat::Gif)
        );
        assert_eq!(ResponseFormat::from_accept("*/*"), Ok(ResponseFormat::Json));
        assert!(ResponseFormat::from_accept("text/html").is_err());
    }
}
