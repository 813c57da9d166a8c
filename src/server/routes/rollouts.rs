//! Rollouts: the frames predicted from one context, for each of many plans.

use std::sync::Arc;

use axum::response::Response;
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::picture;
use super::sessions::AuthorizedSession;
use crate::server::config::ServerConfig;
use crate::server::http::extract::{Path, ResponseFormat};
use crate::server::http::multipart::{BodyOrForm, WithFrames, check_count};
use crate::server::http::problem::ApiError;
use crate::server::http::structured::{JsonOrMsgpack, structured};
use crate::server::images::{self, ImageBytes, ImageFormat, ImageInput};
use crate::server::request_inputs;
use crate::server::state::App;
use foreframe_core::frame::Frame;
use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::registry::Manifest;
use foreframe_core::serving::{ConditioningInput, Prediction, Rollout, Task, Timing};
use foreframe_core::types::RobotState;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(model_rollouts))
        .routes(routes!(session_rollouts))
}

/// A context and the plans to compare.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct RolloutRequest {
    /// The images of the context, oldest first; in a form, its parts `frames`.
    #[serde(default)]
    frames: Vec<ImageBytes>,
    /// How the images are encoded, here and in the answer (`jpeg` is answered with `png`).
    #[serde(default)]
    format: ImageFormat,
    /// How an image of another size is resized; without it, another size is an error.
    resize: Option<Resize>,
    /// The robot's state at the last frame.
    state: Option<Vec<f32>>,
    /// The robot's state at each frame, instead of `state`.
    states: Option<Vec<Vec<f32>>>,
    /// The camera that took the images, for a model that estimates depth. Default: the model's.
    camera: Option<CameraModel>,
    /// Plans: sequences of future actions, each with `steps` actions. The first action acts from the last frame on.
    plans: Vec<Vec<Vec<f32>>>,
    /// How many frames to predict. Default: the model's horizon. More are beyond what the model was trained for.
    #[schema(minimum = 1, maximum = 256)]
    steps: Option<usize>,
}

/// Plans to compare from the last frame of a session.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct SessionRolloutRequest {
    /// How the images of the answer are encoded.
    #[serde(default)]
    format: ImageFormat,
    /// The robot's state. Default: its state at the session's last frame.
    state: Option<Vec<f32>>,
    /// Plans: sequences of future actions, each with `steps` actions. The first action acts from the last frame on.
    plans: Vec<Vec<Vec<f32>>>,
    /// How many frames to predict. Default: the model's horizon. More are beyond what the model was trained for.
    #[schema(minimum = 1, maximum = 256)]
    steps: Option<usize>,
}

/// The rollouts.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct RolloutResponse {
    /// The model's name.
    model: String,
    /// The model's version.
    version: u32,
    /// For each plan, in order: t+1, t+2, ….
    rollouts: Vec<Vec<ImageBytes>>,
    /// How they are encoded.
    format: ImageFormat,
    /// For each plan, the mean squared error to expect of each frame up to the model's horizon, intensities 0…1; in a session, it
    /// follows the session's own errors so far. Absent if the model is not calibrated.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    expected_mse: Vec<Vec<f32>>,
    /// The 90 % band of each of these errors; in a session, it follows the session's own errors too. Absent if the model is not
    /// calibrated.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    mse_band_90: Vec<Vec<[f32; 2]>>,
    /// How unlike the training data frames, state and the most usual plan are, 0…1; absent if the model is not calibrated.
    #[serde(skip_serializing_if = "Option::is_none")]
    novelty: Option<f32>,
    /// For each step, whether it is beyond what the model was trained for; absent if none is.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    beyond_training: Vec<bool>,
    /// Actions and states out of the range of the training; absent if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    warnings: Vec<String>,
    /// How long it took.
    timing: Timing,
}

impl WithFrames for RolloutRequest {
    fn push_frame(&mut self, file: Vec<u8>) {
        self.frames.push(ImageBytes(file));
    }
}

