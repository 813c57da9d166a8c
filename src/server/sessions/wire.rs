//! What is said of sessions over HTTP.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::core::Settings;
use super::session::Session;
use crate::registry::LoadedModel;
use crate::server::App;
use crate::server::error::ApiError;
use crate::server::images::ImageFormat;
use crate::server::protocol::{OnGap, OnLate, StreamLimits};
use crate::serving::{SessionMemory, SessionState};

/// Which session to open.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(in crate::server) struct CreateSession {
    /// The model's name; needed where there is no `state`.
    #[serde(default)]
    pub(super) model: Option<String>,
    /// What a missing frame means.
    #[serde(default)]
    pub(super) on_gap: Option<OnGap>,
    /// What a frame means that a newer one has overtaken.
    #[serde(default)]
    pub(super) on_late: Option<OnLate>,
    /// How predicted frames are encoded; default: as those sent.
    #[serde(default)]
    pub(super) format: Option<ImageFormat>,
    /// A state that `GET /v1/sessions/{id}/state` gave, here or on another server: the session goes on from there.
    #[serde(default)]
    pub(super) state: Option<ExportedState>,
}

/// All of a session that another server needs to go on with it.
#[derive(Debug, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(in crate::server) struct ExportedState {
    /// The model's name.
    pub(super) model: String,
    /// The model's version.
    pub(super) version: u32,
    /// Hash of the model's weights: a state means nothing to any other.
    pub(super) weights_sha256: String,
    /// What a missing frame means.
    pub(super) on_gap: OnGap,
    /// What a frame means that a newer one has overtaken.
    #[serde(default)]
    pub(super) on_late: OnLate,
    /// How predicted frames are encoded; absent for as those sent.
    #[serde(default)]
    pub(super) format: Option<ImageFormat>,
    /// What it remembers.
    pub(super) memory: SessionMemory,
}

/// A new session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(in crate::server) struct CreatedSession {
    /// Who it is.
    #[serde(flatten)]
    pub(super) session: SessionDescription,
    /// The secret that opens its stream and its state; said only here.
    pub(super) token: String,
    /// Its bounds.
    pub(super) limits: StreamLimits,
}

/// A session.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(in crate::server) struct SessionDescription {
    /// Its id.
    pub(super) id: String,
    /// The model's name.
    pub(super) model: String,
    /// The model's version, which it keeps when another becomes active.
    pub(super) version: u32,
    /// The number that the next frame shall have.
    pub(super) next_seq: u64,
    /// Frames in the context.
    pub(super) have: usize,
    /// Frames that the context takes.
    pub(super) need: usize,
    /// Whether a stream is open.
    pub(super) connected: bool,
    /// Milliseconds until it expires unless it is used; absent while a stream is open.
    pub(super) expires_in_ms: Option<u64>,
    /// Where its WebSocket is.
    pub(super) stream: String,
}

/// Sessions there are.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(in crate::server) struct SessionList {
    /// In the order of their ids.
    pub(super) sessions: Vec<SessionDescription>,
    /// What to give as `after` for those that follow; absent at the end.
    pub(super) next: Option<String>,
}

impl CreateSession {
    pub(super) fn resolve(self, app: &App) -> Result<(Arc<LoadedModel>, SessionState, Settings), ApiError> {
        let (on_gap, on_late, format) = (self.on_gap, self.on_late, self.format.map(ImageFormat::answer));
        let Some(exported) = self.state else {
            let Some(name) = self.model else {
                return Err(ApiError::Unprocessable(
                    "model is missing; name one of GET /v1/models".to_owned(),
                ));
            };
            let settings = Settings {
                on_gap: on_gap.unwrap_or_default(),
                on_late: on_late.unwrap_or_default(),
                format,
            };
            return Ok((app.predictor().active(&name)?, SessionState::default(), settings));
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
                "the state is of version {} of model \"{}\" with weights {}; here version {} with weights {} is active",
                exported.version, exported.model, exported.weights_sha256, manifest.version, manifest.weights_sha256
            )));
        }
        let settings = Settings {
            on_gap: on_gap.unwrap_or(exported.on_gap),
            on_late: on_late.unwrap_or(exported.on_late),
            format: format.or(exported.format.map(ImageFormat::answer)),
        };
        let state = SessionState::restore(exported.memory, &manifest.name, &manifest.spec)
            .map_err(|error| ApiError::Unprocessable(format!("state.{error}")))?;
        Ok((model, state, settings))
    }
}

impl SessionDescription {
    pub(super) fn of(session: &Session, grace: Duration, now: Instant) -> Self {
        let (state, _) = session.state();
        let manifest = &session.model().manifest;
        let left = session.left(grace, now);
        Self {
            id: session.id().to_owned(),
            model: manifest.name.clone(),
            version: manifest.version,
            next_seq: state.next_seq(),
            have: state.frame_count(),
            need: manifest.spec.context,
            connected: session.is_held(),
            expires_in_ms: left.map(|left| left.as_millis() as u64),
            stream: format!("/v1/sessions/{}/stream", session.id()),
        }
    }
}
