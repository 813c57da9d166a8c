//! One prediction for one request.

use std::sync::Arc;

use axum::response::Response;
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::picture;
use crate::server::config::ServerConfig;
use crate::server::http::extract::{Path, ResponseFormat};
use crate::server::http::multipart::{BodyOrForm, WithFrames};
use crate::server::http::problem::ApiError;
use crate::server::http::structured::structured;
use crate::server::images::{self, ImageBytes, ImageFormat, ImageInput};
use crate::server::request_inputs;
use crate::server::state::App;
use foreframe_core::frame::Frame;
use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::registry::Manifest;
use foreframe_core::serving::{InputError, Prediction, PredictionInput, ServingError, Task, Timing};
use foreframe_train::evaluation::figures::montage::prediction_sheet;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(predict))
}

/// The context and the conditioning input of a prediction.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct PredictRequest {
    /// The images of the context, oldest first; in a form, its parts `frames`.
    #[serde(default)]
    frames: Vec<ImageBytes>,
    /// How the images are encoded, here and in the answer (`jpeg` is answered with `png`).
    #[serde(default)]
    format: ImageFormat,
    /// How an image of another size is resized; without it, another size is an error.
    resize: Option<Resize>,
    /// The action at each frame, oldest first. Without `plan`, the last one is repeated.
    #[serde(default)]
    actions: Vec<Vec<f32>>,
    /// The robot's state at the last frame.
    state: Option<Vec<f32>>,
    /// The robot's state at each frame, instead of `state`.
    states: Option<Vec<Vec<f32>>>,
    /// The camera that took the images, for a model that estimates depth. Default: the model's.
    camera: Option<CameraModel>,
    /// The future actions, as many as `steps`. The first acts from the last frame on.
    plan: Option<Vec<Vec<f32>>>,
    /// How many frames to predict. Default: the model's horizon. More are beyond what the model was trained for.
    #[schema(minimum = 1, maximum = 256)]
    steps: Option<usize>,
    /// The units of actions and state as the client has them: other units than the model's are an error.
    units: Option<Units>,
}

/// The same request as a form.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the form; `BodyOrForm` reads it")]
struct PredictForm {
    /// The image files of the context, oldest first.
    #[schema(value_type = Vec<String>, format = Binary)]
    frames: Vec<ImageBytes>,
    /// The other fields, as JSON.
    request: Option<PredictRequest>,
}

/// The predicted frames.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct PredictResponse {
    /// The model's name.
    model: String,
    /// The model's version.
    version: u32,
    /// t+1, t+2, ….
    frames: Vec<ImageBytes>,
    /// How they are encoded.
    format: ImageFormat,
    /// The mean squared error to expect of each frame up to the model's horizon, intensities 0…1; absent if the model is not
    /// calibrated.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    expected_mse: Vec<f32>,
    /// The 90 % band of each of these errors: 5 % of the errors are below it, 5 % above; absent if the model is not calibrated.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    mse_band_90: Vec<[f32; 2]>,
    /// How unlike the training data frames, state and actions are, 0…1: the share of validation contexts that are nearer to it;
    /// absent if the model is not calibrated.
    #[serde(skip_serializing_if = "Option::is_none")]
    novelty: Option<f32>,
    /// For each frame, whether it is beyond what the model was trained for; absent if none is.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    beyond_training: Vec<bool>,
    /// Actions and states out of the range of the training; absent if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    warnings: Vec<String>,
    /// How long it took.
    timing: Timing,
}

impl WithFrames for PredictRequest {
    fn push_frame(&mut self, file: Vec<u8>) {
        self.frames.push(ImageBytes(file));
    }
}

/// Predicts the frames that follow a context. The body is JSON, `MessagePack` with the same fields and binary images, or a form
/// (`multipart/form-data`) with image files `frames` and the other fields as JSON in a part `request`.
/// `Accept: application/msgpack` gives binary images, `Accept: image/png` gives a labelled contact sheet of the
/// context and the prediction, `image/gif` an animation.
#[utoipa::path(
    post, path = "/v1/models/{model}/predict",
    request_body(content((PredictRequest = "application/json"), (PredictRequest = "application/msgpack"), (PredictForm = "multipart/form-data"))),
    responses(
        (status = 200, description = "The prediction", content(
            (PredictResponse = "application/json"), (PredictResponse = "application/msgpack"), (Vec<u8> = "image/png"), (Vec<u8> = "image/gif"),
        )),
        (status = 400, description = "Not what its Content-Type says"),
        (status = 406, description = "No media type in `Accept` is supported"),
        (status = 413, description = "A body or a list exceeds its limit"),
        (status = 415, description = "Content-Type is neither JSON, MessagePack nor a form"),
        (status = 422, description = "Does not fit the model"),
        (status = 503, description = "Too many predictions wait"),
    )
)]
async fn predict(
    app: App,
    Path(model): Path<String>,
    wanted: ResponseFormat,
    BodyOrForm(request): BodyOrForm<PredictRequest>,
) -> Result<Response, ApiError> {
    let model = app.predictor().active(&model)?;
    let _place = app.admission.enter()?;
    let (manifest, format, config) = (Arc::clone(&model.manifest), request.format, Arc::clone(&app.config));
    let decode = move || request.into_task(wanted, &manifest, &config);
    let (seen, task) = app.predictions.run(decode).await??;
    let prediction = app.predictor().compute(&model, task, None).await?;
    let encode = move || answer(wanted, format, &seen, prediction);
    picture::threads_for(&app, wanted).run(encode).await?
}

