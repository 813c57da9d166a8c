//! The open sessions: a bounded number. A session expires if it is not used for the grace period. Time is an argument.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use metrics::counter;
use tracing::info;

use super::session::Session;
use crate::server::http::keys::Caller;
use crate::server::http::problem::ApiError;
use crate::server::token::TokenHash;
use foreframe_core::metric_names;

/// Why a session is not available.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub(in crate::server) enum SessionTableError {
    #[error("there is no session \"{0}\"")]
    Unknown(String),
    #[error("session \"{id}\" was not used for {grace_ms} ms and has expired; open a new one with POST /v1/sessions")]
    Expired { id: String, grace_ms: u128 },
    #[error(
        "the session's token is missing or wrong; send it in the header x-session-token or as query parameter token"
    )]
    Token,
    #[error("{0} sessions are open already; try again later")]
    Full(usize),
}

impl From<SessionTableError> for ApiError {
    fn from(error: SessionTableError) -> Self {
        match error {
            SessionTableError::Unknown(_) => Self::NotFound(error.to_string()),
            SessionTableError::Expired { .. } => Self::Gone(error.to_string()),
            SessionTableError::Token => Self::Forbidden(error.to_string()),
            SessionTableError::Full(_) => Self::unavailable(error.to_string()),
        }
    }
}

/// All open sessions, by id.
pub(in crate::server) struct SessionTable {
    inner: Mutex<SessionTableInner>,
    limit: usize,
    grace: Duration,
}

#[derive(Default)]
struct SessionTableInner {
    sessions: BTreeMap<String, Arc<Session>>,
    /// Ids of the last sessions that expired, so that they differ from unknown ids. At most as many as may be open.
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
    pub(in crate::server) fn insert(&self, session: Session, now: Instant) -> Result<Arc<Session>, SessionTableError> {
        let mut inner = self.inner();
        self.evict(&mut inner, now);
        if inner.sessions.len() >= self.limit {
            return Err(SessionTableError::Full(self.limit));
        }
        let session = Arc::new(session);
        inner.sessions.insert(session.id.clone(), Arc::clone(&session));
        Ok(session)
    }

    /// The session, if the caller may see it. Errors: `Unknown`, `Expired`.
    pub(in crate::server) fn find(
        &self,
        id: &str,
        caller: Caller,
        now: Instant,
    ) -> Result<Arc<Session>, SessionTableError> {
        let session = self.get(id, now)?;
        if caller.may_see(session.maker) {
            Ok(session)
        } else {
            Err(SessionTableError::Unknown(id.to_owned()))
        }
    }

    /// The session. Errors: `Unknown`, `Expired`.
    fn get(&self, id: &str, now: Instant) -> Result<Arc<Session>, SessionTableError> {
        let mut inner = self.inner();
        self.evict(&mut inner, now);
        let session = inner.sessions.get(id).cloned();
        session.ok_or_else(|| {
            if inner.expired.iter().any(|expired| expired == id) {
                return SessionTableError::Expired {
                    id: id.to_owned(),
                    grace_ms: self.grace.as_millis(),
                };
            }
            SessionTableError::Unknown(id.to_owned())
        })
    }

    /// The session, if the token is right; counts as use. Errors: `Unknown`, `Expired`, `Token`.
    pub(in crate::server) fn open(
        &self,
        id: &str,
        token: &str,
        now: Instant,
    ) -> Result<Arc<Session>, SessionTableError> {
        let session = self.get(id, now)?;
        if session.token_hash != TokenHash::of(token) {
            return Err(SessionTableError::Token);
        }
        session.touch(now);
        Ok(session)
    }

    pub(in crate::server) fn remove(&self, session: &Session) {
        self.inner().sessions.remove(&session.id);
        session.delete();
    }

    /// The sessions after an id that the caller may see, in the order of their ids.
    pub(in crate::server) fn page(&self, after: &str, limit: usize, caller: Caller, now: Instant) -> Vec<Arc<Session>> {
        let mut inner = self.inner();
        self.evict(&mut inner, now);
        let later = inner
            .sessions
            .range::<str, _>((std::ops::Bound::Excluded(after), std::ops::Bound::Unbounded));
        let seen = later.map(|(_, session)| session).filter(|of| caller.may_see(of.maker));
        seen.take(limit).cloned().collect()
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
                counter!(metric_names::SESSIONS_EVICTED).increment(1);
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
