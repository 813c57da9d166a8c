//! One prediction from one request.

use std::sync::Arc;

use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::error::{ApiError, Problem};
use super::extract::{Path, ResponseFormat};
use super::images::{self, ImageBytes, ImageError, ImageFormat};
use super::multipart::{JsonOrForm, WithFrames};
use super::picture;
use super::protocol::Timing;
use super::{App, blocking};
use crate::evaluation::figures::montage::prediction_sheet;
use crate::frame::{Frame, FrameError};
use crate::registry::Manifest;
use crate::serving::{InputError, Prediction, PredictionInput, ServingError};
use crate::types::{Action, RobotState, ValueError};

/// What a prediction starts from.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct PredictRequest {
    /// The context's images, oldest first; in a form, its parts `frames`.
    #[serde(default)]
    frames: Vec<ImageBytes>,
    /// How the images are encoded, and those of the answer shall be (`png` for `jpeg`).
    #[serde(default)]
    format: ImageFormat,
    /// What acted at each frame, oldest first; the last one is held where there are no `future_actions`.
    #[serde(default)]
    actions: Vec<Vec<f32>>,
    /// What the robot says of itself at the last frame.
    #[serde(default)]
    state: Option<Vec<f32>>,
    /// What the robot said of itself at each frame, in place of `state`.
    #[serde(default)]
    states: Option<Vec<Vec<f32>>>,
    /// The actions to predict under, as many as the model's horizon; the first acts from the last frame on.
    #[serde(default)]
    future_actions: Option<Vec<Vec<f32>>>,
}

/// The same as a form.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the form; `Upload` reads it")]
struct PredictForm {
    /// The context's image files, oldest first.
    #[schema(value_type = Vec<String>, format = Binary)]
    frames: Vec<ImageBytes>,
    /// The rest, as JSON.
    request: Option<PredictRequest>,
}

/// The frames to come.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct PredictResponse {
    /// The model's name.
    model: String,
    /// The model's version.
    version: u32,
    /// t+1, t+2, ….
    frames: Vec<ImageBytes>,
    /// How they are encoded.
    format: ImageFormat,
    /// How long it took.
    timing: Timing,
}

/// Why a request for a prediction was refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum PredictError {
    #[error("{field} holds {found}; this server takes at most {limit} in a request")]
    TooMany {
        field: &'static str,
        found: usize,
        limit: usize,
    },
    #[error("the futures would be {found} bytes of images; this server predicts at most {limit} for a request")]
    TooLarge { found: u64, limit: usize },
    #[error("candidates is empty; give at least one sequence of future actions")]
    NoCandidates,
    #[error("the session has {have} frames of the {need} that a prediction takes; send it more")]
    Buffering { have: usize, need: usize },
    #[error("{field}: {source}")]
    Value { field: String, source: ValueError },
    #[error("state and states are both given; give one")]
    BothStates,
    #[error("states holds {found} states; there are {frames} frames, and each has one")]
    StateCount { found: usize, frames: usize },
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error(transparent)]
    Input(#[from] InputError),
    #[error(transparent)]
    Serving(#[from] ServingError),
    #[error("the picture could not be made")]
    Picture(#[source] FrameError),
}

impl WithFrames for PredictRequest {
    fn frames(&mut self) -> &mut Vec<ImageBytes> {
        &mut self.frames
    }
}

/// Predicts the frames that follow a context, given as JSON or as a form (`multipart/form-data`) of image files `frames`
/// and the rest as JSON in a part `request`. `Accept: image/png` gives a labelled contact sheet of frames and predictions,
/// `image/gif` an animation.
#[utoipa::path(
    post, path = "/v1/models/{model}/predict", tag = "models",
    params(("model" = String, Path, description = "The model's name")),
    request_body(content((PredictRequest = "application/json"), (PredictForm = "multipart/form-data"))),
    responses(
        (status = 200, description = "The prediction", content(
            (PredictResponse = "application/json"), (Vec<u8> = "image/png"), (Vec<u8> = "image/gif"),
        )),
        (status = 400, description = "Not JSON", body = Problem),
        (status = 406, description = "None of the media types in `Accept` can be had", body = Problem),
        (status = 404, description = "No such model", body = Problem),
        (status = 413, description = "A body or a list over the limit", body = Problem),
        (status = 415, description = "Declared neither as JSON nor as a form", body = Problem),
        (status = 422, description = "Does not fit the model", body = Problem),
        (status = 503, description = "Too many predictions wait", body = Problem),
    )
)]
pub(super) async fn predict(
    State(app): State<App>,
    Path(model): Path<String>,
    wanted: ResponseFormat,
    JsonOrForm(request): JsonOrForm<PredictRequest>,
) -> Result<Response, ApiError> {
    let model = app.predictor().active(&model)?;
    let _place = app.admission().enter()?;
    let (manifest, format) = (Arc::clone(&model.manifest), request.format);
    let max_frames = app.config().max_frames;
    let input = blocking(move || request.into_input(&manifest, max_frames)).await??;
    let seen = input.frames.clone();
    let prediction = app.predictor().predict_by(&model, input).await?;
    let period_s = model.manifest.spec.frame_period_s;
    blocking(move || answer(wanted, format, &seen, prediction, period_s)).await?
}

