//! The request and response bodies of sessions.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::server::http::problem::ApiError;
use crate::server::images::ImageFormat;
use crate::server::request_inputs;
use crate::server::state::App;
use crate::server::stream::protocol::{OnGap, OnLate, SessionSettings, StreamLimits};
use crate::server::stream::session::Session;
use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::registry::Model;
use foreframe_core::serving::{SessionSnapshot, SessionState};

/// The session to open.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct CreateSession {
    /// The model's name; required without `state`.
    pub(super) model: Option<String>,
    /// What happens if frames are missing.
    pub(super) on_gap: Option<OnGap>,
    /// What happens to a frame if newer frames wait behind it.
    pub(super) on_late: Option<OnLate>,
    /// How predicted frames are encoded. Default: in the format of the frames sent.
    pub(super) format: Option<ImageFormat>,
    /// How a frame of another size is resized; without it, another size is an error.
    pub(super) resize: Option<Resize>,
    /// The camera that takes the frames, for a model that estimates depth. Default: that of `state`, else the model's.
    pub(super) camera: Option<CameraModel>,
    /// A state from `GET /v1/sessions/{id}/state` of this or another server: the session continues from it.
    pub(super) state: Option<ExportedState>,
}

/// All that another server needs to continue a session.
#[derive(Debug, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct ExportedState {
    /// The model's name.
    pub(super) model: String,
    /// The model's version.
    pub(super) version: u32,
    /// Hash of the model's weights: the state is valid only for these.
    pub(super) weights_sha256: String,
    /// What happens if frames are missing.
    pub(super) on_gap: OnGap,
    /// What happens to a frame if newer frames wait behind it.
    #[serde(default)]
    pub(super) on_late: OnLate,
    /// How predicted frames are encoded; absent: in the format of the frames sent.
    pub(super) format: Option<ImageFormat>,
    /// How a frame of another size is resized; absent: it is an error.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) resize: Option<Resize>,
    /// The session state.
    pub(super) snapshot: SessionSnapshot,
}

/// A new session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct CreatedSession {
    /// The session.
    #[serde(flatten)]
    pub(super) session: SessionDescription,
    /// The secret for its stream and its state; only this answer contains it.
    pub(super) token: String,
    /// Its bounds.
    pub(super) limits: StreamLimits,
}

/// A session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct SessionDescription {
    /// Its id.
    pub(super) id: String,
    /// The model's name.
    pub(super) model: String,
    /// The model's version, which it keeps when another becomes active.
    pub(super) version: u32,
    /// The `seq` of the next frame.
    pub(super) next_seq: u64,
    /// Frames in the context.
    pub(super) have: usize,
    /// Frames that the context takes.
    pub(super) need: usize,
    /// Whether a stream is open.
    pub(super) connected: bool,
    /// Milliseconds until it expires unless it is used; absent while a stream is open.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) expires_in_ms: Option<u64>,
    /// The path of its WebSocket.
    pub(super) stream: String,
}

/// A page of sessions.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct SessionList {
    /// In the order of their ids.
    pub(super) sessions: Vec<SessionDescription>,
    /// The value of `after` for the next page; absent on the last page.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) next: Option<String>,
}

impl CreateSession {
    pub(super) fn resolve(self, app: &App) -> Result<(Arc<Model>, SessionState, SessionSettings), ApiError> {
        let (on_gap, on_late, resize, camera) = (self.on_gap, self.on_late, self.resize, self.camera);
        let format = self.format.map(ImageFormat::answer);
        let Some(exported) = self.state else {
            let Some(name) = self.model else {
                return Err(ApiError::Unprocessable(
                    "model is missing; GET /v1/models lists the models".to_owned(),
                ));
            };
            let settings = SessionSettings {
                on_gap: on_gap.unwrap_or_default(),
                on_late: on_late.unwrap_or_default(),
                format,
                resize,
            };
            let mut state = SessionState::default();
            if let Some(camera) = camera {
                state.set_camera(camera);
            }
            return Ok((app.predictor().active(&name)?, state, settings));
        };
        if let Some(name) = self.model.filter(|name| *name != exported.model) {
            return Err(ApiError::Unprocessable(format!(
                "model is \"{name}\", but the state is of \"{}\"; leave model out",
                exported.model
            )));
        }
        let model = app.predictor().active(&exported.model)?;
        let manifest = &model.manifest;
        if exported.weights_sha256 != manifest.weights_sha256 {
            return Err(ApiError::Conflict(format!(
                "the state belongs to version {} of model \"{}\" with weights {}; here version {} with weights {} is active",
                exported.version, exported.model, exported.weights_sha256, manifest.version, manifest.weights_sha256
            )));
        }
        let settings = SessionSettings {
            on_gap: on_gap.unwrap_or(exported.on_gap),
            on_late: on_late.unwrap_or(exported.on_late),
            format: format.or(exported.format.map(ImageFormat::answer)),
            resize: resize.or(exported.resize),
        };
        request_inputs::check_steps(exported.snapshot.steps, manifest, app.config())?;
        let mut state = SessionState::restore(exported.snapshot, manifest)
            .map_err(|error| ApiError::Unprocessable(format!("state.{error}")))?;
        if let Some(camera) = camera {
            state.set_camera(camera);
        }
        Ok((model, state, settings))
    }
}

impl SessionDescription {
    pub(super) fn of(session: &Session, grace: Duration, now: Instant) -> Self {
        let (state, _) = session.state();
        let manifest = &session.model.manifest;
        let left = session.left(grace, now);
        Self {
            id: session.id.clone(),
            model: manifest.name.to_string(),
            version: manifest.version,
            next_seq: state.next_seq(),
            have: state.frame_count(),
            need: manifest.spec.context,
            connected: session.is_connected(),
            expires_in_ms: left.map(|left| left.as_millis() as u64),
            stream: format!("/v1/sessions/{}/stream", session.id),
        }
    }
}
