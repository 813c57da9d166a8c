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

use super::body_budget::{self, BodyBudgetError};
use super::problem::ApiError;

/// The media type of `MessagePack`.
pub(super) const MSGPACK: &str = "application/msgpack";

/// What is wrong with a body that is not read to its end.
const TOO_LONG: &str =
    "the body is longer than this server takes (settings max_body_bytes and, for jobs, max_job_bytes)";

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
    /// All, with their media types; among those that a client likes equally, the first one is chosen.
    const ALL: [(Self, &str); 4] = [
        (Self::Json, "application/json"),
        (Self::Msgpack, MSGPACK),
        (Self::Png, "image/png"),
        (Self::Gif, "image/gif"),
    ];

    /// The format with the highest quality in an `Accept` header, of several the one that is named first; JSON if the header is empty.
    fn from_accept(accept: &str) -> Result<Self, ApiError> {
        let ranges: Vec<MediaRange> = accept
            .split(',')
            .enumerate()
            .filter_map(|(place, text)| MediaRange::parse(place, text))
            .collect();
        if ranges.is_empty() {
            return Ok(Self::Json);
        }
        let acceptable = Self::ALL.iter().filter_map(|(format, media_type)| {
            // The most specific range counts: `image/gif;q=0, */*` is anything but GIF.
            let fitting = ranges.iter().filter(|range| range.holds(media_type));
            let range = fitting.min_by_key(|range| range.wildcards())?;
            (range.quality > 0.0).then_some((*format, range))
        });
        let best = acceptable.min_by(|(_, one), (_, other)| {
            let by_quality = other.quality.total_cmp(&one.quality);
            by_quality.then(one.place.cmp(&other.place))
        });
        best.map(|(format, _)| format).ok_or_else(|| {
            ApiError::NotAcceptable(format!(
                "a prediction is not available as {accept}; this server has application/json, application/msgpack, image/png and image/gif"
            ))
        })
    }
}

/// Media types of an `Accept` header (RFC 9110), as `image/*;q=0.5`.
struct MediaRange<'a> {
    /// Its place in the header.
    place: usize,
    kind: &'a str,
    subtype: &'a str,
    /// From 0, not acceptable, to 1.
    quality: f32,
}

impl<'a> MediaRange<'a> {
    fn parse(place: usize, text: &'a str) -> Option<Self> {
        let mut parts = text.split(';').map(str::trim);
        let (kind, subtype) = parts.next()?.split_once('/')?;
        let quality = parts.find_map(|parameter| {
            let (name, value) = parameter.split_once('=')?;
            name.eq_ignore_ascii_case("q").then(|| value.parse().ok())?
        });
        Some(Self {
            place,
            kind,
            subtype,
            quality: quality.filter(|quality| (0.0..=1.0).contains(quality)).unwrap_or(1.0),
        })
    }

    fn holds(&self, media_type: &str) -> bool {
        let is = |range: &str, part: &str| range == "*" || range.eq_ignore_ascii_case(part);
        let parts = media_type.split_once('/');
        parts.is_some_and(|(kind, subtype)| is(self.kind, kind) && is(self.subtype, subtype))
    }

    /// The fewer, the more specific.
    fn wildcards(&self) -> usize {
        [self.kind, self.subtype].iter().filter(|part| **part == "*").count()
    }
}

impl<S: Send + Sync> FromRequestParts<S> for ResponseFormat {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, ApiError> {
        let accept: Result<Vec<&str>, _> = parts
            .headers
            .get_all(header::ACCEPT)
            .iter()
            .map(HeaderValue::to_str)
            .collect();
        let accept = accept.map_err(|_| ApiError::Malformed("the header Accept is not ASCII".to_owned()))?;
        Self::from_accept(&accept.join(", "))
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
        return Some(ApiError::TooLarge(TOO_LONG.to_owned()));
    }
    body_budget::cause(error).map(|exceeded| match exceeded {
        BodyBudgetError::TooLong { .. } => ApiError::TooLarge(TOO_LONG.to_owned()),
        BodyBudgetError::Full { .. } => ApiError::unavailable(exceeded.to_string()),
    })
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
    fn the_media_type_that_the_client_likes_most_is_chosen() {
        for (accept, expected) in [
            ("", ResponseFormat::Json),
            ("*/*", ResponseFormat::Json),
            ("text/html, image/gif, */*", ResponseFormat::Gif),
            ("text/html, image/gif;q=0.8, */*", ResponseFormat::Json),
            ("text/html, image/gif;q=0.8, */*;q=0.1", ResponseFormat::Gif),
            ("image/gif;q=0, application/json", ResponseFormat::Json),
            ("application/json;q=0.1, image/png;q=0.9", ResponseFormat::Png),
            ("application/json;q=0, application/*", ResponseFormat::Msgpack),
            ("image/png;Q=0, image/*", ResponseFormat::Gif),
            ("IMAGE/PNG", ResponseFormat::Png),
            (
                "application/json;charset=utf-8;q=0.2, Application/MsgPack;q=0.3",
                ResponseFormat::Msgpack,
            ),
            ("image/png, image/gif", ResponseFormat::Png),
            ("image/gif, image/png", ResponseFormat::Gif),
        ] {
            assert_eq!(ResponseFormat::from_accept(accept), Ok(expected), "{accept}");
        }
        for accept in ["text/html", "image/png;q=0", "*/*;q=0.0"] {
            assert!(ResponseFormat::from_accept(accept).is_err(), "{accept}");
        }
    }
}
