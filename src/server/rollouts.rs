//! Many futures of one context: what comes of each of many sequences of actions.

use std::sync::Arc;

use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::error::{ApiError, Problem};
use super::extract::{Json, Path, ResponseFormat};
use super::images::{self, ImageBytes, ImageFormat};
use super::multipart::{JsonOrForm, WithFrames};
use super::predict::{self, PredictError};
use super::protocol::Timing;
use super::sessions::AuthorizedSession;
use super::{App, ServerConfig, blocking, picture};
use crate::frame::Frame;
use crate::registry::{LoadedModel, Manifest};
use crate::serving::{ConditioningInput, Task, TaskOutput};
use crate::types::RobotState;

/// A context, and what might be done.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct RolloutRequest {
    /// The context's images, oldest first; in a form, its parts `frames`.
    #[serde(default)]
    frames: Vec<ImageBytes>,
    /// How the images are encoded, and those of the answer shall be (`png` for `jpeg`).
    #[serde(default)]
    format: ImageFormat,
    /// What the robot says of itself at the last frame.
    #[serde(default)]
    state: Option<Vec<f32>>,
    /// What the robot said of itself at each frame, in place of `state`.
    #[serde(default)]
    states: Option<Vec<Vec<f32>>>,
    /// Sequences of future actions, each as long as the model's horizon; the first acts from the last frame on.
    candidates: Vec<Vec<Vec<f32>>>,
}

/// What might be done from where a session is.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct SessionRolloutRequest {
    /// How the images of the answer shall be encoded.
    #[serde(default)]
    format: ImageFormat,
    /// What the robot says of itself; default: what it said at the session's last frame.
    #[serde(default)]
    state: Option<Vec<f32>>,
    /// Sequences of future actions, each as long as the model's horizon; the first acts from the last frame on.
    candidates: Vec<Vec<Vec<f32>>>,
}

/// What would come of each.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct RolloutResponse {
    /// The model's name.
    model: String,
    /// The model's version.
    version: u32,
    /// For each candidate, in order: t+1, t+2, ….
    futures: Vec<Vec<ImageBytes>>,
    /// How they are encoded.
    format: ImageFormat,
    /// How long it took.
    timing: Timing,
}

impl WithFrames for RolloutRequest {
    fn frames(&mut self) -> &mut Vec<ImageBytes> {
        &mut self.frames
    }
}

/// Predicts what would come of each of many sequences of actions. `Accept: image/png` gives a contact sheet
/// with a row for each, `image/gif` an animation with all of them side by side.
#[utoipa::path(
    post, path = "/v1/models/{model}/rollouts", tag = "models", request_body = RolloutRequest,
    params(("model" = String, Path, description = "The model's name")),
    responses(
        (status = 200, description = "The futures", content(
            (RolloutResponse = "application/json"), (Vec<u8> = "image/png"), (Vec<u8> = "image/gif"),
        )),
        (status = 400, description = "Not JSON", body = Problem),
        (status = 404, description = "No such model", body = Problem),
        (status = 406, description = "Too many for a picture, or none of the media types in `Accept` can be had", body = Problem),
        (status = 413, description = "A body, a list or an answer over the limit", body = Problem),
        (status = 422, description = "Does not fit the model", body = Problem),
        (status = 503, description = "Too many predictions wait", body = Problem),
    )
)]
pub(super) async fn of_model(
    State(app): State<App>,
    Path(model): Path<String>,
    wanted: ResponseFormat,
    JsonOrForm(request): JsonOrForm<RolloutRequest>,
) -> Result<Response, ApiError> {
    let model = app.predictor().active(&model)?;
    let (manifest, format, config) = (Arc::clone(&model.manifest), request.format, app.config().clone());
    let (seen, task) = blocking(move || request.into_task(&manifest, &config)).await??;
    let computed = app.predictor().compute(&model, task, None).await?;
    blocking(move || answer(wanted, format, &model, &seen, &computed)).await?
}

