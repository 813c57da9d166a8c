//! openpi's WebSocket, for clients of its package `openpi-client`: one observation, one answer. Here the answer holds predicted
//! frames instead of a policy's actions. Messages are `MessagePack` with arrays of `NumPy`; errors are text. The connection holds
//! one session, and gathers its context from the observations.

mod answer;
mod numpy;
mod observation;

use std::sync::Arc;

use axum::extract::ws::Message;
use metrics::counter;

use self::answer::{OpenpiAnswer, OpenpiMetadata, ResetStatus};
use self::observation::{Endpoint, OpenpiObservation};
use super::http::problem::ApiError;
use super::msgpack::{self, MsgpackError};
use super::stream::request_socket::Responder;
use super::stream::session::{Ownership, Session};
use super::stream::socket::StreamServices;
use super::stream::step::StepError;
use super::token::RandomError;
use foreframe_core::error_text::without_middle;
use foreframe_core::metric_names;
use foreframe_core::registry::{Manifest, Model};

/// Why an observation has no answer.
#[derive(Debug, thiserror::Error)]
enum OpenpiError {
    #[error("not an observation: {0}")]
    Message(#[from] MsgpackError),
    #[error(transparent)]
    Step(#[from] StepError),
    #[error(transparent)]
    Random(#[from] RandomError),
}

/// One connection of the protocol.
pub(super) struct OpenpiConnection {
    services: Arc<StreamServices>,
    ownership: Ownership,
}

impl OpenpiConnection {
    /// Errors: `Internal`.
    pub(super) fn new(services: Arc<StreamServices>, model: Arc<Model>) -> Result<Self, ApiError> {
        let ownership = Session::own(model, services.caller)?;
        Ok(Self { services, ownership })
    }

    fn model(&self) -> &Arc<Model> {
        &self.ownership.session.model
    }

    async fn answer_bytes(&mut self, bytes: &[u8]) -> Result<Vec<u8>, OpenpiError> {
        let observation: OpenpiObservation = msgpack::read(bytes)?;
        let model = match &observation.model {
            Some(name) if *name != *self.model().manifest.name.as_str() => {
                self.services.predictor.active(name).map_err(StepError::from)?
            }
            _ => Arc::clone(self.model()),
        };
        if observation.endpoint == Endpoint::Reset {
            self.ownership = Session::own(model, self.services.caller)?;
            return Ok(msgpack::write(&ResetStatus::DONE));
        }
        let begins = observation.reset || !Arc::ptr_eq(&model, self.model());
        let seq = if begins { 0 } else { self.ownership.session.next_seq() };
        let (manifest, max_steps) = (Arc::clone(&model.manifest), self.services.config.max_steps);
        let read = move || observation.into_step(seq, &manifest, max_steps);
        let step = self.services.blocking.run(read).await.map_err(StepError::from)??;
        // Only now: an observation that is refused leaves the context as it was.
        if begins {
            self.ownership = Session::own(model, self.services.caller)?;
        }
        let manifest = Arc::clone(&self.model().manifest);
        counter!(metric_names::STREAM_FRAMES, "model" => manifest.name.to_string()).increment(1);
        let (predictor, blocking) = (&self.services.predictor, &self.services.blocking);
        let message = self.ownership.step(predictor, blocking, step).await?;
        Ok(msgpack::write(&OpenpiAnswer::new(message, &manifest)))
    }
}

impl Responder for OpenpiConnection {
    fn greeting(&self) -> Option<Message> {
        let manifests = self.services.predictor.models();
        let names = manifests.iter().map(|manifest| manifest.name.as_str()).collect();
        let metadata = OpenpiMetadata::new(&self.model().manifest, names);
        Some(Message::Binary(msgpack::write(&metadata).into()))
    }

    async fn answer(&mut self, message: Message) -> Option<Message> {
        let Message::Binary(bytes) = message else {
            return Some(self.refusal("an observation is a binary message, MessagePack with arrays of NumPy"));
        };
        let answered = self.answer_bytes(&bytes).await;
        Some(answered.map_or_else(
            |error| self.refusal(&error.to_string()),
            |bytes| Message::Binary(bytes.into()),
        ))
    }

    fn refusal(&self, detail: &str) -> Message {
        Message::Text(without_middle(&detail).into())
    }
}

/// The model of a connection that names none: of the models that take actions, or else of all, the one with the highest skill
/// on test data.
pub(super) fn best_model(models: &[Arc<Manifest>]) -> Option<&Arc<Manifest>> {
    let skill = |manifest: &Manifest| manifest.metrics["test"]["skill"].as_f64().unwrap_or(f64::NEG_INFINITY);
    let takes_actions = |manifest: &Manifest| manifest.spec.action_inputs().is_some();
    // The first of equal ones.
    models.iter().rev().max_by(|one, other| {
        let by_actions = takes_actions(one).cmp(&takes_actions(other));
        by_actions.then(skill(one).total_cmp(&skill(other)))
    })
}
