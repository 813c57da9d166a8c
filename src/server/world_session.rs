//! A world model as an environment: a model with the context of its last observations.

use std::sync::Arc;

use tokio::sync::Mutex;

use super::http::keys::Caller;
use super::stream::session::{Ownership, Session};
use super::token::RandomError;
use foreframe_core::registry::Model;

/// A session of a world model; one request at a time steps it.
pub(super) type SharedWorldSession = Mutex<WorldSession>;

/// A world model with the context of its last observations.
pub(super) struct WorldSession {
    pub(super) ownership: Ownership,
    pub(super) is_closed: bool,
}

impl WorldSession {
    /// Errors: the system gave no random bytes.
    pub(super) fn new(model: Arc<Model>, maker: Caller) -> Result<Self, RandomError> {
        Ok(Self {
            ownership: Session::own(model, maker)?,
            is_closed: false,
        })
    }

    /// The number of the next step: each step is a frame of the context.
    pub(super) fn next_step(&self) -> u64 {
        self.ownership.session.next_seq()
    }

    pub(super) fn model(&self) -> &Arc<Model> {
        &self.ownership.session.model
    }
}
