//! Request bodies with images: JSON with base64, `MessagePack`, or a form with image files.

use std::sync::Arc;

use axum::extract::multipart::MultipartError;
use axum::extract::{FromRef, FromRequest, Multipart, Request};
use axum::http::header;
use serde::de::DeserializeOwned;

use super::admission::Admission;
use super::extract::too_long;
use super::problem::ApiError;
use super::structured::JsonOrMsgpack;
use crate::server::config::ServerConfig;

/// A list that is too long.
#[derive(Debug, thiserror::Error)]
#[error("{field} holds {found}; this server takes at most {limit} in a request")]
pub(in crate::server) struct TooManyError {
    field: &'static str,
    found: usize,
    limit: usize,
}

impl From<TooManyError> for ApiError {
    fn from(error: TooManyError) -> Self {
        Self::TooLarge(error.to_string())
    }
}

/// Errors: the list in `field` has more entries than the limit.
pub(in crate::server) fn check_count(field: &'static str, found: usize, limit: usize) -> Result<(), TooManyError> {
    if found <= limit {
        return Ok(());
    }
    Err(TooManyError { field, found, limit })
}

/// A request body that holds images.
pub(in crate::server) trait WithFrames {
    /// Adds the file of an image.
    fn push_frame(&mut self, file: Vec<u8>);
}

/// A body of JSON or `MessagePack`, or a form (`multipart/form-data`): a part `request`, which is the body as JSON, and a part
/// `frames` for each image, in order. Refused before it is read if there is no place for its prediction.
pub(in crate::server) struct BodyOrForm<T>(pub(in crate::server) T);

impl<T, S> FromRequest<S> for BodyOrForm<T>
where
    T: DeserializeOwned + WithFrames,
    S: Send + Sync,
    Admission: FromRef<S>,
    Arc<ServerConfig>: FromRef<S>,
{
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self, ApiError> {
        let request = Admission::from_ref(state).check(request).await?;
        let media_type = request.headers().get(header::CONTENT_TYPE);
        if !media_type.is_some_and(|media_type| media_type.as_bytes().starts_with(b"multipart/form-data")) {
            let JsonOrMsgpack(body) = JsonOrMsgpack::from_request(request, state).await?;
            return Ok(Self(body));
        }
        let max_frames = Arc::<ServerConfig>::from_ref(state).max_frames;
        let form = Multipart::from_request(request, state).await;
        let mut form = form.map_err(|rejection| ApiError::Malformed(rejection.body_text()))?;
        let (mut json, mut frames) = (None, Vec::new());
        while let Some(part) = form.next_field().await? {
            match part.name() {
                Some("frames") => {
                    check_count("frames", frames.len() + 1, max_frames)?;
                    frames.push(part.bytes().await?.into());
                }
                Some("request") => json = Some(part.bytes().await?),
                name => {
                    return Err(ApiError::Unprocessable(format!(
                        "the form has a part \"{}\"; there are frames and request",
                        name.unwrap_or("")
                    )));
                }
            }
        }
        let mut body: T = serde_json::from_slice(json.as_deref().unwrap_or(b"{}"))
            .map_err(|error| ApiError::Unprocessable(format!("request: {error}")))?;
        for frame in frames {
            body.push_frame(frame);
        }
        Ok(Self(body))
    }
}

impl From<MultipartError> for ApiError {
    fn from(error: MultipartError) -> Self {
        let malformed = || Self::Malformed(format!("the body is not a multipart form: {}", error.body_text()));
        too_long(error.status(), &error).unwrap_or_else(malformed)
    }
}
