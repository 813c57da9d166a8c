//! A session and who owns it. A step begins under the lock, is computed outside it, and counts only if no other connection
//! has taken over the session meanwhile.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::protocol::{ConfigureMessage, ServerMessage, SessionSettings};
use super::step::{FrameStep, SessionCore, StepError};
use crate::server::blocking::BlockingWork;
use crate::server::http::keys::Caller;
use crate::server::images::ImageFormat;
use crate::server::token::{RandomError, Token, TokenHash};
use foreframe_core::registry::Model;
use foreframe_core::serving::{Predictor, SessionState};

/// Who may step a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::server) enum Owner {
    /// The connection of that number, or nobody if it has ended.
    Connection(u64),
    /// Nobody: the session was deleted.
    Deleted,
}

pub(in crate::server) struct Session {
    pub(in crate::server) id: String,
    pub(super) token_hash: TokenHash,
    pub(super) maker: Caller,
    /// The session's number in the predictor.
    pub(in crate::server) key: u64,
    pub(in crate::server) model: Arc<Model>,
    inner: Mutex<SessionInner>,
    owner: watch::Sender<Owner>,
}

struct SessionInner {
    core: SessionCore,
    /// How many connections there have been.
    connections: u64,
    is_connected: bool,
    /// When the session was last used.
    used: Instant,
}

impl Session {
    /// A session and its token's text. The session keeps only the token's hash. Errors: the system gave no random bytes.
    pub(in crate::server) fn new(
        model: Arc<Model>,
        state: SessionState,
        settings: SessionSettings,
        maker: Caller,
        now: Instant,
    ) -> Result<(Self, String), RandomError> {
        let (id, token) = (Token::random()?, Token::random()?);
        let session = Self {
            key: id.key(),
            id: id.id(),
            token_hash: token.hash(),
            maker,
            model,
            inner: Mutex::new(SessionInner {
                core: SessionCore::new(state, settings),
                connections: 0,
                is_connected: false,
                used: now,
            }),
            owner: watch::Sender::new(Owner::Connection(0)),
        };
        Ok((session, token.text()))
    }

    /// A session that only its holder knows, for other protocols; its answers hold raw pixels. Errors: as [`Session::new`].
    pub(in crate::server) fn own(model: Arc<Model>, maker: Caller) -> Result<Ownership, RandomError> {
        let settings = SessionSettings {
            format: Some(ImageFormat::Raw),
            ..SessionSettings::default()
        };
        let (session, _) = Self::new(model, SessionState::default(), settings, maker, Instant::now())?;
        Ok(Arc::new(session).connect())
    }

    pub(in crate::server) fn state(&self) -> (SessionState, SessionSettings) {
        let inner = self.inner();
        (inner.core.state.clone(), inner.core.settings)
    }

    pub(in crate::server) fn settings(&self) -> SessionSettings {
        self.inner().core.settings
    }

    pub(in crate::server) fn next_seq(&self) -> u64 {
        self.inner().core.state.next_seq()
    }

    pub(in crate::server) fn is_connected(&self) -> bool {
        self.inner().is_connected
    }

    /// When the session expires unless it is used; `None` while a connection is open.
    pub(in crate::server) fn left(&self, grace: Duration, now: Instant) -> Option<Duration> {
        let inner = self.inner();
        let unused = now.saturating_duration_since(inner.used);
        (!inner.is_connected).then(|| grace.saturating_sub(unused))
    }

    pub(in crate::server) fn touch(&self, now: Instant) {
        let mut inner = self.inner();
        inner.used = inner.used.max(now);
    }

    pub(in crate::server) fn configure(&self, message: &ConfigureMessage) -> ServerMessage {
        let mut inner = self.inner();
        let settings = &mut inner.core.settings;
        settings.on_gap = message.on_gap.unwrap_or(settings.on_gap);
        settings.on_late = message.on_late.unwrap_or(settings.on_late);
        settings.format = message.format.map(ImageFormat::answer).or(settings.format);
        settings.resize = message.resize.or(settings.resize);
        ServerMessage::Configured(*settings)
    }

    /// Makes a new connection the owner, in place of the connection before.
    pub(in crate::server) fn connect(self: &Arc<Self>) -> Ownership {
        let mut inner = self.inner();
        inner.connections += 1;
        inner.is_connected = true;
        let number = inner.connections;
        let changed = self.owner.subscribe();
        self.owner.send_if_modified(|owner| {
            let exists = *owner != Owner::Deleted;
            if exists {
                *owner = Owner::Connection(number);
            }
            exists
        });
        drop(inner);
        Ownership {
            session: Arc::clone(self),
            number,
            changed,
        }
    }

    /// Takes the session from its owner for good.
    pub(in crate::server) fn delete(&self) {
        self.owner.send_replace(Owner::Deleted);
    }

    fn inner(&self) -> MutexGuard<'_, SessionInner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A connection's right to step a session, until another connection takes over or this is dropped.
pub(in crate::server) struct Ownership {
    pub(in crate::server) session: Arc<Session>,
    number: u64,
    changed: watch::Receiver<Owner>,
}

impl Drop for Ownership {
    fn drop(&mut self) {
        let mut inner = self.session.inner();
        if inner.connections == self.number {
            inner.is_connected = false;
            inner.used = Instant::now();
        }
    }
}

impl Ownership {
    /// Waits until the session has another owner or is deleted.
    pub(in crate::server) async fn lost(&self) -> Owner {
        let mut changed = self.changed.clone();
        let mine = Owner::Connection(self.number);
        match changed.wait_for(|owner| *owner != mine).await {
            Ok(owner) => *owner,
            Err(_) => Owner::Deleted,
        }
    }

    /// Answers a frame: from the cache if it was answered before, else by a step. Errors leave the session as it was.
    pub(in crate::server) async fn step(
        &self,
        predictor: &Predictor,
        blocking: &BlockingWork,
        step: FrameStep,
    ) -> Result<ServerMessage, StepError> {
        let (key, model) = (self.session.key, &self.session.model);
        let spec = model.spec();
        let (format, missing, task) = {
            let inner = self.inner()?;
            let core = &inner.core;
            let missing = core.missing_before(step.seq)?;
            let task = match missing {
                Some(missing) => {
                    let task = core.task(step.frame, &step.conditions.conditioning, step.is_overtaken, spec);
                    Some(if missing > 0 { task.after_gap() } else { task })
                }
                None => core.repeat_task(spec),
            };
            (core.settings.format.unwrap_or(step.format), missing, task)
        };
        let answer = if let Some(task) = task {
            let mut prediction = predictor.compute(model, task, Some(key)).await?;
            let core = &mut self.inner()?.core;
            if missing.is_some() {
                core.state
                    .advance(step.seq, &mut prediction, step.conditions.conditioning, spec);
            }
            core.say_unused(&mut prediction, step.conditions.unused);
            core.keep(step.timestamp_us, missing.unwrap_or(0), prediction)
        } else {
            self.inner()?.core.last_answer(step.timestamp_us)
        };
        if answer.must_compress(format) {
            let model = Arc::clone(model);
            return blocking.run(move || answer.message(format, model.spec())).await?;
        }
        answer.message(format, spec)
    }

    /// The session's state, if this is still its owner. Errors: `NotOwner`.
    fn inner(&self) -> Result<MutexGuard<'_, SessionInner>, StepError> {
        let inner = self.session.inner();
        if *self.session.owner.borrow() == Owner::Connection(self.number) {
            Ok(inner)
        } else {
            Err(StepError::NotOwner)
        }
    }
}
