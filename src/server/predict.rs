//! One prediction from one request.

use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::error::{ApiError, Problem};
use super::extract::{Json, Path, Wanted};
use super::images::{self, ImageError, ImageFormat};
use super::picture;
use super::protocol::Timing;
use super::{App, blocking};
use crate::evaluation::figures::montage::prediction_sheet;
use crate::frame::{Frame, FrameError, codec};
use crate::registry::Manifest;
use crate::serving::{Prediction, PredictionInput, ServingError};
use crate::types::{Action, RobotState, ValueError};

/// What a prediction starts from.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct PredictRequest {
    /// The context's images, oldest first, base64.
    frames: Vec<String>,
    /// How the images are encoded, and those of the answer shall be.
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

/// The frames to come.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct PredictResponse {
    /// The model's name.
    model: String,
    /// The model's version.
    version: u32,
    /// t+1, t+2, …: base64.
    frames: Vec<String>,
    /// How they are encoded.
    format: ImageFormat,
    /// How long it took.
    timing: Timing,
}

/// Why a request for a prediction was refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum PredictError {
    #[error("frames holds {found} images; this server takes at most {limit} in a request")]
    TooManyFrames { found: usize, limit: usize },
    #[error("{field}: {source}")]
    Value { field: String, source: ValueError },
    #[error("state and states are both given; give one")]
    BothStates,
    #[error("states holds {found} states; there are {frames} frames, and each has one")]
    StateCount { found: usize, frames: usize },
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error(transparent)]
    Serving(#[from] ServingError),
    #[error("the picture could not be made")]
    Picture(#[source] FrameError),
}

/// Predicts the frames that follow a context. `Accept: image/png` gives a labelled contact sheet of frames and
/// predictions, `image/gif` an animation.
#[utoipa::path(
    post, path = "/v1/models/{model}/predict", tag = "models",
    params(("model" = String, Path, description = "The model's name")),
    request_body = PredictRequest,
    responses(
        (status = 200, description = "The prediction", content(
            (PredictResponse = "application/json"), (Vec<u8> = "image/png"), (Vec<u8> = "image/gif"),
        )),
        (status = 400, description = "Not JSON", body = Problem),
        (status = 404, description = "No such model", body = Problem),
        (status = 413, description = "A body or a list over the limit", body = Problem),
        (status = 415, description = "Not declared as JSON", body = Problem),
        (status = 422, description = "Does not fit the model", body = Problem),
        (status = 503, description = "Too many predictions wait", body = Problem),
    )
)]
pub(super) async fn predict(
    State(app): State<App>,
    Path(model): Path<String>,
    wanted: Wanted,
    Json(request): Json<PredictRequest>,
) -> Result<Response, ApiError> {
    let manifest = app.predictor().model(&model)?;
    let (max_frames, format) = (app.config().max_frames, request.format);
    let input = blocking(move || request.into_input(&manifest, max_frames)).await??;
    let seen = input.frames.clone();
    let prediction = app.predictor().predict(&model, input).await?;
    let manifest = app.predictor().model(&model)?;
    let period_s = manifest.spec.frame_period_s;
    blocking(move || answer(wanted, format, &seen, prediction, period_s)).await?
}

impl PredictRequest {
    fn into_input(self, manifest: &Manifest, max_frames: usize) -> Result<PredictionInput, PredictError> {
        if self.frames.len() > max_frames {
            return Err(PredictError::TooManyFrames {
                found: self.frames.len(),
                limit: max_frames,
            });
        }
        let frame =
            |(index, text): (usize, &String)| images::decode(&format!("frames[{index}]"), text, self.format, manifest);
        let frames: Vec<Frame> = self.frames.iter().enumerate().map(frame).collect::<Result<_, _>>()?;
        if let Some(states) = self.states.as_ref().filter(|states| states.len() != frames.len()) {
            return Err(PredictError::StateCount {
                found: states.len(),
                frames: frames.len(),
            });
        }
        let state = match (self.state, self.states) {
            (Some(_), Some(_)) => return Err(PredictError::BothStates),
            (state, None) => state,
            (None, Some(states)) => states.into_iter().next_back(),
        };
        let state = state.map(RobotState::try_from).transpose();
        Ok(PredictionInput {
            frames,
            actions: actions("actions", self.actions)?,
            state: state.map_err(|source| PredictError::Value {
                field: "state".to_owned(),
                source,
            })?,
            future_actions: self
                .future_actions
                .map(|values| actions("future_actions", values))
                .transpose()?,
        })
    }
}

fn actions(field: &str, values: Vec<Vec<f32>>) -> Result<Vec<Action>, PredictError> {
    let action = |(index, values)| {
        Action::try_from(values).map_err(|source| PredictError::Value {
            field: format!("{field}[{index}]"),
            source,
        })
    };
    values.into_iter().enumerate().map(action).collect()
}

fn answer(
    wanted: Wanted,
    format: ImageFormat,
    seen: &[Frame],
    prediction: Prediction,
    period_s: f64,
) -> Result<Response, ApiError> {
    let picture = |result: Result<Vec<u8>, FrameError>, media_type: &'static str| {
        let bytes = result.map_err(PredictError::Picture)?;
        Ok(([(header::CONTENT_TYPE, media_type)], bytes).into_response())
    };
    let predicted = &prediction.frames;
    match wanted {
        Wanted::Png => picture(
            prediction_sheet(seen, predicted, &[]).and_then(|sheet| codec::encode_png(&sheet)),
            "image/png",
        ),
        Wanted::Gif => picture(picture::animation(seen, predicted, period_s), "image/gif"),
        Wanted::Json => {
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
