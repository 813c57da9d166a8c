//! Bodies with images: JSON with base64, or a form with image files.

use axum::extract::{FromRequest, Multipart, Request};
use axum::http::header;
use serde::de::DeserializeOwned;

use super::App;
use super::error::ApiError;
use super::extract::Json;
use super::images::ImageBytes;
use super::predict::check_count;

/// A request that holds images.
pub(super) trait WithFrames {
    fn frames(&mut self) -> &mut Vec<ImageBytes>;
}

/// A JSON body, or a form (`multipart/form-data`): a part `request`, which is the JSON body, and a part `frames` for each
/// image, in order. Refused unread where there is no place for its prediction.
pub(super) struct JsonOrForm<T>(pub(super) T);

impl<T: DeserializeOwned + WithFrames> FromRequest<App> for JsonOrForm<T> {
    type Rejection = ApiError;

    async fn from_request(request: Request, app: &App) -> Result<Self, ApiError> {
        let request = app.admission().pass(request).await?;
        let media_type = request
            .headers()
            .get(header::CONTENT_TYPE)
            .map_or(&[][..], |value| value.as_bytes());
        if !media_type.starts_with(b"multipart/form-data") {
            let Json(body) = Json::from_request(request, app).await?;
            return Ok(Self(body));
        }
        let form = Multipart::from_request(request, app).await;
        let mut form = form.map_err(|rejection| ApiError::Malformed(rejection.body_text()))?;
        let (mut json, mut frames) = (None, Vec::new());
        while let Some(part) = form.next_field().await? {
            match part.name() {
                Some("frames") => {
                    check_count("frames", frames.len() + 1, app.config().max_frames)?;
                    frames.push(ImageBytes(part.bytes().await?.into()));
                }
                Some("request") => json = Some(part.bytes().await?),
                name => {
                    let name = name.unwrap_or_default();
                    return Err(ApiError::Unprocessable(format!(
                        "the form has a part \"{name}\"; there are frames and request"
                    )));
                }
            }
        }
        let mut body: T = serde_json::from_slice(json.as_deref().unwrap_or(b"{}"))
            .map_err(|error| ApiError::Unprocessable(format!("request: {error}")))?;
        body.frames().extend(frames);
        Ok(Self(body))
    }
}