/// Predicts a rollout for each of many plans. `Accept: image/png` gives a contact sheet with a row for each,
/// `image/gif` an animation with all of them side by side.
#[utoipa::path(
    post, path = "/v1/models/{model}/rollouts", request_body(content((RolloutRequest = "application/json"), (RolloutRequest = "application/msgpack"))),
    responses(
        (status = 200, description = "The rollouts", content(
            (RolloutResponse = "application/json"), (RolloutResponse = "application/msgpack"), (Vec<u8> = "image/png"), (Vec<u8> = "image/gif"),
        )),
        (status = 400, description = "Not what its Content-Type says"),
        (status = 406, description = "Too many for a picture, or no media type in `Accept` is supported"),
        (status = 413, description = "A body, a list or an answer exceeds its limit"),
        (status = 422, description = "Does not fit the model"),
        (status = 503, description = "Too many predictions wait"),
    )
)]
async fn model_rollouts(
    app: App,
    Path(model): Path<String>,
    wanted: ResponseFormat,
    BodyOrForm(request): BodyOrForm<RolloutRequest>,
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

/// Predicts a rollout for each of many plans from the session's last frame. The session does not change.
#[utoipa::path(
    post, path = "/v1/sessions/{id}/rollouts",
    request_body(content((SessionRolloutRequest = "application/json"), (SessionRolloutRequest = "application/msgpack"))),
    params(("id" = String, Path), ("x-session-token" = Option<String>, Header)),
    responses(
        (status = 200, description = "The rollouts", content(
            (RolloutResponse = "application/json"), (RolloutResponse = "application/msgpack"), (Vec<u8> = "image/png"), (Vec<u8> = "image/gif"),
        )),
        (status = 409, description = "The session has not enough frames yet"),
        (status = 413, description = "A body, a list or an answer exceeds its limit"),
        (status = 422, description = "Does not fit the model"),
        (status = 503, description = "Too many predictions wait"),
    )
)]
async fn session_rollouts(
    app: App,
    AuthorizedSession(session): AuthorizedSession,
    wanted: ResponseFormat,
    JsonOrMsgpack(request): JsonOrMsgpack<SessionRolloutRequest>,
) -> Result<Response, ApiError> {
    let model = Arc::clone(&session.model);
    let (state, format) = (session.state().0, request.format);
    let (have, need) = (state.frame_count(), model.manifest.spec.context);
    if have < need {
        return Err(ApiError::Conflict(format!(
            "the session has {have} of the {need} frames that a prediction takes; send more frames"
        )));
    }
    let _place = app.admission.enter()?;
    let (manifest, config) = (Arc::clone(&model.manifest), Arc::clone(&app.config));
    let check = move || {
        let (_, given) = request_inputs::states(request.state, None, 0)?;
        let robot_state = given.or_else(|| state.robot_state().cloned());
        let inputs = conditioning(request.plans, request.steps, robot_state, &manifest, &config)?;
        Ok::<_, ApiError>(state.rollout_task(inputs, &manifest.spec))
    };
    let task = app.predictions.run(check).await??;
    let prediction = app.predictor().compute(&model, task, Some(session.key)).await?;
    let encode = move || answer(wanted, format, &[], prediction);
    picture::threads_for(&app, wanted).run(encode).await?
}

impl RolloutRequest {
    /// The task, and the context if the answer shows it.
    fn into_task(
        self,
        wanted: ResponseFormat,
        manifest: &Manifest,
        config: &ServerConfig,
    ) -> Result<(Vec<Frame>, Task), ApiError> {
        let (format, resize) = (self.format, self.resize);
        let frames =
            request_inputs::decode_frames(self.frames, ImageInput { format, resize }, manifest, config.max_frames)?;
        let (past_states, state) = request_inputs::states(self.state, self.states, frames.len())?;
        let conditioning = conditioning(self.plans, self.steps, state, manifest, config)?;
        let seen = picture::context_for(wanted, &frames);
        let task = Task::rollout(frames, past_states, self.camera, conditioning, manifest)?;
        Ok((seen, task))
    }
}

/// The conditioning input of each plan.
pub(super) fn conditioning(
    plans: Vec<Vec<Vec<f32>>>,
    steps: Option<usize>,
    state: Option<RobotState>,
    manifest: &Manifest,
    config: &ServerConfig,
) -> Result<Vec<ConditioningInput>, ApiError> {
    let spec = &manifest.spec;
    check_count("plans", plans.len(), config.max_plans)?;
    if plans.is_empty() {
        return Err(ApiError::Unprocessable(
            "plans is empty; give at least one plan".to_owned(),
        ));
    }
    request_inputs::check_steps(steps, manifest, config)?;
    let found = plans.len() as u64 * steps.unwrap_or(spec.horizon) as u64 * spec.pixels() as u64;
    let limit = config.max_rollout_bytes;
    if found > limit as u64 {
        return Err(ApiError::TooLarge(format!(
            "the rollouts would be {found} bytes of images; this server predicts at most {limit} in a request"
        )));
    }
    let plans = plans
        .into_iter()
        .enumerate()
        .map(|(index, values)| request_inputs::actions(&format!("plans[{index}]"), values))
        .collect::<Result<_, _>>()?;
    Ok(ConditioningInput::of_plans(plans, state, steps, manifest)?)
}

fn answer(
    wanted: ResponseFormat,
    format: ImageFormat,
    seen: &[Frame],
    prediction: Prediction,
) -> Result<Response, ApiError> {
    let beyond_training = prediction.beyond_training();
    let Prediction {
        manifest,
        rollouts,
        warnings,
        timing,
        ..
    } = prediction;
    match wanted {
        ResponseFormat::Png => picture::png(picture::rollout_sheet(seen, &rollout_frames(&rollouts))),
        ResponseFormat::Gif => {
            let period_s = manifest.spec.frame_period_s;
            picture::gif(picture::rollout_animation(seen, &rollout_frames(&rollouts), period_s))
        }
        ResponseFormat::Json | ResponseFormat::Msgpack => {
            let format = format.answer();
            let is_calibrated = rollouts.iter().any(|rollout| !rollout.errors.is_empty());
            let calibrated = || rollouts.iter().filter(|_| is_calibrated);
            let body = RolloutResponse {
                model: manifest.name.to_string(),
                version: manifest.version,
                expected_mse: calibrated().map(Rollout::expected_mse).collect(),
                mse_band_90: calibrated().map(Rollout::mse_bands).collect(),
                novelty: rollouts.iter().filter_map(|rollout| rollout.novelty).reduce(f32::min),
                rollouts: rollouts
                    .into_iter()
                    .map(|rollout| images::encode_owned(rollout.frames, format))
                    .collect::<Result<_, _>>()?,
                format,
                beyond_training,
                warnings,
                timing,
            };
            Ok(structured(wanted, &body))
        }
    }
}

/// The frames of each rollout.
fn rollout_frames(rollouts: &[Rollout]) -> Vec<&[Frame]> {
    rollouts.iter().map(|rollout| rollout.frames.as_slice()).collect()
}
