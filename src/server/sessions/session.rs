//! A session: what it remembers, and who may step it. A step begins under the lock, is computed outside it, and counts
//! only if nobody has taken the session over meanwhile.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::core::{FrameStep, PendingStep, SessionCore, Settings, StepError};
use super::token::{Token, TokenHash};
use crate::registry::LoadedModel;
use crate::server::images::ImageFormat;
use crate::server::protocol::{ConfigureMessage, ServerMessage};
use crate::serving::{Predictor, SessionState};

/// Who holds a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::server) enum Holder {
    /// The connection of that number, or nobody if it has ended.
    Connection(u64),
    /// Nobody any more.
    Deleted,
}

pub(in crate::server) struct Session {
    pub(super) id: String,
    pub(super) token_hash: TokenHash,
    /// Tells the predictor's sessions apart.
    key: u64,
    model: Arc<LoadedModel>,
    inner: Mutex<SessionInner>,
    holder: watch::Sender<Holder>,
}

struct SessionInner {
    core: SessionCore,
    connections: u64,
    is_held: bool,
    /// When the session was last used.
    used: Instant,
}

impl Session {
    /// A session with its token, of which it keeps the hash.
    pub(in crate::server) fn new(
        model: Arc<LoadedModel>,
        state: SessionState,
        settings: Settings,
        now: Instant,
    ) -> Result<(Self, Token), getrandom::Error> {
        let (id, token) = (Token::random()?, Token::random()?);
        let session = Self {
            key: id.key(),
            id: id.id(),
            token_hash: token.hash(),
            model,
            inner: Mutex::new(SessionInner {
                core: SessionCore::new(state, settings),
                connections: 0,
                is_held: false,
                used: now,
            }),
            holder: watch::Sender::new(Holder::Connection(0)),
        };
        Ok((session, token))
    }

    pub(in crate::server) fn id(&self) -> &str {
        &self.id
    }

    pub(in crate::server) fn key(&self) -> u64 {
        self.key
    }

    pub(in crate::server) fn model(&self) -> &Arc<LoadedModel> {
        &self.model
    }

    pub(in crate::server) fn state(&self) -> (SessionState, Settings) {
        let inner = self.inner();
        (inner.core.state.clone(), inner.core.settings)
    }

    pub(in crate::server) fn next_seq(&self) -> u64 {
        self.inner().core.state.next_seq()
    }

    pub(in crate::server) fn is_held(&self) -> bool {
        self.inner().is_held
    }

    /// How long it will be kept unless it is used; `None` while a connection holds it.
    pub(in crate::server) fn left(&self, grace: Duration, now: Instant) -> Option<Duration> {
        let inner = self.inner();
        let unused = now.saturating_duration_since(inner.used);
        (!inner.is_held).then(|| grace.saturating_sub(unused))
    }

    pub(in crate::server) fn touch(&self, now: Instant) {
        let mut inner = self.inner();
        inner.used = inner.used.max(now);
    }

    pub(in crate::server) fn configure(&self, message: ConfigureMessage) -> ServerMessage {
        let mut inner = self.inner();
        let settings = &mut inner.core.settings;
        settings.on_gap = message.on_gap.unwrap_or(settings.on_gap);
        settings.on_late = message.on_late.unwrap_or(settings.on_late);
        settings.format = message.format.map(ImageFormat::answer).or(settings.format);
        ServerMessage::Configured {
            on_gap: settings.on_gap,
            on_late: settings.on_late,
            format: settings.format,
        }
    }

    /// Takes the session for a new connection, from the one that held it.
    pub(in crate::server) fn hold(self: &Arc<Self>) -> Hold {
        let mut inner = self.inner();
        inner.connections += 1;
        inner.is_held = true;
        let number = inner.connections;
        let changed = self.holder.subscribe();
        self.holder.send_if_modified(|holder| {
            let is_alive = *holder != Holder::Deleted;
            if is_alive {
                *holder = Holder::Connection(number);
            }
            is_alive
        });
        drop(inner);
        Hold {
            session: Arc::clone(self),
            number,
            changed,
        }
    }

    /// Ends the session for whoever holds it.
    pub(in crate::server) fn delete(&self) {
        self.holder.send_replace(Holder::Deleted);
    }

    fn inner(&self) -> MutexGuard<'_, SessionInner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A connection's right to step a session, until another takes it or it is dropped.
pub(in crate::server) struct Hold {
    session: Arc<Session>,
    number: u64,
    changed: watch::Receiver<Holder>,
}

impl Drop for Hold {
    fn drop(&mut self) {
        let mut inner = self.session.inner();
        if inner.connections == self.number {
            inner.is_held = false;
            inner.used = Instant::now();
        }
    }
}

impl Hold {
    pub(in crate::server) fn session(&self) -> &Arc<Session> {
        &self.session
    }

    /// Waits until another holds the session, or nobody any more.
    pub(in crate::server) async fn lost(&self) -> Holder {
        let mut changed = self.changed.clone();
        let mine = Holder::Connection(self.number);
        match changed.wait_for(|holder| *holder != mine).await {
            Ok(holder) => *holder,
            Err(_) => Holder::Deleted,
        }
    }

    /// Answers a frame: from memory if it has been answered, else by a step. Errors leave the session as it was.
    pub(in crate::server) async fn step(
        &self,
        predictor: &Predictor,
        step: FrameStep,
    ) -> Result<ServerMessage, StepError> {
        let (key, model) = (self.session.key, &self.session.model);
        let (format, begun) = {
            let inner = self.inner()?;
            let format = inner.core.settings.format.unwrap_or(step.format);
            (format, inner.core.begin(&step, model.model.spec())?)
        };
        let kept = match begun {
            PendingStep::CachedAnswer(kept) => kept,
            PendingStep::New { task, skipped } => {
                let computed = predictor.compute(model, task, Some(key)).await?;
                self.inner()?.core.commit(step, computed, skipped, model.model.spec())
            }
            PendingStep::Again(task) => {
                let computed = predictor.compute(model, task, Some(key)).await?;
                self.inner()?.core.keep(step.timestamp_us, 0, computed)
            }
        };
        kept.answer(format, model.model.spec())
    }

    /// What the lock guards, if the session is still held. Errors: `NotHeld`.
    fn inner(&self) -> Result<MutexGuard<'_, SessionInner>, StepError> {
        let inner = self.session.inner();
        if *self.session.holder.borrow() == Holder::Connection(self.number) {
            Ok(inner)
        } else {
            Err(StepError::NotHeld)
        }
    }
}