/// Predicts what would come of each of many sequences of actions from where the session is, which stays there.
#[utoipa::path(
    post, path = "/v1/sessions/{id}/rollouts", tag = "sessions", request_body = SessionRolloutRequest,
    params(
        ("id" = String, Path, description = "The session's id"),
        ("x-session-token" = Option<String>, Header, description = "The session's token; or as query parameter `token`"),
    ),
    responses(
        (status = 200, description = "The futures", content(
            (RolloutResponse = "application/json"), (Vec<u8> = "image/png"), (Vec<u8> = "image/gif"),
        )),
        (status = 403, description = "Not its token", body = Problem),
        (status = 404, description = "No such session", body = Problem),
        (status = 409, description = "The session has not enough frames yet", body = Problem),
        (status = 410, description = "It has expired", body = Problem),
        (status = 413, description = "A body, a list or an answer over the limit", body = Problem),
        (status = 422, description = "Does not fit the model", body = Problem),
        (status = 503, description = "Too many predictions wait", body = Problem),
    )
)]
pub(super) async fn of_session(
    State(app): State<App>,
    AuthorizedSession(session): AuthorizedSession,
    wanted: ResponseFormat,
    Json(request): Json<SessionRolloutRequest>,
) -> Result<Response, ApiError> {
    let model = Arc::clone(session.model());
    let (state, format) = (session.state().0, request.format);
    let (have, need) = (state.frame_count(), model.manifest.spec.context);
    if have < need {
        return Err(PredictError::Buffering { have, need }.into());
    }
    let told = predict::last_state(request.state, None, 0)?.or_else(|| state.robot_state().cloned());
    let task = state.rollout_task(premises(request.candidates, told, &model.manifest, app.config())?);
    let computed = app.predictor().compute(&model, task, Some(session.key())).await?;
    blocking(move || answer(wanted, format, &model, &[], &computed)).await?
}

impl RolloutRequest {
    fn into_task(self, manifest: &Manifest, config: &ServerConfig) -> Result<(Vec<Frame>, Task), PredictError> {
        let seen = predict::decode_frames(self.frames, self.format, manifest, config.max_frames)?;
        let state = predict::last_state(self.state, self.states, seen.len())?;
        let premises = premises(self.candidates, state, manifest, config)?;
        let task = Task::rollout(seen.clone(), premises, &manifest.name, &manifest.spec)?;
        Ok((seen, task))
    }
}

fn premises(
    candidates: Vec<Vec<Vec<f32>>>,
    state: Option<RobotState>,
    manifest: &Manifest,
    config: &ServerConfig,
) -> Result<Vec<ConditioningInput>, PredictError> {
    let spec = &manifest.spec;
    predict::check_count("candidates", candidates.len(), config.max_candidates)?;
    if candidates.is_empty() {
        return Err(PredictError::NoCandidates);
    }
    let found = candidates.len() as u64 * spec.horizon as u64 * spec.pixels() as u64;
    if found > config.max_rollout_bytes as u64 {
        return Err(PredictError::TooLarge {
            found,
            limit: config.max_rollout_bytes,
        });
    }
    let candidates = candidates
        .into_iter()
        .enumerate()
        .map(|(index, values)| predict::actions(&format!("candidates[{index}]"), values))
        .collect::<Result<_, _>>()?;
    Ok(ConditioningInput::candidates(candidates, state, &manifest.name, spec)?)
}

fn answer(
    wanted: ResponseFormat,
    format: ImageFormat,
    model: &LoadedModel,
    seen: &[Frame],
    computed: &TaskOutput,
) -> Result<Response, ApiError> {
    let futures = &computed.predictions;
    let encoded = |format| {
        futures
            .iter()
            .map(|frames| images::encode(frames, format))
            .collect::<Result<_, _>>()
    };
    match wanted {
        ResponseFormat::Png => picture::png(picture::rollout_sheet(seen, futures)),
        ResponseFormat::Gif => picture::gif(picture::rollout_animation(
            seen,
            futures,
            model.manifest.spec.frame_period_s,
        )),
        ResponseFormat::Json => {
            let format = format.answer();
            Ok(axum::Json(RolloutResponse {
                model: model.manifest.name.clone(),
                version: model.manifest.version,
                futures: encoded(format)?,
                format,
                timing: Timing {
                    queue_us: computed.queue_us,
                    compute_us: computed.compute_us,
                },
            })
            .into_response())
        }
    }
}
