//! The sessions there are: a bounded number, each until it has not been used for its grace period. Time is an argument.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use metrics::counter;
use tracing::info;

use super::session::Session;
use super::token::TokenHash;
use crate::telemetry::names;

/// Why a session cannot be had.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub(in crate::server) enum TableError {
    #[error("there is no session \"{0}\"")]
    Unknown(String),
    #[error("session \"{id}\" was not used for {grace_ms} ms and has expired; open a new one by POST /v1/sessions")]
    Expired { id: String, grace_ms: u128 },
    #[error(
        "what came, if anything, is not the session's token; send it as header x-session-token or as query parameter token"
    )]
    Token,
    #[error("{0} sessions are open already; try again later")]
    Full(usize),
}

pub(in crate::server) struct SessionTable {
    inner: Mutex<SessionTableInner>,
    limit: usize,
    grace: Duration,
}

#[derive(Default)]
struct SessionTableInner {
    sessions: BTreeMap<String, Arc<Session>>,
    /// The last to expire, so that they can be told apart from those that never were; as many as may be open.
    expired: VecDeque<String>,
}

impl SessionTable {
    pub(in crate::server) fn new(limit: usize, grace: Duration) -> Self {
        Self {
            inner: Mutex::default(),
            limit,
            grace,
        }
    }

    pub(in crate::server) fn grace(&self) -> Duration {
        self.grace
    }

    /// Errors: `Full`.
    pub(in crate::server) fn insert(&self, session: Session, now: Instant) -> Result<Arc<Session>, TableError> {
        let mut inner = self.inner();
        self.evict(&mut inner, now);
        if inner.sessions.len() >= self.limit {
            return Err(TableError::Full(self.limit));
        }
        let session = Arc::new(session);
        inner.sessions.insert(session.id.clone(), Arc::clone(&session));
        Ok(session)
    }

    /// The session, for whoever asks. Errors: `Unknown`, `Expired`.
    pub(in crate::server) fn get(&self, id: &str, now: Instant) -> Result<Arc<Session>, TableError> {
        let mut inner = self.inner();
        self.evict(&mut inner, now);
        let session = inner.sessions.get(id).cloned();
        session.ok_or_else(|| {
            if inner.expired.iter().any(|expired| expired == id) {
                return TableError::Expired {
                    id: id.to_owned(),
                    grace_ms: self.grace.as_millis(),
                };
            }
            TableError::Unknown(id.to_owned())
        })
    }

    /// The session, for who has its token; counts as use. Errors: `Unknown`, `Expired`, `Token`.
    pub(in crate::server) fn open(&self, id: &str, token: &str, now: Instant) -> Result<Arc<Session>, TableError> {
        let session = self.get(id, now)?;
        if session.token_hash != TokenHash::of(token) {
            return Err(TableError::Token);
        }
        session.touch(now);
        Ok(session)
    }

    pub(in crate::server) fn remove(&self, session: &Session) {
        self.inner().sessions.remove(&session.id);
        session.delete();
    }

    /// Those after an id, in the order of their ids.
    pub(in crate::server) fn page(&self, after: &str, limit: usize, now: Instant) -> Vec<Arc<Session>> {
        let mut inner = self.inner();
        self.evict(&mut inner, now);
        let later = inner
            .sessions
            .range::<str, _>((std::ops::Bound::Excluded(after), std::ops::Bound::Unbounded));
        later.take(limit).map(|(_, session)| Arc::clone(session)).collect()
    }

    /// How many are open.
    pub(in crate::server) fn count(&self, now: Instant) -> usize {
        let mut inner = self.inner();
        self.evict(&mut inner, now);
        inner.sessions.len()
    }

    fn evict(&self, inner: &mut SessionTableInner, now: Instant) {
        let SessionTableInner { sessions, expired } = inner;
        sessions.retain(|id, session| {
            let is_over = session.left(self.grace, now).is_some_and(|left| left.is_zero());
            if is_over {
                info!(session.id = %id, frames = session.next_seq(), "session expired");
                counter!(names::SESSIONS_EVICTED).increment(1);
                session.delete();
                expired.push_back(id.clone());
            }
            !is_over
        });
        let surplus = expired.len().saturating_sub(self.limit);
        expired.drain(..surplus);
    }

    fn inner(&self) -> MutexGuard<'_, SessionTableInner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
