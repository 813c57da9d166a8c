//! The messages of `OpenEnv`. Unknown fields are ignored: there, each environment chooses which it takes.

use serde::{Deserialize, Serialize};

use crate::server::routes::environments::{Info, ObservationBody, ResetBody, StepBody};
use foreframe_sim::Scenario;

/// How an episode begins without a socket.
#[derive(Debug, Default, Deserialize)]
pub(super) struct ResetData {
    /// The seed of the sequence of trials; without it, 0.
    pub(super) seed: Option<u64>,
}

/// An action.
#[derive(Debug, Deserialize)]
pub(super) struct StepData {
    /// In the order and units of the schema.
    pub(super) action: Vec<f32>,
}

/// The body of a step without a socket.
#[derive(Debug, Deserialize)]
pub(super) struct EpisodeStepRequest {
    pub(super) action: StepData,
}

/// A message of a socket; `data` has the fields of `reset` and of `step`.
#[derive(Debug, Deserialize)]
pub(super) struct SocketMessage {
    #[serde(rename = "type")]
    pub(super) kind: String,
    #[serde(default)]
    pub(super) data: SocketData,
}

#[derive(Debug, Default, Deserialize)]
pub(super) struct SocketData {
    /// Begins the sequence of this seed. Without it, the next trial of the current sequence begins.
    pub(super) seed: Option<u64>,
    /// A name for the episode; without it, it gets a random one.
    pub(super) episode_id: Option<String>,
    pub(super) action: Option<Vec<f32>>,
}

/// The answer to a reset or a step.
#[derive(Serialize)]
pub(super) struct EpisodeAnswer {
    observation: EpisodeObservation,
    /// Null after a reset.
    reward: Option<f32>,
    /// Whether the episode is over.
    done: bool,
}

#[derive(Serialize)]
struct EpisodeObservation {
    #[serde(flatten)]
    body: ObservationBody,
    /// The other robot has reached its goal.
    terminated: bool,
    /// The time of the episode is over.
    truncated: bool,
    info: Info,
}

impl EpisodeAnswer {
    pub(super) fn of_reset(ResetBody { observation, info }: ResetBody) -> Self {
        Self {
            observation: EpisodeObservation {
                body: observation,
                terminated: false,
                truncated: false,
                info,
            },
            reward: None,
            done: false,
        }
    }

    pub(super) fn of_step(step: StepBody) -> Self {
        Self {
            observation: EpisodeObservation {
                body: step.observation,
                terminated: step.terminated,
                truncated: step.truncated,
                info: step.info,
            },
            reward: Some(step.reward),
            done: step.terminated || step.truncated,
        }
    }
}

/// Where an episode is.
#[derive(Clone, Serialize)]
pub(super) struct EpisodeState {
    /// Null before the first reset.
    pub(super) episode_id: Option<String>,
    pub(super) step_count: u64,
    scenario: Scenario,
}

impl EpisodeState {
    pub(super) fn new(scenario: Scenario) -> Self {
        Self {
            episode_id: None,
            step_count: 0,
            scenario,
        }
    }
}

/// A message of the server.
#[derive(Serialize)]
#[serde(tag = "type", content = "data", rename_all = "lowercase")]
pub(super) enum SocketAnswer {
    Observation(Box<EpisodeAnswer>),
    State(EpisodeState),
    Error(SocketError),
}

/// Why a message was refused.
#[derive(Debug, Serialize)]
pub(super) struct SocketError {
    pub(super) message: String,
    pub(super) code: SocketErrorCode,
}

/// The kinds of errors of `OpenEnv`.
#[derive(Clone, Copy, Debug, Serialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub(super) enum SocketErrorCode {
    InvalidJson,
    UnknownType,
    ValidationError,
    ExecutionError,
    CapacityReached,
    SessionError,
}