impl PredictRequest {
    fn into_input(self, manifest: &Manifest, max_frames: usize) -> Result<PredictionInput, PredictError> {
        let frames = decode_frames(self.frames, self.format, manifest, max_frames)?;
        Ok(PredictionInput {
            state: last_state(self.state, self.states, frames.len())?,
            actions: actions("actions", self.actions)?,
            future_actions: self
                .future_actions
                .map(|values| actions("future_actions", values))
                .transpose()?,
            frames,
        })
    }
}

/// The images of `frames` in a request.
pub(super) fn decode_frames(
    frames: Vec<ImageBytes>,
    format: ImageFormat,
    manifest: &Manifest,
    limit: usize,
) -> Result<Vec<Frame>, PredictError> {
    check_count("frames", frames.len(), limit)?;
    let frame = |(index, image)| images::decode(&format!("frames[{index}]"), image, format, manifest);
    Ok(frames
        .into_iter()
        .enumerate()
        .map(frame)
        .collect::<Result<_, ImageError>>()?)
}

/// The state at the last frame, from either field of a request.
pub(super) fn last_state(
    state: Option<Vec<f32>>,
    states: Option<Vec<Vec<f32>>>,
    frames: usize,
) -> Result<Option<RobotState>, PredictError> {
    if let Some(states) = states.as_ref().filter(|states| states.len() != frames) {
        return Err(PredictError::StateCount {
            found: states.len(),
            frames,
        });
    }
    let state = match (state, states) {
        (Some(_), Some(_)) => return Err(PredictError::BothStates),
        (state, None) => state,
        (None, Some(states)) => states.into_iter().next_back(),
    };
    state
        .map(RobotState::try_from)
        .transpose()
        .map_err(|source| PredictError::Value {
            field: "state".to_owned(),
            source,
        })
}

pub(super) fn actions(field: &str, values: Vec<Vec<f32>>) -> Result<Vec<Action>, PredictError> {
    let action = |(index, values)| {
        Action::try_from(values).map_err(|source| PredictError::Value {
            field: format!("{field}[{index}]"),
            source,
        })
    };
    values.into_iter().enumerate().map(action).collect()
}

pub(super) fn check_count(field: &'static str, found: usize, limit: usize) -> Result<(), PredictError> {
    if found <= limit {
        return Ok(());
    }
    Err(PredictError::TooMany { field, found, limit })
}

fn answer(
    wanted: ResponseFormat,
    format: ImageFormat,
    seen: &[Frame],
    prediction: Prediction,
    period_s: f64,
) -> Result<Response, ApiError> {
    let predicted = &prediction.frames;
    match wanted {
        ResponseFormat::Png => picture::png(prediction_sheet(seen, predicted, &[])),
        ResponseFormat::Gif => picture::gif(picture::animation(seen, predicted, period_s)),
        ResponseFormat::Json => {
            let format = format.answer();
            Ok(axum::Json(PredictResponse {
                model: prediction.model,
                version: prediction.version,
                frames: images::encode(predicted, format)?,
                format,
                timing: Timing {
                    queue_us: prediction.queue_us,
                    compute_us: prediction.compute_us,
                },
            })
            .into_response())
        }
    }
}
