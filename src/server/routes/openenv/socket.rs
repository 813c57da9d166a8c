//! A socket of `OpenEnv`: one environment, which ends with it. It has a place in the table of environments, whose bounds hold.

use std::sync::Mutex;
use std::time::Instant;

use axum::extract::ws::Message;
use serde_json::error::Category;

use super::messages::{
    EpisodeAnswer, EpisodeState, SocketAnswer, SocketData, SocketError, SocketErrorCode, SocketMessage,
};
use super::new;
use crate::server::environments::SharedEnvironment;
use crate::server::http::keys::Caller;
use crate::server::http::problem::ApiError;
use crate::server::routes::environments::{advance, lock, restart};
use crate::server::state::App;
use crate::server::stream::request_socket::Responder;
use crate::server::token::Token;
use foreframe_core::error_text::without_middle;
use foreframe_core::types::Seed;
use foreframe_sim::Scenario;

/// As `OpenEnv`'s own server.
const MAX_EPISODE_ID_LETTERS: usize = 255;

/// One connection.
pub(super) struct EnvironmentSocket {
    app: App,
    caller: Caller,
    scenario: Scenario,
    /// The environment's id; `None` before the first reset.
    id: Option<String>,
    state: EpisodeState,
}

impl EnvironmentSocket {
    pub(super) fn new(app: App, caller: Caller, scenario: Scenario) -> Self {
        Self {
            app,
            caller,
            scenario,
            id: None,
            state: EpisodeState::new(scenario),
        }
    }

    /// `None` if the client asked for the end.
    async fn answer_text(&mut self, text: &str) -> Result<Option<SocketAnswer>, SocketError> {
        let message = read(text)?;
        match message.kind.as_str() {
            "reset" => self.reset(message.data).await.map(Some),
            "step" => self.step(message.data.action).await.map(Some),
            "state" => Ok(Some(SocketAnswer::State(self.state.clone()))),
            "close" => Ok(None),
            other => {
                let message = format!(
                    "type is \"{}\"; it must be reset, step, state or close",
                    other.escape_default()
                );
                Err(refuse(SocketErrorCode::UnknownType, &message))
            }
        }
    }

    async fn reset(&mut self, data: SocketData) -> Result<SocketAnswer, SocketError> {
        let SocketData { seed, episode_id, .. } = data;
        let letters = episode_id.as_ref().map_or(0, |id| id.chars().count());
        if letters > MAX_EPISODE_ID_LETTERS {
            let message = format!("episode_id has {letters} letters; the maximum is {MAX_EPISODE_ID_LETTERS}");
            return Err(refuse(SocketErrorCode::ValidationError, &message));
        }
        let environment = self.open()?;
        let begin = move || restart(&mut lock(&environment), seed.map(Seed));
        let begun = self.app.blocking.run(begin).await.map_err(ApiError::from)??;
        let random = || Token::random().map(|token| token.id()).map_err(ApiError::from);
        self.state.episode_id = Some(episode_id.map_or_else(random, Ok)?);
        self.state.step_count = 0;
        Ok(SocketAnswer::Observation(Box::new(EpisodeAnswer::of_reset(begun))))
    }

    async fn step(&mut self, action: Option<Vec<f32>>) -> Result<SocketAnswer, SocketError> {
        let missing = || {
            let message = "data.action is missing; it is the list [linear, angular]";
            refuse(SocketErrorCode::ValidationError, message)
        };
        let action = action.ok_or_else(missing)?;
        let unopened = || {
            let message = "the environment has not been reset; send reset before the first step";
            refuse(SocketErrorCode::ExecutionError, message)
        };
        let id = self.id.as_deref().ok_or_else(unopened)?;
        let environment = self.app.environments.get(id, self.caller, Instant::now())?;
        let work = move || advance(&mut lock(&environment), action);
        let step = self.app.blocking.run(work).await.map_err(ApiError::from)??;
        self.state.step_count += 1;
        Ok(SocketAnswer::Observation(Box::new(EpisodeAnswer::of_step(step))))
    }

    /// The socket's environment; a new one if it has none yet, or if another one took its place.
    fn open(&mut self) -> Result<SharedEnvironment, ApiError> {
        let (table, now) = (&self.app.environments, Instant::now());
        if let Some(id) = &self.id
            && let Ok(environment) = table.get(id, self.caller, now)
        {
            return Ok(environment);
        }
        let id = table.add(Mutex::new(new(self.scenario)?), self.caller, now)?;
        let environment = table.get(&id, self.caller, now);
        self.id = Some(id);
        environment
    }
}

impl Drop for EnvironmentSocket {
    fn drop(&mut self) {
        if let Some(id) = &self.id {
            // It may be gone: another one took its place.
            let _ = self.app.environments.remove(id, self.caller, Instant::now());
        }
    }
}

impl Responder for EnvironmentSocket {
    fn greeting(&self) -> Option<Message> {
        None
    }

    async fn answer(&mut self, message: Message) -> Option<Message> {
        let Message::Text(text) = message else {
            return Some(self.refusal("a message is text, JSON"));
        };
        let answer = self.answer_text(&text).await;
        answer
            .unwrap_or_else(|error| Some(SocketAnswer::Error(error)))
            .map(|answer| written(&answer))
    }

    fn refusal(&self, detail: &str) -> Message {
        written(&SocketAnswer::Error(refuse(SocketErrorCode::InvalidJson, detail)))
    }
}

/// Errors name the field.
fn read(text: &str) -> Result<SocketMessage, SocketError> {
    let refused = |error: &serde_json::Error, words: String| {
        let code = match error.classify() {
            Category::Data => SocketErrorCode::ValidationError,
            Category::Io | Category::Syntax | Category::Eof => SocketErrorCode::InvalidJson,
        };
        refuse(code, &words)
    };
    let mut json = serde_json::Deserializer::from_str(text);
    let message = serde_path_to_error::deserialize(&mut json);
    let message = message.map_err(|error| refused(error.inner(), error.to_string()))?;
    json.end().map_err(|error| refused(&error, error.to_string()))?;
    Ok(message)
}

#[expect(clippy::expect_used, reason = "texts and numbers are always valid JSON")]
fn written(answer: &SocketAnswer) -> Message {
    let text = serde_json::to_string(answer).expect("an answer that is not JSON is a bug");
    Message::Text(text.into())
}

fn refuse(code: SocketErrorCode, message: &str) -> SocketError {
    let message = without_middle(&message);
    SocketError { message, code }
}

impl From<ApiError> for SocketError {
    fn from(error: ApiError) -> Self {
        let code = match &error {
            ApiError::Unprocessable(_) => SocketErrorCode::ValidationError,
            ApiError::Unavailable { .. } => SocketErrorCode::CapacityReached,
            ApiError::NotFound(_) => SocketErrorCode::SessionError,
            _ => SocketErrorCode::ExecutionError,
        };
        refuse(code, &error.into_detail())
    }
}