impl PredictRequest {
    /// The task, and the context if the answer shows it.
    fn into_task(
        self,
        wanted: ResponseFormat,
        manifest: &Manifest,
        config: &ServerConfig,
    ) -> Result<(Vec<Frame>, Task), ApiError> {
        let (format, resize) = (self.format, self.resize);
        request_inputs::check_steps(self.steps, manifest, config)?;
        self.units.as_ref().map_or(Ok(()), |units| units.check(manifest))?;
        let frames =
            request_inputs::decode_frames(self.frames, ImageInput { format, resize }, manifest, config.max_frames)?;
        let seen = picture::context_for(wanted, &frames);
        let (past_states, state) = request_inputs::states(self.state, self.states, frames.len())?;
        let input = PredictionInput {
            state,
            past_states,
            camera: self.camera,
            actions: request_inputs::actions("actions", self.actions)?,
            plan: self
                .plan
                .map(|values| request_inputs::actions("plan", values))
                .transpose()?,
            steps: self.steps,
            frames,
        };
        Ok((seen, input.into_task(manifest)?))
    }
}

/// Units of actions and state, in the model's order.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct Units {
    /// The unit of each component of an action.
    actions: Option<Vec<String>>,
    /// The unit of each component of a state.
    state: Option<Vec<String>>,
}

impl Units {
    /// Errors: `Unprocessable` where they differ from the model's.
    pub(super) fn check(&self, manifest: &Manifest) -> Result<(), ApiError> {
        let spec = &manifest.spec;
        let given = [
            ("actions", &self.actions, &spec.actions),
            ("state", &self.state, &spec.states),
        ];
        for (field, found, channels) in given {
            let expected: Vec<&str> = channels.iter().map(|channel| channel.unit.as_str()).collect();
            if let Some(found) = found.as_ref().filter(|found| **found != expected) {
                return Err(ApiError::Unprocessable(format!(
                    "units.{field} is [{}]; model \"{}\" takes [{}]",
                    found.join(", "),
                    manifest.name,
                    expected.join(", ")
                )));
            }
        }
        Ok(())
    }
}

impl From<ServingError> for ApiError {
    fn from(error: ServingError) -> Self {
        match error {
            ServingError::QueueFull { retry_after_s, .. } => Self::Unavailable {
                detail: error.to_string(),
                retry_after_s,
            },
            _ => Self::of(&error),
        }
    }
}

impl From<InputError> for ApiError {
    fn from(error: InputError) -> Self {
        Self::Unprocessable(error.to_string())
    }
}

fn answer(
    wanted: ResponseFormat,
    format: ImageFormat,
    seen: &[Frame],
    mut prediction: Prediction,
) -> Result<Response, ApiError> {
    let beyond_training = prediction.beyond_training();
    let rollout = prediction.rollouts.pop().unwrap_or_default();
    let manifest = prediction.manifest;
    match wanted {
        ResponseFormat::Png => picture::png(prediction_sheet(seen, &rollout.frames, &[])),
        ResponseFormat::Gif => {
            let period_s = manifest.spec.frame_period_s;
            picture::gif(picture::animation(seen, &rollout.frames, period_s))
        }
        ResponseFormat::Json | ResponseFormat::Msgpack => {
            let format = format.answer();
            let body = PredictResponse {
                model: manifest.name.to_string(),
                version: manifest.version,
                expected_mse: rollout.expected_mse(),
                mse_band_90: rollout.mse_bands(),
                novelty: rollout.novelty,
                frames: images::encode_owned(rollout.frames, format)?,
                format,
                beyond_training,
                warnings: prediction.warnings,
                timing: prediction.timing,
            };
            Ok(structured(wanted, &body))
        }
    }
}
